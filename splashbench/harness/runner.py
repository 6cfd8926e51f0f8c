"""Running a method on a scene: Scene -> Submission, whatever happens to the method on the way.

Two child processes fit, then render; the copy of the scene that they see holds no test image. The submission is
complete in every case: with renders when the run is `ok`, else with a status and a reason.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from splashbench.child import child_command, raise_if_disk_was_full
from splashbench.errors import SplashbenchError
from splashbench.files import atomic_directory, read_model, tree_bytes, write_model
from splashbench.harness import hardware, method_process
from splashbench.harness.contract import Method
from splashbench.harness.discovery import EXTERNAL, ORACLE, load_method
from splashbench.harness.messages import Outcome, Request
from splashbench.harness.training_copy import make_training_copy
from splashbench.harness.watched_process import Watched, watch
from splashbench.scene import Particles, Scene, SignedDistance
from splashbench.submission import (
    IDENTITY,
    Budget,
    Checkpoint,
    Identity,
    Record,
    Status,
    Submission,
    identity_text,
    seal,
)
from splashbench.submission.cameras import write_cameras
from splashbench.submission.withheld import Withheld, kept_timesteps, scored_timesteps
from splashbench.version import __version__

#: Protocol v1: the frame rate is the median of at least this many renders.
TIMING_FRAMES = 100


def run_method(
    name: str,
    scene_directory: Path,
    out: Path,
    *,
    preset: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    seed: int = 0,
    device: str = "cpu",
    timeout_seconds: float | None = None,
    timing_frames: int = TIMING_FRAMES,
    replace: bool = False,
    keep_model: bool = True,
    exr: bool = False,
    cache: Path | None = None,
    withheld: Withheld | None = None,
    checkpoints: Sequence[float] | None = None,
    budget: Budget | None = None,
    oracle_geometry: Callable[[Scene], SignedDistance | None] | None = None,
) -> Submission:
    """Run method `name` on the scene and write the submission `out`.

    Args:
        preset: a preset of the method; its first one (the default) when None.
        overrides: single settings on top of the preset.
        timeout_seconds: limit for the fit, and again for the rendering.
        timing_frames: renders to time for frames per second; 0 leaves it out.
        keep_model: keep the fitted model under OUT/model, so that it can be rendered again.
        exr: write the renders also as OpenEXR, for compositing (submission/exr.py).
        cache: a folder for what the runs of one study share (reuse.py); the record says what came from there.
        withheld: timesteps that the method does not see; they are rendered and scored (submission/withheld.py).
        checkpoints: seconds of the fit after which its state is taken, and the test views rendered by it, such as
            `checkpoints.MARKS`.
        budget: what the fit may cost; only limits that the method keeps to (`Method.budgets`).
        oracle_geometry: for the control `oracle` alone, see `write_oracle`.

    Raises SplashbenchError for what is wrong before the method starts; a method that fails gives a status instead.
    """
    scene = Scene.open(scene_directory)
    if withheld and scene.n_frames < 3:
        raise SplashbenchError(f"{scene_directory} has {scene.n_frames} timesteps; to withhold some takes three")
    if withheld and not scored_timesteps(scene.n_frames, withheld):
        raise SplashbenchError(
            f"{scene_directory} has {scene.n_frames} timesteps, and {withheld} leaves none between two that are seen"
        )
    if name == EXTERNAL:
        raise SplashbenchError(
            "`external` is run by commands: splashbench run-external SCENE OUT --name ... --command ..."
        )
    if name == ORACLE:
        if preset or overrides or withheld or checkpoints or budget:
            raise SplashbenchError("the oracle is the truth itself: it has no presets, settings or fit; leave them out")
        from splashbench.harness.oracle import write_oracle

        return write_oracle(scene, out, geometry=oracle_geometry, replace=replace)
    method = load_method(name)
    if device not in method.devices:
        devices = ", ".join(method.devices)
        raise SplashbenchError(f"method {method.id} runs on {devices}, not on {device!r}; leave --device out")
    _require_budgets(method, budget)
    preset = preset or next(iter(method.Config.presets))
    config = method.Config.preset(preset, overrides)
    identity = _identity(
        method,
        preset=preset,
        settings=without_nulls(config.model_dump(mode="json")),
        overrides=override_texts(overrides or {}),
        budget=budget,
        seed=seed,
        device=device,
        scene=scene.name,
        scene_digest=scene.digest,
        withheld=withheld,
    )
    with (
        atomic_directory(out, replace=replace, holds=IDENTITY, inputs=[scene_directory]) as staging,
        tempfile.TemporaryDirectory() as scratch,
    ):
        record = _run_phases(
            Path(scratch),
            staging,
            Request(
                phase="fit",
                method=name,
                scene=str(make_training_copy(scene, Path(scratch, "scene"), kept_timesteps(scene.n_frames, withheld))),
                preset=preset,
                overrides=dict(overrides or {}),
                seed=seed,
                device=device,
                budget_seconds=timeout_seconds,
                scratch=str(_folder(Path(scratch, "scratch"))),
                model=str(_folder(staging / "model")),
                output=str(staging),
                result=str(Path(scratch, "outcome.json")),
                progress=str(Path(scratch, "progress")),
                timing_frames=timing_frames,
                exr=exr,
                cache=str(cache.resolve()) if cache else None,
                times={name: scene.camera_times[name].tolist() for name in scene.test} if withheld else None,
                checkpoints=str(_folder(Path(scratch, "checkpoints"))) if checkpoints else None,
                marks=list(checkpoints or ()),
                budget=budget or Budget(),
            ),
        )
        drop_unwanted(staging, record.status, keep_model)
        require_unchanged(scene, method.id)
        write_cameras(staging, scene, kept_timesteps(scene.n_frames, withheld))
        seal(staging, identity, record)
    return Submission.open(out)


def _require_budgets(method: Method, budget: Budget | None) -> None:
    """Raise SplashbenchError for a limit that the method does not keep to."""
    for name in budget.limits if budget else ():
        if name not in method.budgets:
            kept = ", ".join(sorted(limit.removesuffix("_bytes") for limit in method.budgets)) or "none"
            raise SplashbenchError(
                f"method {method.id} keeps to no budget of {name.removesuffix('_bytes')} (to those of: {kept}); "
                "leave it out, or give settings that make it smaller"
            )


def _identity(method: Method, **run: Any) -> Identity:
    """The submission's identity. What cannot be written raises SplashbenchError before hours go into a fit."""
    try:
        identity = Identity(
            method=method.id,
            method_version=method.version,
            control=method.control,
            mixed=method.mixed,
            splashbench_version=__version__,
            hardware=hardware.describe(),
            **run,
        )
        identity_text(identity)
    except ValidationError as error:
        first = error.errors()[0]
        raise SplashbenchError(
            f"method {method.id!r}: {first['loc'][0]}: {first['msg']}; fix it in {type(method).__name__}"
        ) from None
    except TypeError as error:
        raise SplashbenchError(f"method {method.id!r}: TOML cannot say its settings ({error}); change them") from None
    return identity


def require_unchanged(scene: Scene, method: str) -> None:
    """Raise SplashbenchError where `scene` is no longer what it was: a method's copy of it is links."""
    try:
        same = Scene.open(scene.directory).digest == scene.digest
    except SplashbenchError:
        same = False
    if not same:
        raise SplashbenchError(
            f"{scene.directory} was changed while {method} ran, maybe by the method; restore it and run again"
        )


def _run_phases(scratch: Path, staging: Path, request: Request) -> Record:
    record = Record()
    peak = 0
    device_peak: int | None = None
    seconds: list[float] = []
    for phase in ("fit", "render"):
        label = f"{request.method.rpartition('/')[2][:24]}: {phase}"
        outcome, watched = run_phase(scratch, request.model_copy(update={"phase": phase}), label)
        peak = max(peak, watched.peak_memory_bytes)
        if outcome.peak_device_memory_bytes is not None:
            device_peak = max(device_peak or 0, outcome.peak_device_memory_bytes)
        used = sorted({*record.renderer, *outcome.renderer})
        record = record.model_copy(
            update={"peak_memory_bytes": peak, "peak_device_memory_bytes": device_peak, "renderer": used}
        )
        if outcome.status != Status.OK:
            return record.model_copy(
                update={"status": outcome.status, "reason": outcome.reason, "log_tail": watched.log_tail}
            )
        if phase == "fit":
            static = tree_bytes(Path(request.model, "static"))
            storage = tree_bytes(Path(request.model))
            record = record.model_copy(
                update={
                    "fit_seconds": outcome.seconds,
                    "reused": outcome.reused,
                    "stages": outcome.stages,
                    "notes": outcome.notes,
                    "decisions": outcome.decisions,
                    "checkpoint_seconds": outcome.checkpoint_seconds,
                    "storage_bytes": storage,
                    "dynamic_bytes": storage - static,
                }
            )
            seconds = outcome.checkpoints
    checkpoints = [_checkpoint(scratch, staging, request, k, of_fit) for k, of_fit in enumerate(seconds)]
    return record.model_copy(
        update={
            "checkpoints": checkpoints,
            "render_fps": outcome.render_fps,
            "timed_frames": outcome.timed_frames,
            "primitives_per_frame": outcome.primitives_per_frame,
            "particles_per_frame": particles_per_frame(staging),
        }
    )


def _checkpoint(scratch: Path, staging: Path, request: Request, number: int, seconds: float) -> Checkpoint:
    """Render the test views by the state that the fit had after `seconds`; its model is removed then."""
    name = f"{number:02d}"
    model, folder = Path(str(request.checkpoints), name), f"checkpoints/{name}"
    label = f"{request.method.rpartition('/')[2][:24]}: after {seconds:.0f} s"
    changes = {"phase": "render", "model": str(model), "output": str(_folder(staging / folder)), "timing_frames": 0}
    outcome, _ = run_phase(scratch, request.model_copy(update={**changes, "exr": False, "only_views": True}), label)
    storage = tree_bytes(model)
    dynamic = storage - tree_bytes(model / "static")
    _remove_tree(model)
    if outcome.status != Status.OK:
        _remove_tree(staging / folder)
    return Checkpoint(
        seconds=seconds,
        folder=folder,
        status=outcome.status,
        reason=outcome.reason,
        storage_bytes=storage,
        dynamic_bytes=dynamic,
    )


def particles_per_frame(staging: Path) -> float | None:
    """Mean number of active particles in particles.npz, where there is one."""
    path = staging / "particles.npz"
    return float(Particles.load(path).active.sum(axis=1).mean()) if path.is_file() else None


def run_phase(scratch: Path, request: Request, label: str) -> tuple[Outcome, Watched]:
    """Carry out `request` in a child process. Where it left no outcome, its exit code and log give one."""
    path, result, progress = scratch / "request.json", Path(request.result), Path(request.progress)
    for stale in (result, progress):
        stale.unlink(missing_ok=True)
    write_model(path, request)
    watched = watch(
        child_command(method_process.carry_out, path),
        log=scratch / "log",
        progress=progress,
        label=label,
        timeout_seconds=request.budget_seconds,
    )
    raise_if_disk_was_full(watched.exit_code, watched.log_tail)
    if watched.timed_out:
        outcome = Outcome(status=Status.TIMEOUT, reason=f"the {request.phase} took over {request.budget_seconds:g} s")
    elif result.is_file() and watched.exit_code == 0:
        outcome = read_model(result, Outcome)
    elif watched.exit_code == -9:
        outcome = Outcome(
            status=Status.OUT_OF_MEMORY, reason=f"the {request.phase} was killed (signal 9), as when memory runs out"
        )
    else:
        last = watched.log_tail[-1] if watched.log_tail else "it said nothing"
        outcome = Outcome(
            status=Status.CRASHED, reason=f"the {request.phase} ended with exit code {watched.exit_code}: {last}"
        )
    return outcome, watched


def without_nulls(settings: dict[str, Any]) -> dict[str, Any]:
    """`settings` without null values: TOML has no null, and an absent key says the same."""
    cleaned = {}
    for key, value in settings.items():
        if isinstance(value, dict):
            value = without_nulls(value)
        if value is not None:
            cleaned[key] = value
    return cleaned


def drop_unwanted(staging: Path, status: Status, keep_model: bool) -> None:
    """Remove what a failed run may have written, and a model that nobody wants."""
    if not keep_model or status != Status.OK:
        _remove_tree(staging / "model")
    if status != Status.OK:
        for name in ("renders", "alpha", "exr", "checkpoints"):
            _remove_tree(staging / name)
        for name in ("particles.npz", "geometry.npz"):
            (staging / name).unlink(missing_ok=True)


def _folder(path: Path) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    return path


def _remove_tree(path: Path) -> None:
    import shutil

    shutil.rmtree(path, ignore_errors=True)


def parse_overrides(pairs: list[str]) -> dict[str, Any]:
    """`["iterations=500", "losses.separation=0"]` -> settings; values are JSON where they parse, else text.

    A dotted key reaches into a nested model.
    """
    import json

    settings: dict[str, Any] = {}
    for pair in pairs:
        key, separator, text = pair.partition("=")
        if not separator or not key:
            raise SplashbenchError(f"--set {pair!r} is not KEY=VALUE; see `splashbench methods show METHOD`")
        try:
            value = json.loads(text)
        except (ValueError, RecursionError):
            value = text
        *parents, leaf = key.split(".")
        node = settings
        for parent in parents:
            node = node.setdefault(parent, {})
            if not isinstance(node, dict):
                raise SplashbenchError(f"--set {pair!r} sets a part of {parent}, to which another --set gives a value")
        node[leaf] = value
    return settings


def override_texts(settings: Mapping[str, Any], parent: str = "") -> list[str]:
    """What `parse_overrides` makes `settings` of: `{"losses": {"separation": 0}}` -> `["losses.separation=0"]`."""
    import json

    texts = []
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            texts += override_texts(value, f"{parent}{key}.")
        else:
            texts.append(f"{parent}{key}={value if _is_text(value) else json.dumps(value, default=str)}")
    return texts


def _is_text(value: Any) -> bool:
    """Whether `value` is a string that `parse_overrides` would leave one."""
    import json

    if not isinstance(value, str):
        return False
    try:
        json.loads(value)
    except (ValueError, RecursionError):
        return True
    return False

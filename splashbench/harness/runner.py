"""Running a method on a scene: Scene -> Submission, whatever happens to the method on the way.

Two child processes fit, then render; the copy of the scene that they see holds no test image. The submission is
complete in every case: with renders when the run is `ok`, else with a status and a reason.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from splashbench.errors import SplashbenchError
from splashbench.files import atomic_directory, remove_any, write_model
from splashbench.harness import estimates, hardware
from splashbench.harness.contract import Method
from splashbench.harness.devices import AUTO, CPU, chosen_device
from splashbench.harness.discovery import EXTERNAL, ORACLE, load_method
from splashbench.harness.leftovers import clear_leftovers, held, require_alone, scratch_folder
from splashbench.harness.messages import Request
from splashbench.harness.phases import run_phases
from splashbench.harness.training_copy import make_training_copy
from splashbench.scene import Scene, SignedDistance
from splashbench.submission import (
    IDENTITY,
    Budget,
    Identity,
    Status,
    Submission,
    identity_text,
    seal,
)
from splashbench.submission.cameras import CAMERAS, scene_views
from splashbench.submission.scene_files import write_scene_files
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
    tell: Callable[[str], None] = lambda line: None,
) -> Submission:
    """Run method `name` on the scene and write the submission `out`.

    Args:
        device: "cpu", "cuda", or "auto", see `devices.chosen_device`.
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
        tell: is given lines for the user before the fit starts: what earlier runs left, and how long they took.

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
        fit = preset or overrides or withheld or checkpoints or budget or timeout_seconds or seed
        if fit or exr or not keep_model or device not in (CPU, AUTO):
            raise SplashbenchError(
                "the oracle is the truth itself: it has no presets, settings, seeds, device, model or fit, and no EXR; "
                "leave them out"
            )
        from splashbench.harness.oracle import write_oracle

        return write_oracle(scene, out, geometry=oracle_geometry, replace=replace)
    method = load_method(name)
    device = chosen_device(method, device)
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
        told=scene.stated,
        withheld=withheld,
    )
    kept = kept_timesteps(scene.n_frames, withheld)
    views = scene_views(scene, kept)
    require_alone(out)
    for line in (unmasked_line(scene), *clear_leftovers(out), estimates.estimate(identity, scene, kept)):
        if line:
            tell(line)
    with (
        atomic_directory(out, replace=replace, holds=IDENTITY, inputs=[scene_directory]) as staging,
        scratch_folder() as scratch,
    ):
        with held(staging):
            record = run_phases(
                scratch,
                staging,
                Request(
                    phase="fit",
                    method=name,
                    scene=str(make_training_copy(scene, scratch / "scene", kept)),
                    preset=preset,
                    overrides=dict(overrides or {}),
                    seed=seed,
                    device=device,
                    budget_seconds=timeout_seconds,
                    scratch=str(_folder(scratch / "scratch")),
                    model=str(_folder(staging / "model")),
                    output=str(staging),
                    progress=str(scratch / "progress"),
                    timing_frames=timing_frames,
                    exr=exr,
                    cache=str(cache.resolve()) if cache else None,
                    times={name: scene.camera_times[name].tolist() for name in scene.test} if withheld else None,
                    checkpoints=str(_folder(scratch / "checkpoints")) if checkpoints else None,
                    marks=list(checkpoints or ()),
                    budget=budget or Budget(),
                ),
            )
        drop_unwanted(staging, record.status, keep_model)
        require_unchanged(scene, method.id)
        write_model(staging / CAMERAS, views)
        if record.status == Status.OK:
            write_scene_files(staging, scene)
        seal(staging, identity, record)
    if record.status == Status.OK and record.fit_seconds is not None and cache is None:
        estimates.note(identity, scene, kept, record.fit_seconds)
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
            hardware=hardware.describe(run["device"]),
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


def unmasked_line(scene: Scene) -> str:
    """A warning where test views have no masks, which scoring needs; empty where all have some."""
    without = ", ".join(name for name in scene.test if name in scene.unmasked)
    if not without:
        return ""
    return (
        f"note: test views {without} have no masks, so that this run cannot be scored. Put masks into "
        f"{scene.directory / 'seg'} first: with them it is another scene, on which the method has to run again"
    )


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
    """Remove whatever a failed run has written, and a model that nobody wants."""
    unwanted = staging.glob("*") if status != Status.OK else [] if keep_model else [staging / "model"]
    for path in unwanted:
        remove_any(path)


def _folder(path: Path) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    return path


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

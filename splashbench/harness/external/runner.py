"""Running an external code on a scene by its own commands: Scene -> Submission, in the code's own environment.

The scene is exported as the code reads it, without any test image. Time and memory of the fit command are measured.
Then the test views come from a render command, from the fit command itself, or from an importer of the code's output
(importers.py). As with methods, the submission is complete in every case: with renders, or a status and a reason.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pydantic import ValidationError

from splashbench.errors import SplashbenchError
from splashbench.files import atomic_directory, require_folder_place, write_model
from splashbench.harness import hardware
from splashbench.harness.external.commands import require_command
from splashbench.harness.external.importers import load_importer
from splashbench.harness.external.phases import ExternalCode, ExternalRun
from splashbench.harness.leftovers import clear_leftovers, held, require_alone, scratch_folder
from splashbench.harness.messages import Failure
from splashbench.harness.runner import TIMING_FRAMES, drop_unwanted, require_unchanged, without_nulls
from splashbench.scene import Scene
from splashbench.scene.export import InitialPoints
from splashbench.submission import IDENTITY, Identity, Status, Submission, identity_text, seal
from splashbench.submission.cameras import CAMERAS, scene_views
from splashbench.submission.scene_files import write_scene_files
from splashbench.version import __version__

#: What a submission calls the settings that are in its commands.
PRESET = "external"


def run_external(
    code: ExternalCode,
    scene_directory: Path,
    out: Path,
    *,
    initial_points: Callable[[Scene, int], InitialPoints],
    preset: str | None = None,
    seed: int = 0,
    device: str = "cpu",
    timeout_seconds: float | None = None,
    timing_frames: int = TIMING_FRAMES,
    exr: bool = False,
    replace: bool = False,
    keep_model: bool = True,
    work: Path | None = None,
) -> Submission:
    """Run `code` on the scene and write the submission `out`.

    Args:
        initial_points: gives the points that the export has for the code to start from, of the scene and with at most
            `code.points` of the liquid in each timestep (observe.initial_points).
        preset: how the submission calls the settings that the commands hold.
        seed, device: what the placeholders of these names stand for.
        timeout_seconds: limit for the fit, and again for the rendering.
        timing_frames, exr: of an imported model, as for methods; a render command is not timed.
        keep_model: keep what the fit left under OUT/model (of an imported model, that model).
        work: a folder, absent or empty, that keeps the export, all output and the logs; a temporary one when None.

    Raises SplashbenchError for what is wrong before the code starts; a code that fails gives a status instead.
    """
    _require_runnable(code)
    inputs = [scene_directory, *([code.trained] if code.trained is not None else [])]
    if work is not None:
        _require_apart(work, out, *inputs)
    scene = Scene.open(scene_directory)
    identity = _identity(code, scene, preset or PRESET, seed, device)
    views = scene_views(scene)
    require_alone(out)
    clear_leftovers(out)
    with (
        atomic_directory(out, replace=replace, holds=IDENTITY, inputs=inputs) as staging,
        _workplace(work) as scratch,
    ):
        run = ExternalRun(code, scene, scratch, staging, seed, device, timeout_seconds)
        with held(staging):
            try:
                run.export(initial_points)
                run.fit()
                if code.importer:
                    run.import_model(timing_frames, exr)
                else:
                    run.render()
                    run.take_over(keep_model)
                record = run.record
            except Failure as failure:
                fault = {"status": failure.status, "reason": failure.reason, "log_tail": run.log_tail}
                record = run.record.model_copy(update=fault)
        drop_unwanted(staging, record.status, keep_model)
        require_unchanged(scene, code.name)
        write_model(staging / CAMERAS, views)
        if record.status == Status.OK:
            write_scene_files(staging, scene)
        seal(staging, identity, record)
    return Submission.open(out)


def _require_runnable(code: ExternalCode) -> None:
    if code.render_command and code.importer:
        raise SplashbenchError("a render command and an importer are two ways to the same renders; give one of them")
    if not code.directory.is_dir():
        raise SplashbenchError(f"{code.directory} is not a folder; give the one that the commands are to run in")
    if code.trained is None:
        require_command("--command", code.command, code.shell, code.directory)
    elif code.command:
        raise SplashbenchError("--command and --trained are two ways to the same model; give one of them")
    elif not code.trained.is_dir():
        raise SplashbenchError(f"{code.trained} is not a folder; give the one that the code left its model in")
    elif not (code.importer or code.render_command):
        raise SplashbenchError("--trained needs --import or --render-command: something has to read the model")
    if code.render_command:
        require_command("--render-command", code.render_command, code.shell, code.directory)
    if code.importer:
        importer = load_importer(code.importer)
        if code.format not in importer.formats:
            formats = ", ".join(importer.formats)
            raise SplashbenchError(
                f"importer {importer.id} reads what was trained on {formats}, not on {code.format}; change --format"
            )


def _identity(code: ExternalCode, scene: Scene, preset: str, seed: int, device: str) -> Identity:
    settings = {
        "command": code.command or None,
        "trained": True if code.trained is not None else None,
        "render_command": code.render_command,
        "importer": code.importer,
        "format": code.format,
        "points": code.points,
        "blank_test_images": code.blank_test_images,
        "masks": code.masks,
    }
    try:
        identity = Identity(
            method=code.name,
            method_version=code.version,
            mixed=code.mixed or bool(code.importer and load_importer(code.importer).mixed),
            preset=preset,
            settings=without_nulls(settings),
            seed=seed,
            device=device,
            scene=scene.name,
            scene_digest=scene.digest,
            told=scene.stated,
            splashbench_version=__version__,
            hardware=hardware.describe(device),
        )
    except ValidationError as error:
        first = error.errors()[0]
        raise SplashbenchError(f"{first['loc'][0]} {first['input']!r}: {first['msg']}; give another") from None
    try:
        identity_text(identity).encode("utf-8")
    except UnicodeEncodeError:
        raise SplashbenchError("a command or name is no UTF-8, as submission.toml has to be; give another") from None
    return identity


def _require_apart(work: Path, *others: Path) -> None:
    for other in others:
        a, b = Path(work).resolve(), Path(other).resolve()
        if a.is_relative_to(b) or b.is_relative_to(a):
            raise SplashbenchError(f"{work} and {other} lie within one another; give --work a place of its own")


@contextmanager
def _workplace(work: Path | None) -> Iterator[Path]:
    """A folder for everything on the way; `work` stays, a temporary one goes."""
    if work is None:
        with scratch_folder() as scratch:
            yield scratch
        return
    require_folder_place(work)
    if work.exists() and any(work.iterdir()):
        raise SplashbenchError(f"{work} is not empty; give a new folder to work in")
    work.mkdir(parents=True, exist_ok=True)
    yield work.resolve()

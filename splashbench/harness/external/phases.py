"""The phases of running an external code: export, fit, then renders by its own command or by an importer.

Each phase adds what it measured to the record, or raises Failure with the status that the code's fault has.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splashbench.files import remove_any, tree_bytes
from splashbench.harness.external.collection import collect
from splashbench.harness.external.commands import command_line
from splashbench.harness.messages import Failure, Request, lacks_memory
from splashbench.harness.phases import particles_per_frame, run_phase
from splashbench.harness.training_copy import make_training_copy
from splashbench.harness.watched_process import Watched, watch
from splashbench.scene import Scene
from splashbench.scene.export import TEST_VIEWS, InitialPoints, export_scene
from splashbench.submission import Record, Status

#: Deformable-3DGS looks at the parent's name to tell which kind of nerfies dataset it is given.
_PARENT = "NeRF"
_KILLED = (-9, 137)  # the second as a shell tells it


@dataclass(frozen=True)
class ExternalCode:
    """A code and how to run it.

    Attributes:
        name, version, mixed: what the submission says of the method (docs/submission_format.md).
        format: of the export it trains on, one of scene.export.FORMATS.
        command: fits the scene; placeholders are those of commands.PLACEHOLDERS. "" with `trained`.
        trained: a folder that the command left as `{out}` earlier, for an importer or `render_command` to read. The
            fit is then not measured. None where `command` is run.
        render_command: writes the test views; None where `command` does, or where an importer reads its output.
        importer: an importer's name, or None.
        shell: whether the commands are for /bin/sh, with pipes and variables, rather than a program and arguments.
        directory: where the commands run.
        blank_test_images, masks, points: of the export; see `export_scene`, and of `run_external` for the points.
    """

    name: str
    command: str
    format: str
    trained: Path | None = None
    version: str = "1"
    mixed: bool = False
    render_command: str | None = None
    importer: str | None = None
    shell: bool = False
    directory: Path = Path()
    blank_test_images: bool = False
    masks: bool = False
    points: int = 2000


@dataclass
class ExternalRun:
    """One run under way.

    Attributes:
        scratch: a folder for all that the code is given and leaves; staging: of the submission.
        record: what was measured so far. log_tail: last lines of the command that ran last.
    """

    code: ExternalCode
    scene: Scene
    scratch: Path
    staging: Path
    seed: int
    device: str
    timeout_seconds: float | None
    record: Record = field(default_factory=Record)
    log_tail: list[str] = field(default_factory=list)
    _values: dict[str, str] = field(default_factory=dict)

    @property
    def exported(self) -> Path:
        """The scene as the code sees it."""
        return self.scratch / _PARENT / self.scene.name

    @property
    def output(self) -> Path:
        """Where the code leaves its model, or left it once. An importer only reads there."""
        if self.code.trained is not None and self.code.importer:
            return self.code.trained.resolve()
        return self.scratch / "out"

    @property
    def into(self) -> Path:
        """Where the code leaves its renders."""
        return self.scratch / "into"

    def export(self, initial_points: Callable[[Scene, int], InitialPoints]) -> None:
        """Export the scene without test images, and make the folders that the commands are given."""
        for folder in (self.output, self.into):
            folder.mkdir(exist_ok=True)  # a trained model is there already
        facts = export_scene(
            self.scene,
            self.exported,
            self.code.format,
            initial_points(self.scene, self.code.points),
            test_images="blank" if self.code.blank_test_images else "none",
            masks=self.code.masks,
        )
        self._values = {
            "scene": str(self.exported),
            "out": str(self.output),
            "into": str(self.into),
            "views": str(self.exported / TEST_VIEWS),
            "seed": str(self.seed),
            "device": self.device,
            "frames": str(self.scene.n_frames),
            "seconds": repr(facts.time_span_seconds),
            "progress": str(self.scratch / "progress"),
        }

    def fit(self) -> None:
        """Run the command that fits, and measure it; or take over what it left once."""
        if self.code.trained is None:
            watched = self._command("fit", self.code.command)
            self._note(fit_seconds=watched.seconds)
        elif not self.code.importer:
            _copy_plain(self.code.trained, self.output)  # the command that renders may write there
        self._note(**_storage(self.output))

    def render(self) -> None:
        """Run the command that renders, where it is another."""
        if self.code.render_command:
            self._command("render", self.code.render_command)

    def take_over(self, keep_model: bool) -> None:
        """Check the renders and write them into the submission; with `keep_model` the model too."""
        collect(self.into, self.staging, self.scene)
        if keep_model:
            _copy_plain(self.output, self.staging / "model")
        self._note(particles_per_frame=particles_per_frame(self.staging))

    def import_model(self, timing_frames: int, exr: bool) -> None:
        """Read the output by the importer and render it as a method's model: checked, timed, counted."""
        model = self.staging / "model"
        model.mkdir()
        copy = make_training_copy(self.scene, self.scratch / "training")
        training = Scene.open(copy).training()
        request = Request(
            phase="import",
            method=self.code.name,
            scene=str(copy),
            preset="",
            overrides={},
            seed=self.seed,
            device="cpu",  # of the importer, not of the code
            budget_seconds=self.timeout_seconds,
            scratch=str(self.scratch),
            model=str(model),
            output=str(self.staging),
            progress=str(self.scratch / "progress"),
            timing_frames=timing_frames,
            exr=exr,
            importer=self.code.importer,
            source=str(self.output),
            export=str(self.exported),
        )
        for phase in ("import", "render"):
            of_phase = request.model_copy(update={"phase": phase})
            outcome, watched = run_phase(self.scratch, of_phase, f"{self.code.name[:24]}: {phase}", training)
            self._watched(watched)
            if outcome.status != Status.OK:
                raise Failure(outcome.status, outcome.reason)
        self._note(
            render_fps=outcome.render_fps,
            timed_frames=timing_frames,
            primitives_per_frame=outcome.primitives_per_frame,
            particles_per_frame=particles_per_frame(self.staging),
            renderer=outcome.renderer,
            **_storage(model),
        )

    def _command(self, phase: str, command: str) -> Watched:
        """Run `command` under observation. Raises Failure unless it comes through."""
        progress = self.scratch / "progress"
        remove_any(progress)
        watched = watch(
            command_line(command, self._values, self.code.shell, self.code.directory.resolve()),
            log=self.scratch / f"{phase}.log",
            progress=progress,
            label=f"{self.code.name[:24]}: {phase}",
            timeout_seconds=self.timeout_seconds,
            show_log=True,
        )
        self._watched(watched)
        if watched.timed_out:
            raise Failure(Status.TIMEOUT, f"the {phase} took over {self.timeout_seconds:g} s")
        if watched.exit_code in _KILLED:
            raise Failure(Status.OUT_OF_MEMORY, f"the {phase} was killed (signal 9), as when memory runs out")
        if watched.exit_code != 0:
            lacking = [line for line in watched.log_tail if lacks_memory(line)]
            last = (lacking or watched.log_tail or ["it said nothing"])[-1]
            raise Failure(
                Status.OUT_OF_MEMORY if lacking else Status.CRASHED,
                f"the {phase} ended with exit code {watched.exit_code}: {last}",
            )
        return watched

    def _watched(self, watched: Watched) -> None:
        self.log_tail = watched.log_tail
        if self.code.trained is not None:
            return  # a rendering's memory would pass for the fit's
        self._note(peak_memory_bytes=max(self.record.peak_memory_bytes or 0, watched.peak_memory_bytes))

    def _note(self, **measured: Any) -> None:
        self.record = self.record.model_copy(update=measured)


def _storage(model: Path) -> dict[str, int]:
    """Bytes of a model, and of what changes over time."""
    storage = tree_bytes(model)
    return {"storage_bytes": storage, "dynamic_bytes": storage - tree_bytes(model / "static")}


def _copy_plain(source: Path, target: Path) -> None:
    """Copy the regular files below `source`; links, which could lead anywhere, and devices stay behind."""
    for root, _, names in os.walk(source):
        for name in names:
            path = Path(root, name)
            if path.is_symlink() or not path.is_file():
                continue
            place = target / path.relative_to(source)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, place)

"""The evidence of a conformance test: runs of the method, each made when a check asks for it, and then kept."""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from splashbench.adapter.discovery import ORACLE, load_method
from splashbench.adapter.messages import DISK_FULL_EXIT
from splashbench.adapter.process import Watched, run_watched
from splashbench.adapter.runner import run_method
from splashbench.conformance import scenes
from splashbench.conformance.messages import Answer, Order
from splashbench.conformance.opening import Opening
from splashbench.conformance.stopping import MARK, Stopped, as_pairs, processes_left, stop_run
from splashbench.conformance.touched import Touch, read_touched
from splashbench.errors import DiskFullError, SplashbenchError
from splashbench.files import read_model, write_model
from splashbench.scene import Scene
from splashbench.submission import Status, check_submission
from splashbench.synth.balls import write_balls_scene

SEED, OTHER_SEED = 0, 1
#: Allowed to a process for starting, on top of half a fit, before its time limit is up.
STARTING_SECONDS = 3.0
#: The preset for trying a method, where it has one of this name.
_QUICK = "quick"


@dataclass
class Ran:
    """An ordinary run through the harness: its status, why, and the model that it kept."""

    status: str
    reason: str
    fit_seconds: float
    seconds: float  # with starting, rendering and writing
    model: Path


class Trial:
    """One method with settings on one scene. Use `trial`.

    Attributes:
        name, method, preset, overrides, config: the method as the user gave it, and with what settings.
        touches: what the method touched of the scene, or wrote elsewhere, in any run so far.
        opened: test views that were opened by any process. watched: whether none can have been missed.
        left: processes that outlived their run, each with the run's name.
    """

    def __init__(
        self,
        work: Path,
        name: str,
        scene: Path | None,
        preset: str | None,
        overrides: Mapping[str, Any],
        device: str,
        timeout_seconds: float,
    ) -> None:
        if name == ORACLE:
            raise SplashbenchError("the oracle is written by the harness and is no method; test another")
        self.method = load_method(name)
        # A file given by a relative path is the same one wherever a process starts.
        self.name = f"{Path(name.rpartition(':')[0]).resolve()}:{name.rpartition(':')[2]}" if ":" in name else name
        presets = self.method.Config.presets
        self.preset = preset or (_QUICK if _QUICK in presets else next(iter(presets)))
        self.overrides = dict(overrides)
        self.config = self.method.Config.preset(self.preset, self.overrides)
        if device not in self.method.devices:
            known = ", ".join(self.method.devices)
            raise SplashbenchError(f"method {self.method.id} runs on {known}, not on {device!r}; leave --device out")
        self.device, self.timeout_seconds = device, timeout_seconds
        self.touches: dict[Touch, None] = {}
        self.opened: dict[Path, None] = {}
        self.watched = True
        self.left: list[str] = []
        self._work, self._source = work, scene
        self._mark = uuid.uuid4().hex
        self._count = 0
        if scene is not None:
            _ = Scene.open(scene).digest  # whatever is missing is told by the name that the user knows

    @cached_property
    def small(self) -> Path:
        """The made-up scene of balls."""
        write_balls_scene(self._work / "small" / "balls")
        return self._work / "small" / "balls"

    @cached_property
    def ordinary(self) -> scenes.Place:
        """The scene as it is."""
        return scenes.ordinary(self._copy(self._source or self.small, "scene"), self._folder("scene"))

    @cached_property
    def hidden(self) -> scenes.Place:
        """The scene with test views and truth made unreadable."""
        return scenes.hidden(self._copy(self._source or self.small, "hidden"), self._folder("hidden"))

    @cached_property
    def before(self) -> dict[str, str]:
        """Contents of both scenes, before a method has seen them."""
        return self.contents()

    def contents(self) -> dict[str, str]:
        """Contents of both scenes now."""
        return {
            f"{kind} {name}": digest
            for kind, place in (("scene", self.ordinary), ("hidden", self.hidden))
            for name, digest in place.contents().items()
        }

    @cached_property
    def ran(self) -> Ran:
        """The run that a user would make, on the scene as it is."""
        _ = self.before
        out, start = self._folder("run") / "submission", time.monotonic()
        ran = Ran("refused", "", 0.0, 0.0, out / "model")
        try:
            with self._process("the run"):
                submission = run_method(
                    self.name,
                    self.ordinary.scene,
                    out,
                    preset=self.preset,
                    overrides=self.overrides,
                    seed=SEED,
                    device=self.device,
                    timeout_seconds=self.timeout_seconds,
                    timing_frames=0,
                )
        except DiskFullError:
            raise
        except SplashbenchError as error:
            return replace(ran, reason=str(error))
        status, reason = submission.status.value, submission.reason
        if submission.status == Status.OK and (faults := check_submission(out, Scene.open(self.ordinary.scene))):
            status, reason = "faulty", faults[0]
        return replace(
            ran,
            status=status,
            reason=reason,
            fit_seconds=submission.record.fit_seconds or 0.0,
            seconds=time.monotonic() - start,
        )

    @cached_property
    def fitted(self) -> Answer:
        """Fitted with the test views hidden; saved, then rendered in the process that fitted."""
        return self._child("fit", self.hidden, self._model("fitted"))

    @cached_property
    def saved(self) -> Path:
        """The model that `fitted` saved, in another place than where it was saved."""
        _ = self.fitted
        return self._model("fitted").rename(self._work / "models" / "moved")

    @cached_property
    def loaded(self) -> Answer:
        """`saved` loaded in a fresh process, with the test views hidden."""
        return self._child("load", self.hidden, self.saved)

    @cached_property
    def reloaded(self) -> Answer:
        """The model of the ordinary run, loaded in a fresh process on the scene as it is."""
        return self._child("load", self.ordinary, self.ran.model)

    @cached_property
    def refitted(self) -> Answer:
        """Another fit like `fitted`, with the same seed."""
        return self._child("fit", self.hidden, self._model("refitted"))

    @cached_property
    def other_seed(self) -> Answer:
        """A fit with another seed."""
        return self._child("fit", self.hidden, self._model("other_seed"), seed=OTHER_SEED)

    @cached_property
    def one_frame(self) -> Answer:
        """A fit of a small scene of one timestep."""
        scene = self._copy(self.small, "one_frame")
        scenes.keep_first_frame(scene)
        return self._child("fit", scenes.ordinary(scene, scene.parent), self._model("one_frame"))

    @cached_property
    def no_liquid(self) -> Answer:
        """A fit of a small scene whose masks are all empty."""
        scene = self._copy(self.small, "no_liquid")
        scenes.empty_masks(scene)
        return self._child("fit", scenes.ordinary(scene, scene.parent), self._model("no_liquid"))

    def known(self) -> Ran | None:
        """The ordinary run, where there has been a good one; asking makes none."""
        ran: Ran | None = self.__dict__.get("ran")  # where cached_property keeps it
        return ran if ran is not None and ran.status == Status.OK.value else None

    def stopped(self, how: signal.Signals | None, report: int) -> tuple[Stopped, Path]:
        """A run held up at its progress report number `report` and stopped by the signal `how`, or by its time limit;
        and the place of its submission."""
        name = how.name if how else "timeout"
        work = self._folder(f"stopped_{name}")
        out = self._folder(f"stopped_{name}/out") / "submission"
        arguments = [str(self.ordinary.scene), str(out), "--preset", self.preset, "--seed", str(SEED)]
        arguments += ["--device", self.device, "--timing-frames", "0"]
        for pair in as_pairs(self.overrides):
            arguments += ["--set", pair]
        limit = self.timeout_seconds
        if how is None:
            limit = round(STARTING_SECONDS + self.fitted.fit_seconds / 2, 1)
            arguments += ["--timeout", f"{limit:g}"]
        with self._process(f"the run stopped by {name}"):
            stopped = stop_run(
                arguments,
                method=self.name,
                report=report,
                work=work,
                signum=how,
                timeout_seconds=limit,
                label=f"{self.method.id}: stopped by {name}",
            )
        return stopped, out

    def _child(self, do: Literal["fit", "load"], place: scenes.Place, model: Path, *, seed: int = SEED) -> Answer:
        _ = self.before
        self._count += 1
        work = self._folder(f"child_{self._count}")
        scratch = self._folder(f"child_{self._count}/scratch")
        order = Order(
            do=do,
            harness=os.getpid(),
            method=self.name,
            preset=self.preset,
            overrides=self.overrides,
            seed=seed,
            device=self.device,
            budget_seconds=self.timeout_seconds,
            view=str(place.view),
            scene=str(place.scene),
            model=str(model),
            scratch=str(scratch),
            answer=str(work / "answer.json"),
            progress=str(work / "progress"),
            touched=str(work / "touched"),
        )
        write_model(work / "order.json", order)
        with self._process(f"the process to {do}"), Opening(list(place.baits)) as opening:
            watched = run_watched(
                ["-m", "splashbench.conformance.child", str(work / "order.json")],
                log=work / "log",
                progress=work / "progress",
                label=f"{self.method.id}: {do}",
                timeout_seconds=self.timeout_seconds,
                keep_bar=False,
            )
        self.touches |= dict.fromkeys(read_touched(work / "touched"))
        self.opened |= dict.fromkeys(opening.seen)
        self.watched &= opening.complete or not place.baits
        shutil.rmtree(scratch, ignore_errors=True)  # a model that needs it is not whole
        if watched.exit_code == DISK_FULL_EXIT:
            raise DiskFullError(watched.log_tail[-1] if watched.log_tail else "the disk is full; free some space")
        if watched.exit_code == 0 and (work / "answer.json").is_file():
            return read_model(work / "answer.json", Answer)
        return Answer(stage=do, reason=self._died(watched))

    def _died(self, watched: Watched) -> str:
        if watched.timed_out:
            return f"it took over {self.timeout_seconds:g} s; give a longer --timeout, or smaller settings"
        last = watched.log_tail[-1] if watched.log_tail else "it said nothing"
        return f"its process ended with exit code {watched.exit_code}: {last}"

    @contextmanager
    def _process(self, what: str) -> Iterator[None]:
        """Processes that start meanwhile are marked, and looked for afterwards."""
        temporary = self._folder("temporary")
        ours = {MARK: self._mark, "TMPDIR": str(temporary)}
        before = {name: os.environ.get(name) for name in ours}
        os.environ.update(ours)
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value
            self.left += [f"{line}, after {what}" for line in processes_left(self._mark)]

    def _folder(self, name: str) -> Path:
        folder = self._work / name
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def _copy(self, scene: Path, name: str) -> Path:
        return scenes.copy_scene(scene, self._folder(name))

    def _model(self, name: str) -> Path:
        return self._folder(f"models/{name}")


@contextmanager
def trial(name: str, **options: Any) -> Iterator[Trial]:
    """A `Trial` in a temporary folder, which disappears afterwards."""
    with tempfile.TemporaryDirectory(prefix="splashbench-conformance-") as work:
        yield Trial(Path(work).resolve(), name, **options)

"""The evidence of a conformance test: runs of the method, each made when a check asks for it, and then kept."""

from __future__ import annotations

import signal
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from splashbench.errors import DiskFullError, SplashbenchError
from splashbench.harness.conformance import scenes
from splashbench.harness.conformance.bench import Bench
from splashbench.harness.conformance.messages import Answer, Subject
from splashbench.harness.conformance.stopping import Stopped, as_pairs, stop_run
from splashbench.harness.discovery import EXTERNAL, ORACLE, load_method
from splashbench.harness.runner import run_method
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
        bench: where its processes run, and what they were seen to do.
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
        if name in (ORACLE, EXTERNAL):
            raise SplashbenchError(f"{name} is no method that could be tested; see `splashbench methods list`")
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
        self.bench, self._source = Bench(work), scene
        self._subject = Subject(
            id=self.method.id,
            method=self.name,
            preset=self.preset,
            overrides=self.overrides,
            device=device,
            timeout_seconds=timeout_seconds,
        )
        if scene is not None:
            _ = Scene.open(scene).digest  # whatever is missing is told by the name that the user knows

    @cached_property
    def small(self) -> Path:
        """The made-up scene of balls."""
        return write_balls_scene(self.bench.folder("small") / "balls").directory

    @cached_property
    def ordinary(self) -> scenes.Place:
        """The scene as it is."""
        return scenes.ordinary(self._copy(self._source or self.small, "scene"), self.bench.folder("scene"))

    @cached_property
    def hidden(self) -> scenes.Place:
        """The scene with test views and truth made unreadable."""
        return scenes.hidden(self._copy(self._source or self.small, "hidden"), self.bench.folder("hidden"))

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
        out, start = self.bench.folder("run") / "submission", time.monotonic()
        ran = Ran("refused", "", 0.0, 0.0, out / "model")
        try:
            with self.bench.process("the run"):
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
        return self._fit(self.hidden, "fitted")

    @cached_property
    def saved(self) -> Path:
        """The model that `fitted` saved, in another place than where it was saved."""
        _ = self.fitted
        models = self.bench.folder("models")
        return (models / "fitted").rename(models / "moved")

    @cached_property
    def loaded(self) -> Answer:
        """`saved` loaded in a fresh process, with the test views hidden."""
        return self._load(self.hidden, self.saved)

    @cached_property
    def reloaded(self) -> Answer:
        """The model of the ordinary run, loaded in a fresh process on the scene as it is."""
        return self._load(self.ordinary, self.ran.model)

    @cached_property
    def refitted(self) -> Answer:
        """Another fit like `fitted`, with the same seed."""
        return self._fit(self.hidden, "refitted")

    @cached_property
    def other_seed(self) -> Answer:
        """A fit with another seed."""
        return self._fit(self.hidden, "other_seed", seed=OTHER_SEED)

    @cached_property
    def one_frame(self) -> Answer:
        """A fit of a small scene of one timestep."""
        scene = self._copy(self.small, "one_frame")
        scenes.keep_first_frame(scene)
        return self._fit(scenes.ordinary(scene, scene.parent), "one_frame")

    @cached_property
    def no_liquid(self) -> Answer:
        """A fit of a small scene whose masks are all empty."""
        scene = self._copy(self.small, "no_liquid")
        scenes.empty_masks(scene)
        return self._fit(scenes.ordinary(scene, scene.parent), "no_liquid")

    def known(self) -> Ran | None:
        """The ordinary run, where there has been a good one; asking makes none."""
        ran: Ran | None = self.__dict__.get("ran")  # where cached_property keeps it
        return ran if ran is not None and ran.status == Status.OK.value else None

    def stopped(self, how: signal.Signals | None, report: int) -> tuple[Stopped, Path]:
        """A run held up at its progress report number `report` and stopped by the signal `how`, or by its time limit;
        and the place of its submission."""
        name = how.name if how else "timeout"
        work = self.bench.folder(f"stopped_{name}")
        out = self.bench.folder(f"stopped_{name}/out") / "submission"
        arguments = [str(self.ordinary.scene), str(out), "--preset", self.preset, "--seed", str(SEED)]
        arguments += ["--device", self.device, "--timing-frames", "0"]
        for pair in as_pairs(self.overrides):
            arguments += ["--set", pair]
        limit = self.timeout_seconds
        if how is None:
            limit = round(STARTING_SECONDS + self.fitted.fit_seconds / 2, 1)
            arguments += ["--timeout", f"{limit:g}"]
        with self.bench.process(f"the run stopped by {name}"):
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

    def _fit(self, place: scenes.Place, name: str, seed: int = SEED) -> Answer:
        _ = self.before
        return self.bench.child("fit", self._subject, seed, place, self.bench.folder(f"models/{name}"))

    def _load(self, place: scenes.Place, model: Path) -> Answer:
        _ = self.before
        return self.bench.child("load", self._subject, SEED, place, model)

    def _copy(self, scene: Path, name: str) -> Path:
        return scenes.copy_scene(scene, self.bench.folder(name))


@contextmanager
def trial(name: str, **options: Any) -> Iterator[Trial]:
    """A `Trial` in a temporary folder, which disappears afterwards."""
    with tempfile.TemporaryDirectory(prefix="splashbench-conformance-") as work:
        yield Trial(Path(work).resolve(), name, **options)

"""The evidence of a conformance test: runs of the method, each made when a check first asks for it."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from splashbench.errors import DiskFullError, SplashbenchError
from splashbench.harness.conformance import scene_copies
from splashbench.harness.conformance.bench import Bench
from splashbench.harness.conformance.report import NotTested
from splashbench.harness.conformance.scene_copies import SceneCopy
from splashbench.harness.conformance.subject import Answer, Subject
from splashbench.harness.devices import chosen_device
from splashbench.harness.discovery import EXTERNAL, ORACLE, load_method
from splashbench.harness.runner import run_method
from splashbench.scene import Scene
from splashbench.submission import Budget, Record, Status, check_submission
from splashbench.synth.balls import write_balls_scene

SEED, OTHER_SEED = 0, 1
#: The preset for trying a method, where it has one of this name.
_QUICK = "quick"
#: When states are taken, as shares of the fit; one of them early, since methods tend to change their ways.
_CHECKPOINTS = (0.05, 0.6)
#: Of what a run without limits took, as much as a run with limits may take.
_BUDGET_SHARE = 0.6
#: Fits that may take fewer seconds than these do hardly more than start.
_LEAST_SECONDS = 2.0


@dataclass
class OrdinaryRun:
    """A run through the harness: its status and reason, and the model that it left. seconds: rendering included.
    record: None where there was no run."""

    status: str
    reason: str
    seconds: float
    model: Path
    record: Record | None = None

    @property
    def ok(self) -> bool:
        return self.status == Status.OK.value

    @property
    def fit_seconds(self) -> float:
        """Of the fit; 0 where it was not measured."""
        return (self.record.fit_seconds if self.record else None) or 0.0


class Evidence:
    """What one method with settings does on one scene.

    Attributes:
        name, method, preset, overrides, config: the method as the user gave it, and with what settings.
        bench: where its processes run, and what they were seen to do.

    Raises SplashbenchError where there is no such method, preset, setting, device or scene.
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
        self.device, self.timeout_seconds = chosen_device(self.method, device), timeout_seconds
        self.bench, self._source = Bench(work), scene
        self._subject = Subject(
            id=self.method.id,
            method=self.name,
            preset=self.preset,
            overrides=self.overrides,
            device=self.device,
            timeout_seconds=timeout_seconds,
        )
        if scene is not None:
            _ = Scene.open(scene).digest  # whatever is missing is named as the user knows it

    @cached_property
    def small(self) -> Path:
        """The synthetic scene of balls."""
        return write_balls_scene(self.bench.folder("small") / "balls").directory

    @cached_property
    def ordinary(self) -> SceneCopy:
        """The scene as it is."""
        return scene_copies.ordinary(self._copy(self._source or self.small, "scene"), self.bench.folder("scene"))

    @cached_property
    def hidden(self) -> SceneCopy:
        """The scene with test views and truth made unreadable."""
        return scene_copies.hidden(self._copy(self._source or self.small, "hidden"), self.bench.folder("hidden"))

    @cached_property
    def before(self) -> dict[str, str]:
        """Contents of both scenes, before a method has seen them."""
        return self.contents()

    def contents(self) -> dict[str, str]:
        """Contents of both scenes now."""
        return {
            f"{kind} {name}": digest
            for kind, copy in (("scene", self.ordinary), ("hidden", self.hidden))
            for name, digest in copy.contents().items()
        }

    @cached_property
    def run(self) -> OrdinaryRun:
        """The run that a user would make, on the scene as it is."""
        return self._run("run", "the run")

    @cached_property
    def checkpointed(self) -> OrdinaryRun:
        """The same run, with states taken on its way."""
        marks = [share * self.run.fit_seconds for share in _CHECKPOINTS]
        return self._run("checkpointed", "the run with checkpoints", marks)

    @cached_property
    def budget(self) -> Budget:
        """Less than the ordinary run took, of the seconds and bytes that the method keeps to; None for what cannot be
        tried: fits that are short already, and what was not measured."""
        record = self.run.record
        if record is None or not self.run.ok:
            return Budget()
        keeps, seconds, storage = self.method.budgets, record.fit_seconds, record.storage_bytes
        seconds = _BUDGET_SHARE * seconds if seconds and "seconds" in keeps else None
        return Budget(
            seconds=seconds if seconds and seconds >= _LEAST_SECONDS else None,
            storage_bytes=math.ceil(_BUDGET_SHARE * storage) if storage and "storage_bytes" in keeps else None,
        )

    @cached_property
    def budgeted(self) -> OrdinaryRun:
        """The same run, with that budget."""
        return self._run("budgeted", "the run with a budget", budget=self.budget)

    @cached_property
    def budgeted_again(self) -> OrdinaryRun:
        """And once more: what else a machine does makes one fit slower than another."""
        return self._run("budgeted_again", "the second run with a budget", budget=self.budget)

    def _run(
        self, name: str, what: str, checkpoints: Sequence[float] | None = None, budget: Budget | None = None
    ) -> OrdinaryRun:
        _ = self.before
        out, start = self.bench.folder(name) / "submission", time.monotonic()
        run = OrdinaryRun("refused", "", 0.0, out / "model")
        try:
            with self.bench.process(what):
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
                    checkpoints=checkpoints,
                    budget=budget,
                )
        except DiskFullError:
            raise
        except SplashbenchError as error:
            return replace(run, reason=str(error))
        status, reason = submission.status.value, submission.reason
        if submission.status == Status.OK and (faults := check_submission(out, Scene.open(self.ordinary.scene))):
            status, reason = "faulty", faults[0]
        return replace(
            run,
            status=status,
            reason=reason,
            seconds=time.monotonic() - start,
            record=submission.record,
        )

    def good_run(self) -> OrdinaryRun | None:
        """The ordinary run, where there has been one that is ok; asking makes none."""
        run: OrdinaryRun | None = self.__dict__.get("run")  # where cached_property keeps it
        return run if run is not None and run.ok else None

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
        return self._load(self.ordinary, self.run.model)

    @cached_property
    def reloaded_checkpointed(self) -> Answer:
        """The model that the run with checkpoints left, loaded likewise."""
        return self._load(self.ordinary, self.checkpointed.model)

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
        scene_copies.keep_first_frame(scene)
        return self._fit(scene_copies.ordinary(scene, scene.parent), "one_frame")

    @cached_property
    def no_liquid(self) -> Answer:
        """A fit of a small scene whose masks are all empty."""
        scene = self._copy(self.small, "no_liquid")
        scene_copies.empty_masks(scene)
        return self._fit(scene_copies.ordinary(scene, scene.parent), "no_liquid")

    def _fit(self, scene: SceneCopy, name: str, seed: int = SEED) -> Answer:
        _ = self.before
        return self.bench.child("fit", self._subject, seed, scene, self.bench.folder(f"models/{name}"))

    def _load(self, scene: SceneCopy, model: Path) -> Answer:
        _ = self.before
        return self.bench.child("load", self._subject, SEED, scene, model)

    def _copy(self, scene: Path, name: str) -> Path:
        return scene_copies.copy_scene(scene, self.bench.folder(name))


def complete(answer: Answer, name: str) -> Answer:
    """`answer`; raises NotTested where the process `name` ended on the way."""
    if not answer.done:
        raise NotTested(f"{name} ended in {answer.ended_in}: {answer.reason}")
    return answer


def complete_fit(evidence: Evidence) -> Answer:
    """The fit without test views; raises NotTested where it failed."""
    return complete(evidence.fitted, "the fit")


def differences(one: Mapping[str, str], other: Mapping[str, str], than: str) -> list[str]:
    """A line on what differs between two sets of digests, the second one called `than`; none where nothing does."""
    names = [name for name, digest in one.items() if other.get(name) != digest]
    more = f", as {len(names) - 1} more do" if names[1:] else ""
    return [f"{names[0]} differs {than}{more}"] if names else []

"""The method contract: what a reconstruction method implements, and what it is given.

A method sees training views only; test views reach it as poses and times. It runs in a child process. The harness,
never the method, measures time, memory, bytes and frame rate. A crash, a NaN, a hang or a lack of memory becomes a
recorded status. CONTRIBUTING.md shows a complete method in one file.
"""

from __future__ import annotations

import difflib
import textwrap
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from splashbench.errors import SplashbenchError
from splashbench.harness.checkpoints import Checkpoints
from splashbench.scene import Camera, Gaussians, Particles, SignedDistance, TrainingScene, VelocityField
from splashbench.submission.budget import Budget
from splashbench.submission.decisions import MAX_DECISIONS, Decision
from splashbench.submission.decisions import MAX_RUNGS as MAX_RUNGS
from splashbench.submission.decisions import Rung as Rung
from splashbench.submission.identity import MAX_NOTE, MAX_NOTES

T = TypeVar("T")
U = TypeVar("U")


@dataclass(frozen=True)
class Support:
    """Whether a method can take a scene, and if not, why (shown to the user)."""

    ok: bool
    reason: str = ""


@dataclass
class Render:
    """One view at one instant.

    Attributes:
        rgb: [H, W, 3] float32, sRGB in [0, 1]: liquid and background together.
        alpha: [H, W] float32 in [0, 1]: opacity of the liquid alone.
    """

    rgb: NDArray[np.float32]
    alpha: NDArray[np.float32]


@dataclass
class Run:
    """What the harness hands a method besides the scene.

    Attributes:
        seed: every random choice follows from it.
        device: "cpu", or a device the method's framework knows, such as "cuda".
        directory: scratch space, removed after the run.
        budget_seconds: the time after which the harness stops the fit, or None. A method may use less.
        budget: what the fit may cost, as far as the method takes budgets (`Method.budgets`).
        cache: a folder for parts that runs of one study share, see `reuse`; None in ordinary runs.
        reused: parts that came from there, and the seconds their fit took in an earlier run.
        stages: seconds of the fit's stages, see `stage`.
        notes: what the method found out and went by, see `note`.
        decisions: what the method decided by itself, see `decide`.
    """

    seed: int = 0
    device: str = "cpu"
    directory: Path = Path()
    budget_seconds: float | None = None
    budget: Budget = field(default_factory=Budget)
    cache: Path | None = None
    reused: dict[str, float] = field(default_factory=dict)
    stages: dict[str, float] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    decisions: list[Decision] = field(default_factory=list)
    _overhead_seconds: float = 0.0
    _inner_seconds: float = 0.0
    _told: float = 0.0
    _digests: dict[Path, str] = field(default_factory=dict)
    _started: float = field(default_factory=time.perf_counter)
    _report: Callable[[float, str], None] | None = None
    _checkpoints: Checkpoints | None = None
    #: seconds that saving states took so far, of the run that this is a part of
    _saving: Callable[[], float] | None = None

    def progress(self, fraction: float, message: str = "") -> None:
        """Tell the user how far the fit is: `fraction` in [0, 1], and what is being done."""
        self._told = float(fraction)
        if self._report is not None:
            self._report(self._told, message)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the wall time of what is within as the stage `name`, for record.json; stages may come back.

        What checkpoints and stages within it take is left out.
        """
        start, before = time.perf_counter(), self._checkpoint_seconds()
        around, self._inner_seconds = self._inner_seconds, 0.0
        try:
            yield
        finally:
            seconds = time.perf_counter() - start - (self._checkpoint_seconds() - before)
            self.stages[name] = self.stages.get(name, 0.0) + seconds - self._inner_seconds
            self._inner_seconds = around + seconds

    def aside(self, span: tuple[float, float] | None = None) -> Run:
        """A run of the same seed and device for a part of the fit of which nothing is recorded: no stages, notes,
        decisions, nor anything that is taken over. It has neither budget nor checkpoints.

        span: the part of this run's progress that it takes up; None where nobody is told of it.
        """
        if span is None:
            return Run(seed=self.seed, device=self.device, directory=self.directory)
        start, end = span
        report = self.progress
        return Run(
            seed=self.seed,
            device=self.device,
            directory=self.directory,
            _report=lambda done, message: report(start + (end - start) * done, message),
        )

    def _checkpoint_seconds(self) -> float:
        if self._saving is not None:
            return self._saving()
        return 0.0 if self._checkpoints is None else self._checkpoints.spent

    def note(self, name: str, text: str) -> None:
        """Write into record.json what the method found out by itself and went by, in a few words.

        What is longer than `MAX_NOTE` characters goes on in notes called `name` 2, 3 and so on; beyond `MAX_NOTES` of
        them nothing is kept.
        """
        for number, part in enumerate(textwrap.wrap(text, MAX_NOTE) or [""], 1):
            place = name if number == 1 else f"{name} {number}"
            if place in self.notes or len(self.notes) < MAX_NOTES:
                self.notes[place] = part

    def decide(self, decision: Decision) -> None:
        """Write into record.json what the method decided by itself, and by what evidence.

        Beyond `MAX_DECISIONS` of them nothing is kept.
        """
        if len(self.decisions) < MAX_DECISIONS:
            self.decisions.append(decision)

    @property
    def watched(self) -> bool:
        """Whether states of the fit are taken on its way, so that a first one is worth seconds of its own."""
        return self._checkpoints is not None

    def checkpoint(self, state: Callable[[], Fitted], milestone: bool = False) -> None:
        """Offer the state of the fit, as if it ended here: at every step, or as often as there is something to show.

        Args:
            state: makes a model that can be saved. It is called at a few offers only, outside the clock, and must not
                change the fit: with or without checkpoints the same model has to come out.
            milestone: take it in any case, for there will be no other for a while.
        """
        if self._checkpoints is not None:
            self._checkpoints.offer(state, milestone)

    def side_by_side(
        self, first: Callable[[Run], T], second: Callable[[Run], U], span: tuple[float, float] = (0.0, 1.0)
    ) -> tuple[T, U]:
        """What two parts of the fit that do not need each other return, made at the same time where there are cores.

        Args:
            first, second: each is given a `Run` of its own, with all of the progress to itself. `second` runs in a
                thread. Their kernels have to release the GIL, and what is drawn from torch's global generator has to be
                drawn in one of them alone.
            span: the part of this run's progress that both take up.

        Where one raises, the other ends at its next report of progress.
        """
        from splashbench.harness.side_by_side import side_by_side

        return side_by_side(self, first, second, span)

    def ahead(
        self, first: Callable[[Run], T], second: Callable[[Run], U], span: tuple[float, float] = (0.0, 1.0)
    ) -> tuple[Callable[[], T], U]:
        """As `side_by_side`, for a `first` that is needed later than `second`: what returns it, and what `second` did.

        Where there is one core, `first` is made when it is asked for, once. Both have to give the same at either time.
        """
        from splashbench.harness.side_by_side import ahead

        return ahead(self, first, second, span)

    def reuse(
        self,
        name: str,
        scene: TrainingScene,
        key: Mapping[str, Any],
        fit: Callable[[], T],
        save: Callable[[T, Path], None],
        load: Callable[[Path], T],
        seeded: bool = True,
    ) -> T:
        """What `fit()` returns, or what it returned in an earlier run of the same study, scene, key, seed and device.

        It is for a part of the fit that does not depend on the rest, such as a frozen background. No part may be asked
        for within the fit of another: the seconds would be wrong.

        Args:
            name: of the part.
            key: every setting and version that the part depends on, in values that JSON has.
            save, load: write the part into an empty folder, and read it from there to the same bytes in renders.
            seeded: whether the part depends on the seed; where not, runs of other seeds share it.

        The harness adds the seconds of the earlier fit to this one's.
        """
        if self.cache is None:
            return fit()
        from splashbench.harness.reuse import reuse, training_digest

        if scene.directory not in self._digests:
            start = time.perf_counter()
            self._digests[scene.directory] = training_digest(scene)
            self._overhead_seconds += time.perf_counter() - start
        key = {**key, "seed": self.seed if seeded else None, "device": self.device}
        if scene.variation:  # only there: what was stored before must not change its name
            key["variation"] = scene.variation
        part = reuse(self.cache, name, self._digests[scene.directory], key, fit, save, load)
        self._overhead_seconds += part.overhead_seconds
        if part.loaded_seconds is not None:
            self.reused[name] = part.loaded_seconds
        return part.value

    @property
    def seconds(self) -> float:
        """Of the fit so far, as record.json will count them."""
        return self.fit_seconds(time.perf_counter() - self._started)

    def fit_seconds(self, wall_seconds: float) -> float:
        """What a fit of `wall_seconds` would have taken by itself: with the fits of what it reused."""
        spent = self._overhead_seconds + self._checkpoint_seconds()
        return max(0.0, wall_seconds - spent) + sum(self.reused.values())


class MethodConfig(BaseModel):
    """Settings of a method. Subclass it with fields and fill `presets`: name -> the fields that differ.

    renamed: settings that had another name in an earlier version, old -> new; who gives the old one is told the new.
    capacity: a ladder for `study capacity`: setting -> values from the smallest model to the largest, as many of each.
    """

    model_config = ConfigDict(extra="forbid", validate_assignment=True, allow_inf_nan=False)
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"best": {}}
    renamed: ClassVar[Mapping[str, str]] = {}
    capacity: ClassVar[Mapping[str, Sequence[Any]]] = {}

    @classmethod
    def preset(cls, name: str, overrides: Mapping[str, Any] | None = None) -> MethodConfig:
        """The settings of preset `name`, with `overrides` (values may be text, as typed after `--set`) on top."""
        if name not in cls.presets:
            raise SplashbenchError(f"there is no preset {name!r}; choose one of {', '.join(cls.presets)}")
        values = dict(cls.presets[name]) | dict(overrides or {})
        for old, new in cls.renamed.items():
            if old in values and old not in cls.model_fields:
                raise SplashbenchError(f"setting {old} is now called {new}; give {new}={values[old]}")
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            first = error.errors()[0]
            if not first["loc"]:  # of several settings together
                raise SplashbenchError(str(first["ctx"]["error"])) from None
            key = ".".join(str(part) for part in first["loc"])
            fields = ", ".join(sorted(cls.model_fields)) or "none"
            unknown = first["type"] == "extra_forbidden"
            near = difflib.get_close_matches(key, [*cls.model_fields], n=1) if unknown else []
            remedy = f"did you mean {near[0]}?" if near else f"this method's settings: {fields}"
            raise SplashbenchError(f"setting {key}: {first['msg']}; {remedy}") from None


class Fitted(ABC):
    """A fitted model: renders any camera at any time within the scene's interval."""

    @abstractmethod
    def render(self, camera: Camera, time: float) -> Render:
        """The view of `camera` at `time` (seconds, the scene's clock), at the camera's full size.

        Test views are asked for at their camera's own times: near the timesteps, at either end a little outside.
        """

    @abstractmethod
    def particles(self) -> Particles | None:
        """The liquid's particles on the scene's timesteps in scene units, or None for a method without any.

        Of more rows than a file may hold (scene.particles.most_particles) an even share is kept, and a note says so.
        """

    def signed_distance(self) -> SignedDistance | None:
        """The liquid's signed distance on the scene's timesteps, in scene units, or None for a method without one.

        It says where the liquid is, its inside included. Without one, scoring derives it from the particles.
        """
        return None

    def surface(self, time: float) -> SignedDistance | None:
        """The liquid's signed distance at `time` alone (one instant), or None for a method without one.

        Without it, viewers and exports blend the distances of the two timesteps around `time`, which loses what moves
        by more than its own size.
        """
        return None

    def gaussians(self, time: float, eye: NDArray) -> Gaussians | None:
        """The liquid's Gaussians at `time`, coloured as they are seen from `eye` [3] (scene units); None without any.

        What a container hides from `eye` is among them: whoever asks looks from elsewhere next.
        """
        return None

    def static_gaussians(self, eye: NDArray) -> Gaussians | None:
        """The Gaussians of a background that never changes, seen from `eye` [3]; None where it is not apart."""
        return None

    def empty_view(self, camera: Camera) -> NDArray[np.float32] | None:
        """What `camera` would see without liquid, float32 [H, W, 3], sRGB in [0, 1]; None where it is not known."""
        return None

    def velocity(self, time: float) -> VelocityField | None:
        """How fast the liquid moves at `time`, or None for a method whose motion is not that of a liquid."""
        return None

    def to_device(self, device: str) -> None:
        """Render on `device` from now on (one of `Method.devices`); where this is not overridden, on the CPU still."""
        return None

    @abstractmethod
    def save(self, directory: Path) -> None:
        """Write the model into `directory`, which is there and empty, without pickles.

        What does not change over time, such as a frozen background, goes under `static/`. The rest counts as dynamic
        storage.
        """


def _with_folder(load: Callable[..., Fitted]) -> Callable[..., Fitted]:
    """`load`, given its folder as a Path in any case."""

    @wraps(load)
    def loaded(self: Method, directory: Path | str, scene: TrainingScene) -> Fitted:
        return load(self, Path(directory), scene)

    return loaded


class Method(ABC):
    """A reconstruction method. Register the class under the entry-point group `splashbench.methods`."""

    id: ClassVar[str]
    title: ClassVar[str]
    version: ClassVar[str] = "1"
    Config: ClassVar[type[MethodConfig]] = MethodConfig
    #: What `Run.device` may be; a GPU method lists "cuda" too, and saves what any machine can load.
    devices: ClassVar[tuple[str, ...]] = ("cpu",)
    #: False where fits use no optimiser of torch.optim: these make PyTorch load its compiler, which takes seconds and
    #: 70 MB. It is loaded before the clock starts, for all that use PyTorch otherwise.
    torch_optim: ClassVar[bool] = True
    #: Which limits of `Budget` the method keeps to; with others the user is told that it does not.
    budgets: ClassVar[tuple[str, ...]] = ()
    #: True for the yardsticks that are no reconstructions (methods/controls).
    control: ClassVar[bool] = False
    #: True where one set of primitives holds background and liquid, see docs/protocol.md, "mixed methods".
    mixed: ClassVar[bool] = False

    def __init_subclass__(cls, **more: Any) -> None:
        """Let `load` take its folder as text too, as `Scene.open` does."""
        super().__init_subclass__(**more)
        if "load" in cls.__dict__:
            cls.load = _with_folder(cls.__dict__["load"])  # type: ignore[method-assign]

    def supports(self, scene: TrainingScene) -> Support:
        """Whether this method can take `scene`; a reason where not."""
        return Support(True)

    def device_fault(self, device: str) -> str | None:
        """Why `device`, one of `devices`, cannot be used on this machine, with the remedy; None where it can."""
        return None

    @abstractmethod
    def fit(self, scene: TrainingScene, config: Any, run: Run) -> Fitted:
        """Fit the scene. `config` is an instance of `Config`."""

    @abstractmethod
    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        """Read what `Fitted.save` wrote, in a fresh process. Rendering must equal that of the saved model.

        Whoever calls it may give `directory` as text; the method gets a Path.
        """

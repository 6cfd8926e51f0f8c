"""The method contract: what a reconstruction method implements, and what it is given.

A method sees training views only; test views reach it as poses and times. It runs in a child process; the harness,
never the method, measures time, memory, bytes and frame rate, and turns a crash, a NaN, a hang or running out of
memory into a recorded status. CONTRIBUTING.md shows a complete method in one file.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from splashbench.errors import SplashbenchError
from splashbench.scene import Camera, Particles, TrainingScene


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
    """

    seed: int = 0
    device: str = "cpu"
    directory: Path = Path()
    budget_seconds: float | None = None
    _report: Callable[[float, str], None] | None = None
    _checkpoint: Callable[[Fitted], None] | None = None

    def progress(self, fraction: float, message: str = "") -> None:
        """Tell the user how far the fit is: `fraction` in [0, 1], and what is being done."""
        if self._report is not None:
            self._report(float(fraction), message)

    def checkpoint(self, fitted: Fitted) -> None:
        """Offer an intermediate state; where the harness collects them it saves it outside the clock."""
        if self._checkpoint is not None:
            self._checkpoint(fitted)


class MethodConfig(BaseModel):
    """Settings of a method. Subclass it with fields and fill `presets`: name -> the fields that differ."""

    model_config = ConfigDict(extra="forbid", validate_assignment=True, allow_inf_nan=False)
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"best": {}}

    @classmethod
    def preset(cls, name: str, overrides: Mapping[str, Any] | None = None) -> MethodConfig:
        """The settings of preset `name`, with `overrides` (values may be text, as typed after `--set`) on top."""
        if name not in cls.presets:
            raise SplashbenchError(f"there is no preset {name!r}; choose one of {', '.join(cls.presets)}")
        values = dict(cls.presets[name]) | dict(overrides or {})
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(str(part) for part in first["loc"])
            known = ", ".join(sorted(cls.model_fields)) or "none"
            raise SplashbenchError(f"setting {key}: {first['msg']}; this method's settings: {known}") from None


class Fitted(ABC):
    """A fitted model: renders any camera at any time within the scene's interval."""

    @abstractmethod
    def render(self, camera: Camera, time: float) -> Render:
        """The view of `camera` at `time` (seconds, the scene's clock), at the camera's full size."""

    @abstractmethod
    def particles(self) -> Particles | None:
        """The liquid's particles on the scene's timesteps in scene units, or None for a method without any."""

    @abstractmethod
    def save(self, directory: Path) -> None:
        """Write the model into `directory` (exists, empty). Files under `static/` are what does not change over
        time, such as a frozen background; everything else counts as dynamic storage. No pickles."""


class Method(ABC):
    """A reconstruction method. Register the class under the entry-point group `splashbench.methods`."""

    id: ClassVar[str]
    title: ClassVar[str]
    version: ClassVar[str] = "1"
    Config: ClassVar[type[MethodConfig]] = MethodConfig
    #: What `Run.device` may be; a GPU method lists "cuda" too.
    devices: ClassVar[tuple[str, ...]] = ("cpu",)
    #: True for the yardsticks that are no reconstructions (methods/controls).
    control: ClassVar[bool] = False
    #: True where one set of primitives holds background and liquid, see docs/protocol.md, "mixed methods".
    mixed: ClassVar[bool] = False

    def supports(self, scene: TrainingScene) -> Support:
        """Whether this method can take `scene`; a reason where not."""
        return Support(True)

    @abstractmethod
    def fit(self, scene: TrainingScene, config: Any, run: Run) -> Fitted:
        """Fit the scene. `config` is an instance of `Config`."""

    @abstractmethod
    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        """Read what `Fitted.save` wrote, in a fresh process. Rendering must equal that of the saved model."""

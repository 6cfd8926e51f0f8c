"""Scaffold-GS as a method of its own: a static reconstruction that knows no liquid."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from splashbench.gaussians.devices import GaussianMethod
from splashbench.harness.contract import Fitted, MethodConfig, Render, Run
from splashbench.scene import Camera, Gaussians, Particles, TrainingScene

from .background import Background
from .background_reuse import shared_background
from .settings import BackgroundSettings


class StaticScene(Fitted):
    """A background alone: the same at every time, with a liquid opacity of zero everywhere."""

    def __init__(self, background: Background) -> None:
        self.background = background

    def render(self, camera: Camera, time: float) -> Render:
        return Render(self.background.render(camera), np.zeros((camera.height, camera.width), np.float32))

    def particles(self) -> Particles | None:
        return None

    def static_gaussians(self, eye: NDArray) -> Gaussians:
        return Gaussians(*self.background.seen_from(eye))

    def empty_view(self, camera: Camera) -> NDArray[np.float32]:
        return self.background.render(camera)

    def save(self, directory: Path) -> None:
        self.background.save(directory / "static")


class ScaffoldGS(GaussianMethod):
    """Static anchors fitted to the liquid-free plates (Lu et al., CVPR 2024)."""

    id: ClassVar[str] = "scaffold_gs"
    title: ClassVar[str] = "Scaffold-GS, static"
    version: ClassVar[str] = "4"  # since hulls, where it starts, go on past the sides of images
    torch_optim: ClassVar[bool] = False
    Config: ClassVar[type[MethodConfig]] = BackgroundSettings

    def fit(self, scene: TrainingScene, config: BackgroundSettings, run: Run) -> Fitted:
        def offer(state: Callable[[], Background]) -> None:
            run.checkpoint(lambda: StaticScene(state()))

        return StaticScene(shared_background(scene, config, run, offer=offer))

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        return StaticScene(Background.load(directory / "static"))

"""What the official codes of the baselines have in common, for importers of their output.

They draw with the rasterizer of 3D Gaussian splatting (Kerbl et al. 2023) or one made from it, which leaves out what
lies nearer than 0.2 of the code's own units, and draws over a plain background. They keep their own clock, and some of
them their own idea of a lens. `OfficialModel` adds these to a model of ours, `OfficialFitted` renders by them. Two
differences stay: there alpha ends at 0.99, here at 0.999, and there a Gaussian ends with the tiles that a square of
3 sigma touches.

An output folder holds `point_cloud/iteration_N/point_cloud.ply` and `cfg_args`, the arguments of the training as Python
would print them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from splashbench.errors import SplashbenchError
from splashbench.gaussians.dynamic_model import DynamicModel, Splats
from splashbench.gaussians.mixed_model import MixedFitted
from splashbench.render import rasterize
from splashbench.scene import Camera, TrainingScene

NEAR = 0.2


class OfficialModel(DynamicModel):
    """To be put before a model of ours among the bases of a class; its `at` takes times of the code's clock."""

    near: Tensor
    background: Tensor
    clock: Tensor

    def __init__(self, *arguments: object) -> None:
        super().__init__(*arguments)
        # Depth up to which nothing is drawn, scene units; behind everything, [3]; origin and unit of the clock.
        self.register_buffer("near", torch.tensor(NEAR))
        self.register_buffer("background", torch.zeros(3))
        self.register_buffer("clock", torch.tensor([0.0, 1.0], dtype=torch.float64))

    def own_time(self, seconds: float, camera: Camera | None, scene: TrainingScene) -> float:
        """`seconds` of the scene's clock on the code's; camera: that took the photograph, None for all together."""
        origin, unit = self.clock.tolist()
        return (seconds - origin) / unit

    def lens(self, camera: Camera) -> Camera:
        """`camera` as the code takes it: of the same image size and pose."""
        return camera

    def splats(self, state: Any, camera: Camera) -> Splats:
        """As of the model beneath, without opacity where the published rasterizer draws nothing."""
        splats = super().splats(state, camera)  # type: ignore[safe-super]
        axis = torch.tensor(camera.w2c[2], dtype=torch.float32)
        splats.opacities = splats.opacities * (splats.means @ axis[:3] + axis[3] > self.near)
        return splats

    def view(self, splats: Splats, camera: Camera, time: float) -> Tensor:
        background = self.background if splats.colors.shape[1] == 3 else None
        rendered, _ = rasterize(
            splats.means, splats.factors, splats.opacities, splats.colors, camera, background=background
        )
        return self.image(rendered, camera, time)


class OfficialFitted(MixedFitted):
    """An official code's model: rendered by its own clock and lenses."""

    model: OfficialModel

    def model_time(self, seconds: float, camera: Camera | None = None) -> float:
        return self.model.own_time(seconds, camera, self.scene)

    def lens(self, camera: Camera) -> Camera:
        return self.model.lens(camera)


def require_finite(fitted: OfficialFitted, path: Path) -> OfficialFitted:
    """`fitted` itself. Raises SplashbenchError, naming `path`, where its Gaussians come to nothing at either end."""
    with torch.no_grad():
        for seconds in fitted.scene.times[[0, -1]]:
            time = fitted.model_time(float(seconds))
            for camera in list(fitted.scene.cameras.values())[:1]:
                splats = fitted.model.splats(fitted.model.at(time), fitted.lens(camera))
                tables = {name: getattr(splats, name) for name in ("means", "factors", "opacities", "colors")}
                for name, values in [("means", fitted.model.means(time)), *tables.items()]:
                    if not torch.isfinite(values).all():
                        raise SplashbenchError(
                            f"{path}: {name} of the Gaussians overflow at {seconds:g} s; the fit failed, repeat it"
                        )
    return fitted

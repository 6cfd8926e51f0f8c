"""Guided sampling: new Gaussians along the rays of what the worst view gets wrong (Li et al. 2024, Sec. 3.4).

Points at the start cover badly what is seen seldom or is far away, and cloning does not reach there. Of some training
photographs the one with the largest error is taken, then its patches with the largest errors. Gaussians of a patch's
colour and size are placed along the ray through its middle, at random depths within those that the view shows. They
appear at the photograph's time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splashbench.gaussians.density_control import DensityControl
from splashbench.gaussians.dynamic_model import Splats
from splashbench.gaussians.photographs import Photographs, TrainingPhotograph
from splashbench.scene import Camera

from .model import SpacetimeModel, rays
from .settings import SpacetimeSettings

PATCH = 8
PER_RAY = 4
_OPACITY = 0.1
# Photographs among which the worst is looked for: all of a long recording would take longer than a round of the fit.
_LOOKED_AT = 16
# Quantiles of the depths shown: stray Gaussians far away would stretch the range.
_NEAR, _FAR = 0.02, 0.98


class GuidedDensity:
    """Density control, and guided sampling in its share of the steps."""

    def __init__(
        self,
        density: DensityControl,
        model: SpacetimeModel,
        photographs: Photographs,
        config: SpacetimeSettings,
        rng: np.random.Generator,
    ) -> None:
        self._density, self._model, self._photographs = density, model, photographs
        self._config, self._rng = config, rng
        self._from, self._until = (round(s * config.iterations) for s in (config.guided_from, config.guided_until))

    def wants_gradients(self, step: int) -> bool:
        return self._density.wants_gradients(step)

    def observe(self, camera: Camera, splats: Splats, gradients: Tensor) -> None:
        self._density.observe(camera, splats, gradients)

    def after_step(self, step: int) -> None:
        self._density.after_step(step)
        if self._from <= step < self._until and (step - self._from) % self._config.guided_every == 0:
            room = self._config.max_gaussians - len(self._model.positions)
            patches = min(self._config.guided_patches, room // PER_RAY)
            if patches > 0:
                photograph, error, depths = self._worst()
                self._density.append(self._gaussians(photograph, error, depths, patches))

    @torch.no_grad()
    def _worst(self) -> tuple[TrainingPhotograph, NDArray[np.float32], NDArray[np.float32]]:
        """The photograph that is matched worst, its error per pixel [H, W], and the depths of what it shows [M]."""
        looked_at = self._photographs.some(_LOOKED_AT)
        best: tuple[float, TrainingPhotograph, NDArray[np.float32], NDArray[np.float32]] | None = None
        for photograph in looked_at:
            camera = photograph.camera
            splats = self._model.splats(self._model.at(photograph.time), camera)
            image = self._model.view(splats, camera, photograph.time).cpu().numpy()
            error = np.abs(image - photograph.image * np.float32(1 / 255)).mean(axis=2)
            if best is None or error.mean() > best[0]:
                pixels, depth = camera.project(splats.means.cpu().numpy())
                inside = (pixels >= 0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
                shown = depth[(depth > 0) & inside & (splats.opacities.cpu().numpy() > 0.05)].astype(np.float32)
                best = float(error.mean()), photograph, error, shown
        assert best is not None
        return best[1], best[2], best[3]

    def _gaussians(
        self, photograph: TrainingPhotograph, error: NDArray[np.float32], depths: NDArray[np.float32], patches: int
    ) -> dict[str, Tensor]:
        """Rows of all tables for Gaussians along the rays of the worst patches; none where the view shows nothing."""
        placed = along_worst_rays(photograph, error, depths, patches, self._rng)
        count = len(placed.positions)
        colors = torch.from_numpy(placed.colors)
        new = {name: torch.zeros(count, *self._model.get_parameter(name).shape[1:]) for name in self._model.rows}
        new["positions"] = torch.from_numpy(placed.positions)
        new["quaternions"][:, 0] = 1
        new["log_scales"] += torch.from_numpy(np.log(placed.sizes))[:, None]
        new["opacity_logits"] += math.log(_OPACITY / (1 - _OPACITY))
        new["times"] += photograph.time
        new["log_widths"] += self._config.hull_log_width
        new["base"] = torch.logit(colors.clamp(0.01, 0.99)) if self._model.full else colors
        if self._model.full:
            new["features"] = colors
        return new


class Placed(NamedTuple):
    """Places of new Gaussians: positions [n, 3] and sizes [n] in scene units, colors [n, 3] in [0, 1]; float32."""

    positions: NDArray[np.float32]
    sizes: NDArray[np.float32]
    colors: NDArray[np.float32]


def along_worst_rays(
    photograph: TrainingPhotograph,
    error: NDArray[np.float32],
    depths: NDArray[np.float32],
    patches: int,
    rng: np.random.Generator,
) -> Placed:
    """Places along the rays of the `patches` with the largest `error` [H, W], at depths within `depths` [M]."""
    camera = photograph.camera
    rows, columns = (size // PATCH for size in error.shape)
    if len(depths) == 0:
        patches = 0
    blocks = error[: rows * PATCH, : columns * PATCH].reshape(rows, PATCH, columns, PATCH).mean(axis=(1, 3))
    worst = np.argsort(-blocks, axis=None, kind="stable")[:patches].repeat(PER_RAY)
    v, u = worst // max(columns, 1) * PATCH + PATCH // 2, worst % max(columns, 1) * PATCH + PATCH // 2
    near, far = np.quantile(depths, [_NEAR, _FAR]) if len(worst) else (1.0, 1.0)
    depth = rng.uniform(near, far, len(worst))
    ray = rays(camera)[v, u].astype(np.float64)
    forward = ray[:, 3:] @ camera.w2c[2, :3]
    positions = ray[:, :3] + ray[:, 3:] * (depth / forward)[:, None]
    sizes = PATCH / 2 * depth / camera.K[0, 0]
    colors = photograph.image[v, u] / np.float32(255)
    return Placed(positions.astype(np.float32), sizes.astype(np.float32), colors)

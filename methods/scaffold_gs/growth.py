"""Anchors grow where the fit pulls at their Gaussians, and vanish where nothing is drawn (Lu et al. 2024, Sec. 3.3).

Growing: a voxel without an anchor becomes one where a Gaussian within it has a mean gradient of its 2-D mean above a
threshold tau_g. There are three levels: level m = 0, 1, 2 has voxels of 16, 4 and 1 times the finest size and the
threshold 2^m tau_g (cells.py). Pruning: an anchor goes if its Gaussians' opacities, averaged over the steps, add up
to almost nothing. `AnchorGrowth` is shared with anchors in space-time; `Growth` is that of the static ones.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splashbench.gaussians.screen_gradients import screen_gradients_of
from splashbench.scene import Camera

from .cells import LEVELS, GrowthLevel, NewCells, new_cells
from .model import AnchorModel, Anchors, DecodedGaussians, first_offsets
from .optimizer import AnchorOptimizer
from .settings import BackgroundSettings

# Visits before a mean counts, as shares of the views between two rounds.
_GROW_VISITS, _PRUNE_VISITS = 0.4, 0.8


@dataclass(frozen=True)
class GrowthRules:
    """What makes an anchor come or go.

    views: rendered between two rounds. gradient: tau_g. opacity: an anchor whose children's mean opacities add up to
    less goes. max_anchors: anchors at most. spread: whether the children of a new anchor start spread over its cell.
    """

    views: int
    gradient: float
    opacity: float
    max_anchors: int
    spread: bool = True


class AnchorGrowth(ABC):
    """What was seen of every child and anchor since it was last judged, and the rounds of growing and pruning.

    finest: [D], the finest cell in which anchors grow. counted: the type of a child's visits, weighted or not.
    """

    def __init__(
        self,
        optimizer: AnchorOptimizer,
        finest: NDArray[np.float64],
        levels: Sequence[GrowthLevel],
        rules: GrowthRules,
        rng: np.random.Generator,
        counted: Any = np.int32,
    ) -> None:
        self.optimizer, self.finest, self.levels, self.rules, self._rng = optimizer, finest, levels, rules, rng
        n, k = self.anchors.offsets.shape[:2]
        self._gradient, self._child_visits = np.zeros((n, k), np.float32), np.zeros((n, k), counted)
        self._opacity, self._visits = np.zeros(n, np.float32), np.zeros(n, np.int32)

    @property
    def anchors(self) -> Anchors:
        return self.optimizer.model

    def _see_anchors(self, camera: Camera, opacities: NDArray[np.float32]) -> None:
        """Count a visit of every anchor within the image, with its children's summed `opacities` [N]."""
        uv, depth = camera.project(self.anchors.positions[:, :3].cpu().numpy())
        inside = (depth > 0) & (uv > 0).all(axis=1) & (uv < [camera.width, camera.height]).all(axis=1)
        self._opacity[inside] += opacities[inside]
        self._visits += inside

    @abstractmethod
    def _log_scales(self, parents: torch.Tensor, sizes: NDArray[np.float64]) -> torch.Tensor:
        """Log-scales [n, 2 D] of new anchors that grow from anchors `parents` [n] in cells of `sizes` [n] in space."""

    def round(self) -> None:
        """Add anchors, then drop others; what was judged starts anew."""
        cells = self._candidates()
        judged = self._visits >= _PRUNE_VISITS * self.rules.views
        dull = judged & (self._opacity < self.rules.opacity * np.maximum(self._visits, 1))
        if dull.all() and not len(cells.centers):
            dull[np.argmax(self._opacity)] = False  # a model of no anchors could not be fitted further
        self._forget(judged)
        remaining = np.flatnonzero(~dull)
        k, dimensions = self.anchors.offsets.shape[1:]
        n, parents = len(cells.centers), torch.from_numpy(cells.chosen // k)
        new = {
            "features": self.anchors.features.detach()[parents.to(self.anchors.features.device)],
            "offsets": first_offsets(n, k, dimensions, self.rules.spread),
            "log_scales": self._log_scales(parents, cells.sizes),
        }
        self.optimizer.replace_anchors(remaining, torch.from_numpy(cells.centers.astype(np.float32)), new)
        for name in ("_gradient", "_child_visits", "_opacity", "_visits"):
            old = getattr(self, name)
            setattr(self, name, np.concatenate([old[remaining], np.zeros((n, *old.shape[1:]), old.dtype)]))

    def _enough(self) -> NDArray[np.bool_]:
        """bool [N, K]: the children whose mean gradient counts."""
        return self._child_visits >= _GROW_VISITS * self.rules.views

    def _forget(self, judged: NDArray[np.bool_]) -> None:
        enough = self._enough()
        for array, rows in (
            (self._gradient, enough), (self._child_visits, enough), (self._opacity, judged), (self._visits, judged),
        ):  # fmt: skip
            array[rows] = 0

    @torch.no_grad()
    def _candidates(self) -> NewCells:
        visits = np.where(self._child_visits > 0, self._child_visits, 1)
        mean = np.where(self._enough(), self._gradient / visits, 0).reshape(-1)
        model, dimensions = self.anchors, len(self.finest)
        children = model.positions[:, None] + model.offsets * torch.exp(model.log_scales[:, None, :dimensions])
        return new_cells(
            children.reshape(-1, dimensions).cpu().numpy().astype(np.float64),
            mean,
            model.positions.cpu().numpy().astype(np.float64),
            self.finest,
            self.levels,
            self.rules.gradient,
            self.rules.max_anchors - len(model.positions),
            self._rng,
        )


class Growth(AnchorGrowth):
    """Growth and pruning of static anchors. voxel: scene units, the finest at which they grow."""

    def __init__(
        self, optimizer: AnchorOptimizer, voxel: float, settings: BackgroundSettings, rng: np.random.Generator
    ) -> None:
        rules = GrowthRules(
            settings.grow_every,
            settings.grow_gradient,
            settings.prune_opacity,
            settings.max_anchors,
            settings.spread_start,
        )
        super().__init__(optimizer, np.full(3, voxel), LEVELS, rules, rng)
        self.voxel = voxel

    @property
    def model(self) -> AnchorModel:
        assert isinstance(self.anchors, AnchorModel)
        return self.anchors

    def observe(self, camera: Camera, gaussians: DecodedGaussians) -> None:
        """Take note of a step; `gaussians.means` has kept the gradient of its loss."""
        assert gaussians.means.grad is not None
        gradients = gaussians.means.grad
        norms = screen_gradients_of(camera, gaussians.means.detach(), gradients).cpu().numpy()
        self._gradient += norms.reshape(self._gradient.shape)
        self._child_visits += gradients.any(dim=1).cpu().numpy().reshape(self._child_visits.shape)
        total = gaussians.opacities.detach().clamp(min=0).view(self._gradient.shape).sum(dim=1)
        self._see_anchors(camera, total.cpu().numpy())

    def _log_scales(self, parents: torch.Tensor, sizes: NDArray[np.float64]) -> torch.Tensor:
        return torch.from_numpy(np.log(sizes).astype(np.float32))[:, None].expand(-1, 6)

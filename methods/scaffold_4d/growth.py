"""Anchors grow in cells of space-time where the loss pulls, whether what is there shows for long or for a moment.

A Gaussian that shows for a moment is seen in few steps, and where it is faint its gradient is small. So the mean of its
screen gradient is taken with the weights w = fading sigma (Cho et al. 2024, "dynamic-aware anchor growing"). w adds up
to the same for a short and a long life. Children count once they have enough of it. A cell is one frame long; its
size in space, the thresholds and the share of candidates kept are those of static anchors (scaffold_gs/cells.py).
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splashbench.gaussians.dynamic_model import Splats
from splashbench.gaussians.screen_gradients import screen_gradients_of
from splashbench.scene import Camera

from ..scaffold_gs.cells import LEVELS
from ..scaffold_gs.growth import AnchorGrowth, GrowthRules
from ..scaffold_gs.optimizer import AnchorOptimizer
from .model import AnchorSplats
from .settings import Scaffold4DSettings


class SpacetimeGrowth(AnchorGrowth):
    """The rounds of growth and pruning in a fit. voxel: scene units, the finest; frame: a frame's share of the
    recording."""

    def __init__(
        self,
        optimizer: AnchorOptimizer,
        voxel: float,
        frame: float,
        settings: Scaffold4DSettings,
        rng: np.random.Generator,
    ) -> None:
        views = settings.grow_every * settings.views_per_step
        rules = GrowthRules(
            views, settings.grow_gradient, settings.prune_opacity, settings.max_anchors, settings.spread_start
        )
        super().__init__(optimizer, np.array([voxel, voxel, voxel, frame]), LEVELS, rules, rng, np.float32)
        shares = (settings.count_from, settings.grow_from, settings.grow_until)
        self._count, self._from, self._until = (round(share * settings.iterations) for share in shares)
        self._every = settings.grow_every

    def wants_gradients(self, step: int) -> bool:
        return min(self._count, self._from) <= step < self._until

    def observe(self, camera: Camera, splats: Splats, gradients: Tensor) -> None:
        assert isinstance(splats, AnchorSplats)
        assert splats.state is not None
        state, pulled = splats.state, gradients.any(dim=1).cpu().numpy()
        anchors = state.anchors.cpu().numpy()
        norms = screen_gradients_of(camera, splats.means.detach(), gradients).cpu().numpy()
        weights = (state.fading * state.sigma).detach().cpu().numpy() * pulled
        shape = (len(anchors), self._gradient.shape[1])
        self._gradient[anchors] += (weights * norms).reshape(shape)
        self._child_visits[anchors] += weights.reshape(shape)
        self._see_anchors(camera, state.peaks.clamp(min=0).sum(dim=1).cpu().numpy())

    def after_step(self, step: int) -> None:
        if self._from <= step < self._until and (step + 1 - self._from) % self._every == 0:
            self.round()

    def _log_scales(self, parents: Tensor, sizes: NDArray[np.float64]) -> Tensor:
        space = torch.from_numpy(np.log(sizes).astype(np.float32))[:, None].expand(-1, 3)
        time = torch.full((len(sizes), 1), float(np.log(self.finest[3])))
        # Features come from the parent, and with them sigma times the duration: so does the duration.
        lives = self.anchors.log_scales.detach()[parents.to(self.anchors.log_scales.device), 7:].cpu()
        return torch.cat([space, time, space, lives], dim=1)

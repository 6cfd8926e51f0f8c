"""Anchors grow where the fit pulls at their Gaussians, and vanish where nothing is drawn (Lu et al. 2024, Sec. 3.3).

Growing: a voxel becomes an anchor where a Gaussian within it has a mean gradient of its 2-D mean above a threshold
tau_g and there is no anchor yet, at three levels: level m = 0, 1, 2 has voxels of 16, 4 and 1 times the finest size and
the threshold 2^m tau_g. A random share of the candidates is left out. Pruning: an anchor goes if its Gaussians'
opacities, averaged over the steps, add up to almost nothing.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from splashbench_methods.gaussian_splatting.screen import screen_gradients
from splashbench_methods.scaffold_gs.model import FEATURES, AnchorModel, Gaussians, random_offsets
from splashbench_methods.scaffold_gs.optimizer import AnchorOptimizer
from splashbench_methods.scaffold_gs.settings import BackgroundSettings

from splashbench.scene import Camera

LEVELS = ((16.0, 1.0), (4.0, 2.0), (1.0, 4.0))  # voxels of the finest, and times tau_g
# The paper leaves the share open.
_KEPT_CANDIDATES = 0.5
# Visits before a mean counts, as shares of the steps between two rounds.
_GROW_VISITS, _PRUNE_VISITS = 0.4, 0.8
_CELL_LIMIT = 1 << 20


class Growth:
    """What was seen of every child and anchor since it was last judged, and the rounds of growing and pruning.

    voxel: scene units, the finest at which anchors grow.
    """

    def __init__(
        self, optimizer: AnchorOptimizer, voxel: float, settings: BackgroundSettings, rng: np.random.Generator
    ) -> None:
        self.optimizer, self.voxel, self.settings, self._rng = optimizer, voxel, settings, rng
        n, k = len(self.model), settings.children
        self._gradient, self._child_visits = np.zeros((n, k), np.float32), np.zeros((n, k), np.int32)
        self._opacity, self._visits = np.zeros(n, np.float32), np.zeros(n, np.int32)

    @property
    def model(self) -> AnchorModel:
        return self.optimizer.model

    def observe(self, camera: Camera, gaussians: Gaussians) -> None:
        """Take note of a step; `gaussians.means` has kept the gradient of its loss."""
        assert gaussians.means.grad is not None
        gradients = gaussians.means.grad.numpy()
        drawn = gradients.any(axis=1)
        norms = screen_gradients(camera, gaussians.means.detach().numpy(), gradients)
        self._gradient += norms.reshape(self._gradient.shape)
        self._child_visits += drawn.reshape(self._child_visits.shape)
        uv, depth = camera.project(self.model.positions.numpy())
        inside = (depth > 0) & (uv > 0).all(axis=1) & (uv < [camera.width, camera.height]).all(axis=1)
        total = gaussians.opacities.detach().clamp(min=0).view(self._gradient.shape).sum(dim=1).numpy()
        self._opacity[inside] += total[inside]
        self._visits += inside

    def round(self) -> None:
        """Add anchors, then drop others; what was judged starts anew."""
        positions, parents, cells = self._candidates()
        judged = self._visits >= _PRUNE_VISITS * self.settings.grow_every
        dull = judged & (self._opacity < self.settings.prune_opacity * np.maximum(self._visits, 1))
        if dull.all() and not len(positions):
            dull[np.argmax(self._opacity)] = False  # a model of no anchors could not be fitted further
        self._forget(judged)
        kept = np.flatnonzero(~dull)
        n, k = len(positions), self.settings.children
        features = self.model.features.detach()[torch.from_numpy(parents)]
        scales = torch.from_numpy(np.log(cells).astype(np.float32))[:, None].expand(n, 6)
        new = {"features": features.view(n, FEATURES), "offsets": random_offsets(n, k), "log_scales": scales}
        self.optimizer.replace_anchors(kept, torch.from_numpy(positions), new)
        for name in ("_gradient", "_child_visits", "_opacity", "_visits"):
            old = getattr(self, name)
            setattr(self, name, np.concatenate([old[kept], np.zeros((n, *old.shape[1:]), old.dtype)]))

    def _forget(self, judged: NDArray[np.bool_]) -> None:
        enough = self._child_visits >= _GROW_VISITS * self.settings.grow_every
        for array, rows in (
            (self._gradient, enough), (self._child_visits, enough), (self._opacity, judged), (self._visits, judged),
        ):  # fmt: skip
            array[rows] = 0

    def _candidates(self) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float64]]:
        """New anchors: positions [n, 3], the anchors whose features they take [n], and their voxels' sizes [n]."""
        enough = self._child_visits >= _GROW_VISITS * self.settings.grow_every
        mean = np.where(enough, self._gradient / np.maximum(self._child_visits, 1), 0).reshape(-1)
        with torch.no_grad():
            model = self.model
            children = model.positions[:, None] + model.offsets * torch.exp(model.log_scales[:, None, :3])
        centers = children.reshape(-1, 3).numpy().astype(np.float64)
        anchors = model.positions.numpy().astype(np.float64)
        # The strongest first: it stands for its voxel, and gets the room that is left.
        order = np.argsort(-mean, kind="stable")
        order = order[mean[order] > self.settings.grow_gradient]
        room = self.settings.anchors - len(anchors)
        positions: list[NDArray] = [np.empty((0, 3))]
        parents: list[NDArray] = [np.empty(0, np.int64)]
        sizes: list[NDArray] = [np.empty(0)]
        for size, factor in LEVELS:
            cell = size * self.voxel
            level = order[mean[order] > factor * self.settings.grow_gradient]
            level = level[self._rng.random(len(level)) < _KEPT_CANDIDATES]
            keys = _cell_keys(centers[level], cell)
            taken = _cell_keys(np.concatenate([anchors, *positions]), cell)
            first = np.sort(np.unique(keys, return_index=True)[1])
            first = first[~np.isin(keys[first], taken)][:room]
            room -= len(first)
            positions.append(np.round(centers[level[first]] / cell) * cell)
            parents.append(level[first] // self.settings.children)
            sizes.append(np.full(len(first), cell))
        return np.concatenate(positions).astype(np.float32), np.concatenate(parents), np.concatenate(sizes)


def _cell_keys(points: NDArray[np.float64], cell: float) -> NDArray[np.int64]:
    """A number per point [N, 3] that is shared within a voxel (and by those a million voxels away)."""
    index = np.clip(np.round(points / cell), -_CELL_LIMIT, _CELL_LIMIT - 1).astype(np.int64) + _CELL_LIMIT
    return np.asarray((index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2])

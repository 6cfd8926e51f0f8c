"""Where still surroundings are, by the sparse points that come with a scene: what holds turned cameras to the world.

What cameras show in common says how they stand to each other, and hardly how all of them stand to the world: cameras
in a shallow arc may all turn about it, and every point has another place that is as good (a gauge). Sparse points are
where they were when the scene was calibrated. They are no features that could be matched, but they lie on surfaces, and
so does what cameras show: a point belongs to the plane through the sparse points around it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

# Sparse points that make a plane, and how many times wider than thick they lie there.
_AROUND, _FLAT = 20, 3.0
# Fewer sparse points than this say nothing, and of more an even share does.
_FEWEST, _MOST = 100, 50_000


@dataclass(frozen=True)
class Landmarks:
    """Planes through sparse points. places, normals: [M, 3], of each point the middle of those around it and the unit
    vector across them. tree: of the places."""

    places: NDArray[np.float64]
    normals: NDArray[np.float64]
    tree: KDTree

    @classmethod
    def of(cls, points: NDArray[np.floating] | None) -> Landmarks | None:
        """Those of sparse `points` [N, 3 or more], or None where they are too few or lie on no surfaces."""
        if points is None:
            return None
        known = np.asarray(points, dtype=np.float64)[:, :3]
        known = known[np.isfinite(known).all(axis=1)]
        known = known[np.linspace(0, max(len(known) - 1, 0), min(len(known), _MOST)).round().astype(np.int64)]
        known = np.unique(known, axis=0)
        if len(known) < _FEWEST:
            return None
        patches = known[KDTree(known).query(known, k=_AROUND)[1]]
        middles = patches.mean(axis=1)
        spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", patches - middles[:, None], patches - middles[:, None]))
        flat = spread[:, 1] > _FLAT**2 * np.maximum(spread[:, 0], 0)
        if flat.sum() < _FEWEST:
            return None
        middles = middles[flat]
        return cls(middles, axes[flat, :, 0], KDTree(middles))

    def nearest(self, points: NDArray[np.float64]) -> NDArray[np.intp]:
        """The planes that `points` [N, 3] are nearest to, [N]; -1 where there is none."""
        finite = np.isfinite(points).all(axis=1)
        found = np.full(len(points), -1, dtype=np.intp)
        found[finite] = self.tree.query(points[finite])[1]
        return found

    def off(self, points: NDArray[np.float64], planes: NDArray[np.intp]) -> NDArray[np.float64]:
        """How far `points` [..., N, 3] are from their `planes` [N], in scene units; 0 where there is none."""
        away = np.einsum("...ni,ni->...n", points - self.places[planes], self.normals[planes])
        return np.where(planes >= 0, away, 0.0)

"""Uniformity index UI (docs/protocol.md): sigma_D / mu_D against that of uniform random points in the same liquid.

Dividing by what as many points, spread at random through the observed liquid, score under the same kernel takes out
number, scale and the liquid's shape: 1 is as even as chance, below is more even, above is clustered.
"""

from __future__ import annotations

from typing import Protocol as TypingProtocol

import numpy as np
from numpy.typing import NDArray

from splashbench.score.particles.density import DensityStatistics, Points, frame_density
from splashbench.score.settings import PROTOCOL_V1, Protocol

# A node's phi and that of a point in the cell around it differ by at most half a cell's diagonal.
_HALF_DIAGONAL = 0.5 * np.sqrt(3.0)
_MAX_ROUNDS = 200


class DistanceFields(TypingProtocol):
    """What is needed of `splashbench.observe.SignedDistanceFields`."""

    @property
    def origin(self) -> NDArray[np.float64]: ...

    @property
    def voxel(self) -> float: ...

    @property
    def phi(self) -> NDArray[np.float32]: ...

    @property
    def longest_side(self) -> float: ...

    def sample(self, t: int, points: NDArray) -> NDArray[np.float32]:
        """phi at scene points [N, 3] in frame t, voxels, negative inside."""
        ...


def shell_points(fields: DistanceFields, t: int, count: int, depth: float) -> Points | None:
    """`count` points [count, 3], scene units, uniform in the shell -depth <= phi <= 0 (voxels) of frame `t`.

    None where the observed liquid of that frame is too thin for the grid to hold such points.
    """
    phi = fields.phi[t]
    nodes = np.argwhere((phi <= _HALF_DIAGONAL) & (phi >= -depth - _HALF_DIAGONAL))
    if len(nodes) == 0:
        return None
    rng = np.random.default_rng([t, count])
    batches: list[Points] = []
    n_points = 0
    for _ in range(_MAX_ROUNDS):
        corner = nodes[rng.integers(len(nodes), size=2 * count)] + rng.uniform(-0.5, 0.5, (2 * count, 3))
        points = fields.origin + fields.voxel * corner
        value = fields.sample(t, points)
        batches.append(points[(value <= 0) & (value >= -depth)])
        n_points += len(batches[-1])
        if n_points >= count:
            return np.concatenate(batches)[:count]
    return None


def frame_uniformity(
    density: DensityStatistics, fields: DistanceFields, t: int, scale: float, protocol: Protocol = PROTOCOL_V1
) -> float | None:
    """UI of one frame, or None where it has no meaning (no neighbours, or liquid too thin for the grid).

    Args:
        density: of the particles, from `frame_density`.
        fields: signed distance from the training masks.
        scale: from scene units to those of the released scenes, the same as for the particles.
    """
    points = shell_points(fields, t, density.count, protocol.shell_depth_voxels)
    if points is None or density.ratio is None:
        return None
    chance = frame_density(points * scale, t, protocol)
    return None if chance is None or not chance.ratio else density.ratio / chance.ratio

"""SPH density of the particles: sigma_D and mu_D (paper, supplement, "Evaluation Protocol").

Incompressible liquid has the same density everywhere, so the spread sigma_D should be small. A smaller cloud lowers it
too, so methods are ranked by the uniformity index (uniformity.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.score.particles.neighbours import nearest_poly6_sums
from splashbench.score.settings import PROTOCOL_V1, Protocol

Points = NDArray[np.float64]


@dataclass(frozen=True)
class DensityStatistics:
    """Density over the particles of one frame: standard deviation, mean, and how many were evaluated."""

    sigma: float
    mu: float
    count: int

    @property
    def ratio(self) -> float | None:
        """sigma / mu; None where no particle has a neighbour within the kernel."""
        return self.sigma / self.mu if self.mu > 0 else None


def poly6_densities(points: Points, protocol: Protocol = PROTOCOL_V1) -> NDArray[np.float64]:
    """Density [N] at each of `points` [N, 3]: the sum of Poly6 over its nearest neighbours, unit mass, self excluded.

    W(r) = 315 / (64 pi h^9) (h^2 - r^2)^3 for r < h.
    """
    h = protocol.kernel_radius
    return 315.0 / (64.0 * np.pi * h**9) * nearest_poly6_sums(points, protocol.neighbours, h)


def frame_density(points: Points, t: int, protocol: Protocol = PROTOCOL_V1) -> DensityStatistics | None:
    """Density statistics of the particles [N, 3] of frame `t`, in units where the released scenes' h holds.

    More than `particle_cap` particles are subsampled, and the statistics averaged over the seeds. Too few particles for
    a full neighbourhood have no density: None, which is not 0. The result does not depend on the particles' order.
    """
    if len(points) <= protocol.neighbours:
        return None
    points = points[np.lexsort(points.T)]
    if len(points) <= protocol.particle_cap:
        densities = poly6_densities(points, protocol)
        return DensityStatistics(float(densities.std()), float(densities.mean()), len(points))
    sigmas, mus = [], []
    for seed in range(protocol.subsample_seeds):
        chosen = np.random.default_rng([seed, t]).choice(len(points), protocol.particle_cap, replace=False)
        densities = poly6_densities(points[chosen], protocol)
        sigmas.append(densities.std())
        mus.append(densities.mean())
    return DensityStatistics(float(np.mean(sigmas)), float(np.mean(mus)), protocol.particle_cap)

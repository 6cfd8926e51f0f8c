"""The liquid's share of a mixed method's primitives (paper, supplement, "Evaluation Protocol").

Baselines hold background and liquid in one set; their liquid is what observe/consistency.py lets through.
"""

from __future__ import annotations

import numpy as np

from splashbench.observe.consistency import silhouette_consistent
from splashbench.scene import Particles, Scene


def liquid_of_mixed(particles: Particles, scene: Scene) -> Particles:
    """`particles` with those inactive that lie outside the silhouette of any training view."""
    active = particles.active.copy()
    for t in range(particles.n_frames):
        shown = np.flatnonzero(active[t])
        active[t, shown] = silhouette_consistent(particles.positions[t, shown], scene, t)
    return Particles(particles.positions, active, particles.velocities)

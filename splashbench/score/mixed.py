"""The liquid's share of a mixed method's primitives (paper, supplement, "Evaluation Protocol").

Baselines hold background and liquid in one set. Their liquid is the part that observe/consistency.py accepts.
"""

from __future__ import annotations

import numpy as np

from splashbench.observe.consistency import silhouette_consistent
from splashbench.scene import Particles, Scene


def liquid_of_mixed(particles: Particles, scene: Scene) -> Particles:
    """`particles`, of which those outside the silhouette of any training view are inactive."""
    active = particles.active.copy()
    for t in range(particles.n_frames):
        shown = np.flatnonzero(active[t])
        active[t, shown] = silhouette_consistent(particles.positions[t, shown], scene, t)
    return Particles(particles.positions, active, particles.velocities)

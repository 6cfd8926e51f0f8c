"""The liquid's share of a mixed method's primitives (paper, supplement, "Evaluation Protocol").

Baselines hold background and liquid in one set; their liquid is what projects inside the silhouette in all training
views. It is a conservative choice: liquid seen by part of the rig only is lost with the background.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splashbench.scene import Camera, Particles, Scene


def inside_mask(points: NDArray[np.floating], camera: Camera, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of `points` [N, 3] fall on a pixel of `mask` [H, W] as seen by `camera`."""
    pixels, depth = camera.project(points)
    column, row = np.floor(pixels[:, 0]), np.floor(pixels[:, 1])
    height, width = mask.shape
    seen = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    inside = np.zeros(len(pixels), dtype=bool)
    inside[seen] = mask[row[seen].astype(int), column[seen].astype(int)]
    return inside


def liquid_of_mixed(particles: Particles, scene: Scene) -> Particles:
    """`particles` with those inactive that lie outside the silhouette of any training view."""
    active = particles.active.copy()
    for t in range(particles.n_frames):
        for name in scene.train:
            candidates = np.flatnonzero(active[t])
            if candidates.size == 0:
                break
            inside = inside_mask(particles.positions[t, candidates], scene.cameras[name], scene.mask(name, t))
            active[t, candidates[~inside]] = False
    return Particles(particles.positions, active, particles.velocities)

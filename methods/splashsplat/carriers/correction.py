"""Correction of carriers that left the observed liquid (paper, Eq. sdf_correction).

Positions are transport-grid coordinates, distances transport voxels.
"""

from __future__ import annotations

import numpy as np

from splashbench.observe.kernels import sample


def normals(phi: np.ndarray, points: np.ndarray, ratio: float) -> np.ndarray:
    """Unit gradients of phi at `points` [N, 3] (its node coordinates); differences over +-`ratio` of its voxels."""
    points = np.asarray(points, dtype=np.float32)
    gradient = np.empty((len(points), 3), dtype=np.float32)
    for axis in range(3):
        step = np.zeros(3, dtype=np.float32)
        step[axis] = ratio
        gradient[:, axis] = sample(phi, points + step) - sample(phi, points - step)
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    return gradient / np.maximum(length, 1e-9)


def correct(phi: np.ndarray, positions: np.ndarray, ratio: float, limit: float) -> np.ndarray:
    """Moves carriers outside the hull (phi > 0) towards it by min(phi, limit) along the normal; leaves others alone.

    phi: hull-grid field in transport voxels; ratio: hull voxels per transport voxel. positions: [N, 3].
    """
    outside = sample(phi, positions * np.float32(ratio))
    exterior = np.nonzero(outside > 0)[0]
    corrected = positions.copy()
    if len(exterior):
        direction = normals(phi, positions[exterior] * np.float32(ratio), ratio)
        corrected[exterior] -= np.minimum(outside[exterior], limit)[:, None] * direction
    return corrected

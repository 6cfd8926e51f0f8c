"""Which points the silhouettes allow to be liquid: those that project inside it in all training views.

The paper's silhouette-consistent filter (supplement, "Evaluation Protocol"). It picks out the liquid of methods that
hold background and liquid in one set of primitives. A conservative choice: liquid that part of the rig alone sees is
lost with the background.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from splashbench.observe.silhouettes import MaskedScene
from splashbench.scene import Camera


def inside_mask(points: NDArray[np.floating], camera: Camera, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of `points` [N, 3] fall on a pixel of `mask` [H, W] as seen by `camera`."""
    pixels, depth = camera.project(points)
    column, row = np.floor(pixels[:, 0]), np.floor(pixels[:, 1])
    height, width = mask.shape
    seen = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    inside = np.zeros(len(pixels), dtype=bool)
    inside[seen] = mask[row[seen].astype(int), column[seen].astype(int)]
    return inside


def silhouette_consistent(
    points: NDArray[np.floating] | Mapping[str, NDArray[np.floating]], scene: MaskedScene, t: int
) -> NDArray[np.bool_]:
    """Which of `points` [N, 3], scene units, lie inside the silhouettes of all training views at timestep `t`.

    points: the same for all views, or by training view, where each was photographed at an instant of its own.
    """
    by_view = points if isinstance(points, Mapping) else dict.fromkeys(scene.train, points)
    candidates = np.arange(len(by_view[scene.train[0]]))
    consistent = np.zeros(len(candidates), dtype=bool)
    for name in scene.train:
        candidates = candidates[np.isfinite(by_view[name][candidates]).all(axis=1)]
        if candidates.size == 0:
            break
        candidates = candidates[inside_mask(by_view[name][candidates], scene.cameras[name], scene.mask(name, t))]
    consistent[candidates] = True
    return consistent

"""Points to start a reconstruction from: the scene's own static ones, and the surface of each timestep's visual hull.

Methods elsewhere start from a sparse reconstruction; liquid has none, as nothing on it can be matched between views.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splashbench.observe.grid import Grid
from splashbench.observe.hull import sequence_bounds
from splashbench.observe.signed_distance import signed_distance_frames
from splashbench.observe.silhouettes import Silhouettes
from splashbench.progress import track
from splashbench.scene import Scene, TrainingScene
from splashbench.scene.export import InitialPoints

CELLS = 96
#: Half the thickness, in voxels, of the layer of nodes that stands for a surface; thin streams are in it too.
_LAYER = 0.5
_PADDING = 0.02
_SEED = 0


def initial_points(scene: Scene | TrainingScene, liquid_per_frame: int) -> InitialPoints:
    """The points of `scene`, with at most `liquid_per_frame` of the liquid in each timestep; 0 leaves the liquid out.

    A point of the liquid is a node of the hull's grid within half a voxel of its surface. Its colour is the median of
    those that the training views have at its place, whatever is in front of it.

    Raises SplashbenchError when the masks have no common hull.
    """
    sparse = scene.initial_points()
    static = np.zeros((0, 6)) if sparse is None else sparse[:, :6].astype(np.float64)
    if liquid_per_frame < 1:
        return InitialPoints(static, tuple(np.zeros((0, 6)) for _ in range(scene.n_frames)))
    silhouettes = Silhouettes(scene)
    grid = Grid.over(sequence_bounds(silhouettes).padded(_PADDING), CELLS)
    rng = np.random.default_rng(_SEED)
    fields = track(signed_distance_frames(silhouettes, grid), "points of the hull", total=scene.n_frames)
    return InitialPoints(
        static, tuple(_surface(scene, grid, phi, t, liquid_per_frame, rng) for t, phi in enumerate(fields))
    )


def _surface(
    scene: Scene | TrainingScene, grid: Grid, phi: NDArray, t: int, most: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Coloured points [n, 6] of timestep `t`, whose signed distance in voxels on `grid` is `phi`."""
    nodes = np.argwhere(np.abs(phi) <= _LAYER)
    if len(nodes) > most:
        nodes = nodes[np.sort(rng.choice(len(nodes), most, replace=False))]
    positions = grid.to_scene(nodes)
    if not len(positions):
        return np.zeros((0, 6))
    seen = []
    for name in scene.train:
        camera = scene.cameras[name]
        pixels, depth = camera.project(positions)
        column, row = np.floor(pixels).astype(int).T
        inside = (depth > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        colours = np.full((len(positions), 3), np.nan)
        colours[inside] = scene.image(name, t)[row[inside], column[inside]] / 255.0
        seen.append(colours)
    return np.concatenate([positions, _median(np.stack(seen))], axis=1)


def _median(colours: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median over views [V, n, 3] without those that do not see the point (NaN); grey where none does."""
    unseen = np.isnan(colours).all(axis=0)
    return np.nanmedian(np.where(unseen, 0.5, colours), axis=0)

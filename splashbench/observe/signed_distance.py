"""Signed distance fields phi_t of the observed liquid (paper, "Observed geometry" and "Observation fields").

Two ways: "silhouette" takes phi straight from the silhouettes (hull.py), sub-voxel and about 3.5 times as fast, the
default; "carve" is the paper's: binary carving, then a 3-D distance transform. Both are negative inside.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from splashbench.observe.failures import trusted_bounds
from splashbench.observe.grid import Bounds, Grid
from splashbench.observe.hull import carve_frame, sequence_bounds
from splashbench.observe.kernels import sample
from splashbench.observe.occlusion import LIMIT_VOXELS, CarvingOcclusion, ContainerOcclusion
from splashbench.observe.silhouettes import MaskedScene, Silhouettes

SignedDistanceMethod = Literal["silhouette", "carve"]
PADDING = 0.1


@dataclass(frozen=True)
class SignedDistanceFields:
    """phi of every frame on one grid, in voxels, clipped to +-20 voxels; a frame without liquid is +20 everywhere."""

    grid: Grid
    bounds: Bounds
    phi: np.ndarray

    @property
    def origin(self) -> np.ndarray:
        """Position of node (0, 0, 0), float64 [3], scene units."""
        return self.grid.origin

    @property
    def voxel(self) -> float:
        """Spacing of the nodes, scene units."""
        return self.grid.voxel

    @property
    def longest_side(self) -> float:
        """Longest side of the box around the hulls of all frames, without padding, scene units."""
        return self.bounds.longest_side

    def sample(self, t: int, points: np.ndarray) -> np.ndarray:
        """phi_t at `points` [N, 3] in scene units: float32 [N], voxels; beyond the grid, its distance is added."""
        nodes = self.grid.to_voxels(points).reshape(-1, 3)
        clamped = np.clip(nodes, 0, np.array(self.grid.shape, dtype=np.float32) - 1)
        return sample(self.phi[t], clamped) + np.linalg.norm(nodes - clamped, axis=1).astype(np.float32)


def signed_distance_of(occupied: np.ndarray) -> np.ndarray:
    """Signed distance in voxels to the outline of `occupied` (bool [nx, ny, nz]), negative inside: float32."""
    from scipy.ndimage import distance_transform_edt

    if not occupied.any():
        return np.full(occupied.shape, LIMIT_VOXELS, dtype=np.float32)
    if occupied.all():
        return np.full(occupied.shape, -LIMIT_VOXELS, dtype=np.float32)
    # Farther from the liquid than the limit nothing is to be found out.
    reach = int(np.ceil(LIMIT_VOXELS)) + 1
    spans = [np.nonzero(occupied.any(axis=axes))[0][[0, -1]] for axes in ((1, 2), (0, 2), (0, 1))]
    near = tuple(slice(max(first - reach, 0), last + reach + 1) for first, last in spans)
    part = occupied[near]
    inside, outside = distance_transform_edt(part), distance_transform_edt(~part)
    distance = np.full(occupied.shape, LIMIT_VOXELS, dtype=np.float32)
    distance[near] = np.clip(np.where(part, 0.5 - inside, outside - 0.5), -LIMIT_VOXELS, LIMIT_VOXELS)
    return distance


def signed_distance_frames(
    silhouettes: Silhouettes,
    grid: Grid,
    method: SignedDistanceMethod = "silhouette",
    container: ContainerOcclusion | None = None,
    frames: Iterable[int] | None = None,
) -> Iterator[np.ndarray]:
    """phi of one frame after another on `grid`, float32 [nx, ny, nz] in voxels: no more than one frame in memory.

    container: where given, no liquid is in its walls, and what it hides from a view is not held against the liquid.
    frames: which ones; all by default.
    """
    carving = CarvingOcclusion.of(container, silhouettes, grid)
    for t in range(silhouettes.n_frames) if frames is None else frames:
        phi = carve_frame(silhouettes, grid, t, carving)
        yield phi if method == "silhouette" else signed_distance_of(phi < 0)


def signed_distance_fields(
    scene: MaskedScene,
    cells_longest_axis: int = 96,
    views: Sequence[str] | None = None,
    method: SignedDistanceMethod = "silhouette",
    container: ContainerOcclusion | None = None,
    detect_failed_masks: bool = False,
) -> SignedDistanceFields:
    """phi of all frames from the masks of `views` (all training views by default).

    The grid spans the box around the hulls of all frames with 10% padding, with `cells_longest_axis` cubic cells
    along its longest side. container: see `signed_distance_frames`. detect_failed_masks: whether masks that miss large
    parts of the liquid are looked for and replaced (failures.py).

    Raises SplashbenchError when the masks have no common hull.
    """
    silhouettes = Silhouettes(scene, views)
    bounds = (trusted_bounds if detect_failed_masks else sequence_bounds)(silhouettes, container)
    grid = Grid.over(bounds.padded(PADDING), cells_longest_axis)
    frames = list(signed_distance_frames(silhouettes, grid, method, container))
    return SignedDistanceFields(grid, bounds, np.stack(frames))

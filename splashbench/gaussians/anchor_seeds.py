"""Where the anchors start: the scene's sparse points, or every training view's pixels lifted to their depth.

Sparse points are merged on voxels as in Scaffold-GS, `unique(round(p / voxel)) voxel` (Lu et al. 2024, Eq. 4). Pixels
on a regular grid are lifted to the depth that splashbench/background gives. All views' points are merged likewise, each
anchor at the mean of its points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from splashbench.background.clean_plate import CleanPlate
from splashbench.background.depth import DepthMap, depth_maps, guessed, interpolated, lift, pixels_at

# Lifted points per anchor kept: voxels merge what several views see.
_OVERSAMPLING = 3.0
# Where pixels are lifted, anchors may grow to this many times the density along an axis.
_FINEST = 2.0


@dataclass(frozen=True)
class AnchorSeed:
    """Anchors before fitting: positions [N, 3] scene units, colours [N, 3] in [0, 1], spacing [N] scene units.

    voxel: scene units, the finest voxel on which anchors may grow.
    """

    positions: NDArray[np.float32]
    colors: NDArray[np.float32]
    spacing: NDArray[np.float32]
    voxel: float


def sparse_anchors(points: NDArray[np.float32], count: int) -> AnchorSeed:
    """At most `count` anchors from sparse points [N, 6 or more] (x y z r g b ...), one per occupied voxel.

    The voxel is the median distance of a point to its nearest neighbour, or as much wider as `count` asks for.
    """
    positions, colors = points[:, :3].astype(np.float64), points[:, 3:6].astype(np.float64)
    distinct = np.unique(positions, axis=0)
    voxel = float(np.median(cKDTree(distinct).query(distinct, k=2)[0][:, 1])) if len(distinct) > 1 else 1.0
    while True:
        cells, owner = np.unique(np.round(positions / voxel), axis=0, return_inverse=True)
        if len(cells) <= count:
            break
        voxel *= 1.25
    owner = owner.reshape(-1)
    centers = cells * voxel
    return _anchor_seed(centers, _means(owner, colors), _spacing(centers), voxel)


def seed_anchors(
    points: NDArray[np.float32] | None, plates: list[CleanPlate], count: int, rng: np.random.Generator
) -> AnchorSeed:
    """At most `count` anchors from sparse points [N, 6 or more] (x y z r g b ...), or None, and the training plates."""
    pixels = sum(plate.camera.width * plate.camera.height for plate in plates)
    stride = max(1.0, float(np.sqrt(pixels / (_OVERSAMPLING * count))))
    maps: list[DepthMap] | list[None] = depth_maps(points, plates) or [None] * len(plates)
    lifted = [_lift(points, plate, depth, plates, stride, rng) for plate, depth in zip(plates, maps)]
    positions = np.concatenate([xyz for xyz, _ in lifted])
    colors = np.concatenate([rgb for _, rgb in lifted])
    return _merge(positions, colors, count)


def _lift(
    points: NDArray[np.float32] | None,
    plate: CleanPlate,
    depth: DepthMap | None,
    plates: list[CleanPlate],
    stride: float,
    rng: np.random.Generator,
) -> tuple[NDArray, NDArray]:
    """World points and colours of a grid of seen pixels of one view."""
    camera = plate.camera
    columns, rows = np.meshgrid(
        np.arange(stride / 2, camera.width, stride), np.arange(stride / 2, camera.height, stride)
    )
    uv = np.stack([columns.ravel(), rows.ravel()], axis=1)
    cell = uv.astype(int)
    uv, cell = (a[plate.seen[cell[:, 1], cell[:, 0]]] for a in (uv, cell))
    inverse = np.zeros(len(uv))
    used = unknown = np.ones(len(uv), dtype=bool)
    if depth is not None:
        row, column, _ = pixels_at(depth.camera, uv * depth.camera.width / camera.width)
        inverse = depth.inverse[row, column].astype(np.float64)
        trusted = depth.trusted[row, column]
        # What trusted pixels of other views cover needs no worse guess.
        used, unknown = trusted | ~depth.covered[row, column], ~trusted
    interpolation = None if points is None else interpolated(points[:, :3], camera, uv[unknown])
    inverse[unknown] = (
        guessed(camera, [p.camera for p in plates], int(unknown.sum()), rng) if interpolation is None else interpolation
    )
    return lift(camera, uv[used], inverse[used]), plate.image[cell[used, 1], cell[used, 0]] / 255


def _merge(positions: NDArray, colors: NDArray, count: int) -> AnchorSeed:
    """One anchor per occupied voxel, at the mean of its points; the voxel is the smallest that leaves `count`."""
    center = np.median(positions, axis=0)
    # Far points are kept apart less finely, as in an image: voxels are uniform in a contracted space.
    scale = float(np.median(np.linalg.norm(positions - center, axis=1))) + 1e-12
    radius = np.linalg.norm(positions - center, axis=1, keepdims=True) / scale
    contracted = (
        (positions - center)
        / scale
        * np.where(radius <= 2, 1.0, (4 - 4 / np.maximum(radius, 2)) / np.maximum(radius, 2))
    )
    low, high = 1e-4, 1.0
    for _ in range(16):
        voxel = np.sqrt(low * high)
        occupied = len(np.unique(_cells(contracted, voxel)))
        low, high = (low, voxel) if occupied <= count else (voxel, high)
    _, owner = np.unique(_cells(contracted, high), return_inverse=True)
    merged, merged_colors = _means(owner, positions), _means(owner, colors)
    spacing = _spacing(merged)
    return _anchor_seed(merged, merged_colors, spacing, float(np.median(spacing)) / _FINEST)


def _anchor_seed(positions: NDArray, colors: NDArray, spacing: NDArray, voxel: float) -> AnchorSeed:
    return AnchorSeed(positions.astype(np.float32), colors.astype(np.float32), spacing.astype(np.float32), voxel)


def _means(owner: NDArray[np.int64], values: NDArray) -> NDArray[np.float64]:
    """Means [N, 3] of the rows of `values` [M, 3] that share an `owner` [M] in range(N)."""
    share = np.bincount(owner)[:, None]
    return np.stack([np.bincount(owner, weights=values[:, c]) for c in range(3)], axis=1) / share


def _spacing(positions: NDArray) -> NDArray[np.float64]:
    """Mean distance [N] of each position [N, 3] to its three nearest neighbours; 1 for a single one."""
    k = min(4, len(positions))
    if k == 1:
        return np.ones(1)
    distance = cKDTree(positions).query(positions, k=k)[0][:, 1:].mean(axis=1)
    return np.asarray(np.clip(distance, 1e-3 * np.median(distance) + 1e-9, None))


def _cells(contracted: NDArray, voxel: float) -> NDArray[np.int64]:
    """A number per point that is shared within a voxel; contracted space lies within radius 4."""
    cell = np.round(contracted / voxel).astype(np.int64) + (1 << 19)
    return np.asarray((cell[:, 0] << 40) | (cell[:, 1] << 20) | cell[:, 2])

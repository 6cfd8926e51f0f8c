"""Where the anchors start: every training view's pixels lifted to their depth, with their own colour.

Pixels on a regular grid are lifted to the depth that depth.py gives, and all views' points are merged on voxels as in
Scaffold-GS, `unique(round(p / voxel))`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from splashbench_methods.scaffold_gs.depth import DepthMap, depth_maps, guessed, interpolated, lift
from splashbench_methods.scaffold_gs.plate import Plate

# Lifted points per anchor kept: voxels merge what several views see.
_OVERSAMPLING = 3.0


@dataclass(frozen=True)
class AnchorSeed:
    """Anchors before fitting: positions [N, 3] scene units, colours [N, 3] in [0, 1], spacing [N] scene units."""

    positions: NDArray[np.float32]
    colors: NDArray[np.float32]
    spacing: NDArray[np.float32]


def seed_anchors(
    points: NDArray[np.float32] | None, plates: list[Plate], count: int, rng: np.random.Generator
) -> AnchorSeed:
    """At most `count` anchors from sparse points [N, 6 or more] (x y z r g b ...), or None, and the training plates."""
    pixels = sum(plate.camera.width * plate.camera.height for plate in plates)
    stride = max(1.0, float(np.sqrt(pixels / (_OVERSAMPLING * count))))
    maps = depth_maps(points, plates) or [None] * len(plates)
    lifted = [_lift(points, plate, depth, plates, stride, rng) for plate, depth in zip(plates, maps)]
    positions = np.concatenate([xyz for xyz, _ in lifted])
    colors = np.concatenate([rgb for _, rgb in lifted])
    return _merge(positions, colors, count)


def _lift(
    points: NDArray[np.float32] | None,
    plate: Plate,
    depth: DepthMap | None,
    plates: list[Plate],
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
    kept = unknown = np.ones(len(uv), dtype=bool)
    if depth is not None:
        row, column, _ = depth.pixels(uv * depth.camera.width / camera.width)
        inverse = depth.inverse[row, column].astype(np.float64)
        trusted = depth.trusted[row, column]
        # What trusted pixels of other views cover needs no worse guess.
        kept, unknown = trusted | ~depth.covered[row, column], ~trusted
    known = None if points is None else interpolated(points[:, :3], camera, uv[unknown])
    inverse[unknown] = guessed(camera, [p.camera for p in plates], int(unknown.sum()), rng) if known is None else known
    return lift(camera, uv[kept], inverse[kept]), plate.image[cell[kept, 1], cell[kept, 0]]


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
    share = np.bincount(owner)[:, None]
    merged, merged_colors = (
        np.stack([np.bincount(owner, weights=a[:, c]) for c in range(3)], axis=1) / share for a in (positions, colors)
    )
    k = min(4, len(merged))
    spacing = cKDTree(merged).query(merged, k=k)[0].reshape(len(merged), k)[:, 1:].mean(axis=1) if k > 1 else np.ones(1)
    spacing = np.clip(spacing, 1e-3 * np.median(spacing) + 1e-9, None)
    return AnchorSeed(*(a.astype(np.float32) for a in (merged, merged_colors, spacing)))


def _cells(contracted: NDArray, voxel: float) -> NDArray[np.int64]:
    """A number per point that is shared within a voxel; contracted space lies within radius 4."""
    cell = np.round(contracted / voxel).astype(np.int64) + (1 << 19)
    return np.asarray((cell[:, 0] << 40) | (cell[:, 1] << 20) | cell[:, 2])

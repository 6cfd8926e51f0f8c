"""Where the anchors start: the scene's sparse points, filled in along every training view's rays.

Structure from motion gives one to three thousand points, too few to cover an image. A plane's inverse depth is
an affine function of the pixel, so each view's inverse depth is fitted affinely to the sparse points around a
pixel; pixels on a regular grid are then lifted to that depth with their own colour, and all views' points are
merged on voxels as in Scaffold-GS, `unique(round(p / voxel))`.

Without sparse points, rays are sampled at random depths: most within the space that all training cameras look at, the
rest on far shells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from splashbench_methods.scaffold_gs.plate import Plate

from splashbench.scene import Camera

# Lifted points per anchor kept: voxels merge what several views see.
_OVERSAMPLING = 3.0
# A sparse point this much farther than the nearest ones around it is taken to be hidden behind them.
_HIDDEN = 1.1
_NEIGHBOURS = 12
_MIN_POINTS_PER_VIEW = 8


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
    lifted = [_lift(points, plate, plates, stride, rng) for plate in plates]
    positions = np.concatenate([xyz for xyz, _ in lifted])
    colors = np.concatenate([rgb for _, rgb in lifted])
    return _merge(positions, colors, count)


def _lift(
    points: NDArray[np.float32] | None, plate: Plate, plates: list[Plate], stride: float, rng: np.random.Generator
) -> tuple[NDArray, NDArray]:
    """World points and colours of a grid of seen pixels of one view."""
    camera = plate.camera
    columns, rows = np.meshgrid(
        np.arange(stride / 2, camera.width, stride), np.arange(stride / 2, camera.height, stride)
    )
    uv = np.stack([columns.ravel(), rows.ravel()], axis=1)
    cell = uv.astype(int)
    uv, cell = (a[plate.seen[cell[:, 1], cell[:, 0]]] for a in (uv, cell))
    inverse_depth = None if points is None else _interpolated(points[:, :3], camera, uv)
    if inverse_depth is None:
        inverse_depth = _guessed(camera, [p.camera for p in plates], len(uv), rng)
    local = np.concatenate([uv, np.ones((len(uv), 1))], axis=1) @ np.linalg.inv(camera.K).T / inverse_depth[:, None]
    return (local - camera.w2c[:3, 3]) @ camera.w2c[:3, :3], plate.image[cell[:, 1], cell[:, 0]]


def _interpolated(points: NDArray, camera: Camera, uv: NDArray) -> NDArray | None:
    """Inverse depth at pixels [M, 2] from the sparse points this view can see; None where there are too few."""
    at, depth = camera.project(points)
    margin = 0.1 * np.array([camera.width, camera.height])
    near = (
        (depth > 0) & (at > -margin).all(axis=1) & (at < np.array([camera.width, camera.height]) + margin).all(axis=1)
    )
    at, depth = at[near], depth[near]
    if len(at) < _MIN_POINTS_PER_VIEW:
        return None
    _, around = cKDTree(at).query(at, k=min(6, len(at)))
    seen = depth < _HIDDEN * np.partition(depth[around], 1, axis=1)[:, 1]
    if seen.sum() >= _MIN_POINTS_PER_VIEW:
        at, depth = at[seen], depth[seen]
    inverse = 1.0 / depth
    distance, around = cKDTree(at).query(uv, k=min(_NEIGHBOURS, len(at)))
    values = _affine(at, inverse, uv, distance, around)
    low, high = np.percentile(inverse, [1, 99])
    clipped: NDArray = np.clip(values, 0.5 * low, 1.5 * high)
    return clipped


def _affine(at: NDArray, inverse: NDArray, uv: NDArray, distance: NDArray, around: NDArray) -> NDArray:
    """Inverse depth at `uv` from a weighted affine fit over each pixel's neighbours (a plane through them)."""
    scale = distance[:, -1:] + 1e-6
    weights = np.exp(-2 * (distance / scale) ** 2)
    offset = (at[around] - uv[:, None]) / scale[..., None]
    basis = np.concatenate([np.ones_like(offset[..., :1]), offset], axis=2)
    # The slope is damped: a few points on a line must not throw the rest of the image to infinity.
    weighted = (basis * weights[..., None]).transpose(0, 2, 1)
    normal = weighted @ basis + np.diag([0.0, 1e-2, 1e-2])
    return np.asarray(np.linalg.solve(normal, weighted @ inverse[around][..., None])[:, 0, 0])


def look_at(cameras: list[Camera]) -> NDArray[np.float64]:
    """The point [3] nearest to the rays through all image centres, in the sense of least squares."""
    centers = np.stack([camera.center for camera in cameras])
    middles = np.array([[camera.width / 2, camera.height / 2, 1.0] for camera in cameras])
    rays = np.stack([camera.w2c[:3, :3].T @ np.linalg.solve(camera.K, uv) for camera, uv in zip(cameras, middles)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    # The small term settles rays that are parallel: one unit before the cameras.
    settled = 1e-6 * (centers + rays).mean(axis=0)
    total = (across @ centers[..., None]).sum(axis=0)[:, 0]
    return np.asarray(np.linalg.solve(across.sum(axis=0) + 1e-6 * np.eye(3), total + settled))


def _guessed(camera: Camera, cameras: list[Camera], n: int, rng: np.random.Generator) -> NDArray:
    """Inverse depths without any points: two thirds around the point looked at, one third up to ten times as far."""
    distance = float(camera.w2c[2, :3] @ look_at(cameras) + camera.w2c[2, 3])
    distance = abs(distance) if abs(distance) > 1e-6 else 1.0
    inverse = rng.uniform(1 / 1.4, 1 / 0.7, n)
    far = rng.random(n) < 1 / 3
    inverse[far] = rng.uniform(0.1, 1 / 1.4, int(far.sum()))
    return inverse / distance


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

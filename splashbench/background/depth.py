"""Depth of every clean plate's pixels: by plane sweep where two views agree, else from the scene's sparse points.

Structure from motion gives one to a few thousand points, few of them on smooth surfaces, so a container may have none.
The sweep (plane_sweep.py) sees its edges. Where no other view's sweep confirms a depth, each view's inverse depth is
fitted affinely to the sparse points around a pixel: on a plane, inverse depth is an affine function of the pixel.
Without sparse points, depths are drawn at random (`guessed`): most within the space that all training cameras look at,
the rest far behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from splashbench.background.clean_plate import CleanPlate, shrunk
from splashbench.background.plane_sweep import PLANES, inverse_depth
from splashbench.scene import Camera

#: The sweep sees plates of at most this size, in pixels.
SWEEP_SIDE = 400
# Two sweeps agree when their inverse depths differ by at most so many planes.
_TOLERANCE_PLANES = 1.0
# Sparse points only say roughly how near and far a scene reaches.
_RANGE_MARGIN = 0.3
_PRIOR_STRIDE = 4
# What trusted pixels cover of another view: their projections, grown by so many pixels.
_COVER_RADIUS = 3
# A sparse point this much farther than the nearest ones around it is taken to be hidden behind them.
_HIDDEN = 1.1
_NEIGHBOURS = 12
_MIN_POINTS_PER_VIEW = 8
# Without points: inverse depths relative to that of the point looked at.
_FAR, _MIDDLE, _NEAR = 0.1, 1 / 1.4, 1 / 0.7


@dataclass
class DepthMap:
    """What the sweep says of one view, at the sweep's size.

    camera: the view at that size. inverse: float32 [H, W], inverse depth. trusted: bool [H, W], where another view's
    sweep agrees. covered: bool [H, W], where some view's trusted pixels project. cost: float32 [H, W], how much colours
    of views differ there, as a share of full scale.
    """

    camera: Camera
    inverse: NDArray[np.float32]
    trusted: NDArray[np.bool_]
    covered: NDArray[np.bool_]
    cost: NDArray[np.float32]

    def lifted(self) -> NDArray[np.float64]:
        """World points of all pixels, [H, W, 3]."""
        v, u = np.mgrid[: self.camera.height, : self.camera.width] + 0.5
        points = lift(self.camera, np.stack([u.ravel(), v.ravel()], axis=1), self.inverse.ravel())
        return points.reshape(*self.inverse.shape, 3)


def pixels_at(camera: Camera, uv: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Rows, columns (within the image) and whether they are of the image, of pixel positions [N, 2]."""
    column, row = np.floor(uv).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    return np.clip(row, 0, camera.height - 1), np.clip(column, 0, camera.width - 1), inside


def lift(camera: Camera, uv: NDArray, inverse: NDArray) -> NDArray[np.float64]:
    """World points [N, 3] at inverse depths [N] behind pixel positions [N, 2]."""
    local = np.concatenate([uv, np.ones((len(uv), 1))], axis=1) @ np.linalg.inv(camera.K).T / inverse[:, None]
    world: NDArray[np.float64] = (local - camera.w2c[:3, 3]) @ camera.w2c[:3, :3]
    return world


def depth_maps(points: NDArray[np.float32] | None, plates: list[CleanPlate]) -> list[DepthMap]:
    """Sweep all plates; points: sparse points [N, 3 or more], or None. Empty with fewer than two plates."""
    if len(plates) < 2:
        return []
    plates = [shrunk(plate, SWEEP_SIDE) for plate in plates]
    cameras = [plate.camera for plate in plates]
    priors = [None if points is None else _prior(points[:, :3], camera) for camera in cameras]
    low, high = _inverse_range(priors, cameras)
    maps = []
    for view, plate in enumerate(plates):
        inverse, cost = inverse_depth(view, plates, low, high, priors[view])
        maps.append(DepthMap(plate.camera, inverse, np.zeros_like(plate.seen), np.zeros_like(plate.seen), cost))
    clouds = [depth.lifted() for depth in maps]
    for depth, plate, cloud in zip(maps, plates, clouds):
        others = [other for other in maps if other is not depth]
        tolerance = _TOLERANCE_PLANES * (high - low) / (PLANES - 1)
        confirmed = np.any([_agrees(cloud.reshape(-1, 3), other, tolerance) for other in others], axis=0)
        depth.trusted = confirmed.reshape(plate.seen.shape) & plate.seen
    # Every second pixel will do to see what the trusted ones cover.
    trusted = np.concatenate([cloud[::2, ::2][depth.trusted[::2, ::2]] for depth, cloud in zip(maps, clouds)])
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _COVER_RADIUS + 1, 2 * _COVER_RADIUS + 1))
    for depth in maps:
        uv, distance = depth.camera.project(trusted)
        row, column, inside = pixels_at(depth.camera, uv[distance > 0])
        depth.covered[row[inside], column[inside]] = True
        depth.covered = cv2.dilate(depth.covered.astype(np.uint8), disc) > 0
    return maps


def _agrees(cloud: NDArray, other: DepthMap, tolerance: float) -> NDArray[np.bool_]:
    """bool [N]: whether points lie on the surface that another view's sweep sees in their direction."""
    uv, distance = other.camera.project(cloud)
    row, column, inside = pixels_at(other.camera, np.where(distance[:, None] > 0, uv, -1.0))
    expected = 1 / np.where(distance > 0, distance, np.inf)
    return np.asarray(inside & (np.abs(other.inverse[row, column] - expected) < tolerance))


def _prior(points: NDArray, camera: Camera) -> NDArray[np.float32] | None:
    """Inverse depth [H, W] from the sparse points, or None; smooth between them, so every few pixels suffice."""
    # cv2.resize takes values to lie at the middles of equal cells.
    shape = [max(2, n // _PRIOR_STRIDE) for n in (camera.width, camera.height)]
    u, v = ((np.arange(n) + 0.5) * size / n for n, size in zip(shape, (camera.width, camera.height)))
    grid = np.stack(np.meshgrid(u, v), axis=-1)
    inverse = interpolated(points, camera, grid.reshape(-1, 2))
    if inverse is None:
        return None
    size = (camera.width, camera.height)
    return cv2.resize(inverse.reshape(grid.shape[:2]).astype(np.float32), size, interpolation=cv2.INTER_LINEAR)


def _inverse_range(priors: list[NDArray[np.float32] | None], cameras: list[Camera]) -> tuple[float, float]:
    """Smallest and largest inverse depth worth looking at."""
    usable = [prior for prior in priors if prior is not None]
    if not usable:
        distance = float(np.median([_distance_looked_at(camera, cameras) for camera in cameras]))
        return _FAR / distance, _NEAR / distance
    values = np.concatenate([prior.ravel() for prior in usable])
    low, high = np.percentile(values, [1, 99])
    return float(low) * (1 - _RANGE_MARGIN), float(high) * (1 + _RANGE_MARGIN)


def interpolated(points: NDArray, camera: Camera, uv: NDArray) -> NDArray | None:
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


def common_target(cameras: list[Camera]) -> NDArray[np.float64]:
    """The point [3] nearest to the rays through all image centres, in the sense of least squares."""
    return nearest_to_rays(cameras, np.array([[camera.width / 2, camera.height / 2] for camera in cameras]))


def nearest_to_rays(cameras: Sequence[Camera], uv: NDArray) -> NDArray[np.float64]:
    """The point [3] nearest to the rays through pixel positions [V, 2], one of each camera, in the sense of least
    squares."""
    centers = np.stack([camera.center for camera in cameras])
    homogeneous = np.concatenate([uv, np.ones((len(uv), 1))], axis=1)
    rays = np.stack([camera.w2c[:3, :3].T @ np.linalg.solve(camera.K, at) for camera, at in zip(cameras, homogeneous)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    # The small term settles rays that are parallel: one unit before the cameras.
    settled = 1e-6 * (centers + rays).mean(axis=0)
    total = (across @ centers[..., None]).sum(axis=0)[:, 0]
    return np.asarray(np.linalg.solve(across.sum(axis=0) + 1e-6 * np.eye(3), total + settled))


def _distance_looked_at(camera: Camera, cameras: list[Camera]) -> float:
    """Depth in `camera` of the point that all cameras look at; 1 where there is no such point."""
    distance = abs(float(camera.w2c[2, :3] @ common_target(cameras) + camera.w2c[2, 3]))
    return distance if distance > 1e-6 else 1.0


def guessed(camera: Camera, cameras: list[Camera], n: int, rng: np.random.Generator) -> NDArray:
    """Inverse depths without any points: two thirds around the point looked at, one third up to ten times as far."""
    inverse = rng.uniform(_MIDDLE, _NEAR, n)
    far = rng.random(n) < 1 / 3
    inverse[far] = rng.uniform(_FAR, _MIDDLE, int(far.sum()))
    return inverse / _distance_looked_at(camera, cameras)

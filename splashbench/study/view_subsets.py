"""Fewer training views: nested subsets that keep every test view between two of them (paper, supplement, Table S6).

The paper does not name its subsets. Here training cameras are dropped one by one. Each time it is the camera whose
absence least widens the gaps that the test views lie in.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.scene import Scene


def nested_views(scene: Scene, count: int) -> tuple[str, ...]:
    """`count` training cameras of `scene`, in the scene's order; fewer are always a subset of more.

    Raises SplashbenchError where the scene has too few, or no such subset brackets every test view.
    """
    if count > len(scene.train):
        raise SplashbenchError(f"{scene.directory} has {len(scene.train)} training views, not {count}; ask for fewer")
    angle = azimuths(scene)
    views = list(scene.train)
    while len(views) > count:
        without = {name: [other for other in views if other != name] for name in views}
        widths = {name: _gaps(angle, rest, scene.test) for name, rest in without.items()}
        # Ties: the last camera in the scene's order is dropped. That order decides nothing else.
        dropped = min(reversed(views), key=lambda name: widths[name])
        if not np.isfinite(widths[dropped]):
            raise SplashbenchError(
                f"{scene.directory}: no {len(views) - 1} training views have every test view between them; "
                "name the views to keep"
            )
        views = without[dropped]
    return tuple(views)


def _gaps(angle: dict[str, float], train: list[str], test: tuple[str, ...]) -> float:
    """Sum over the test views of the angle between the training views on either side, infinite where one is missing."""
    total = 0.0
    for name in test:
        below = [angle[other] for other in train if angle[other] <= angle[name]]
        above = [angle[other] for other in train if angle[other] >= angle[name]]
        total += min(above) - max(below) if below and above else np.inf
    return round(total, 9)


def azimuths(scene: Scene) -> dict[str, float]:
    """Place of every camera on the arc: radians around the vertical through what the cameras look at."""
    cameras = list(scene.cameras.values())
    axes = np.stack([camera.w2c[2, :3] for camera in cameras])
    centres = np.stack([camera.center for camera in cameras])
    up = -scene.gravity if scene.gravity is not None else -np.mean([camera.w2c[1, :3] for camera in cameras], axis=0)
    outward = centres - _nearest_point(centres, axes)
    outward -= np.outer(outward @ up, up) / (up @ up)
    # Angles from the middle of the arc: none of an arc below a full circle falls on the jump at 180 degrees.
    middle = outward.sum(axis=0)
    across = np.cross(up, middle)
    places = np.arctan2(outward @ across / np.linalg.norm(across), outward @ middle / np.linalg.norm(middle))
    return {camera.name: float(place) for camera, place in zip(cameras, places)}


def _nearest_point(centres: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """The point [3] nearest to all optical axes, in least squares."""
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    point: NDArray[np.float64] = np.linalg.lstsq(
        projectors.sum(axis=0), np.einsum("nij,nj->i", projectors, centres), rcond=None
    )[0]
    return point

"""What an eye sees behind all of the liquid, wherever that is: for Gaussians that are handed out with their colours.

Of transparent liquid these colours are in part the background's, and who draws them has no image of it by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splashbench.scene.camera import Camera, look_at

# Pixels along a side, and the widest angle (radians) to either side of the middle that is seen.
_PIXELS, _WIDEST = 400, 1.2


@dataclass(frozen=True)
class Panorama:
    """camera: of the square `image`, uint8 [n, n, 3]."""

    camera: Camera
    image: NDArray[np.uint8]

    def at(self, places: ArrayLike) -> NDArray[np.float32]:
        """The colours [N, 3] in [0, 1] behind `places` [N, 3], scene units; beyond its rim those of the rim."""
        pixels, depths = self.camera.project(places)
        pixels[~(depths > 0)] = 0
        columns, rows = np.clip(pixels, 0, _PIXELS - 1).astype(np.int64).T
        return np.asarray(self.image[rows, columns] * np.float32(1 / 255))


def panorama(render: Callable[[Camera], ArrayLike], eye: ArrayLike, corners: NDArray[np.float64]) -> Panorama:
    """What `eye` [3] sees of the background that `render` draws, around a box with these `corners` [n, 3]."""
    camera = camera_towards(np.asarray(eye, dtype=np.float64), corners)
    image = np.asarray(render(camera), dtype=np.float32)
    return Panorama(camera, np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8))


def camera_towards(eye: NDArray[np.float64], corners: NDArray[np.float64]) -> Camera:
    """A square view from `eye` [3] that has all `corners` [n, 3] in it, as far as a pinhole sees."""
    forward = corners.mean(axis=0) - eye
    if not forward.any():
        forward = np.array([0.0, 0.0, 1.0])
    pose = look_at(eye, eye + forward, np.eye(3)[np.argmin(np.abs(forward))])
    local = corners @ pose[:3, :3].T + pose[:3, 3]
    angles = np.arctan2(np.abs(local[:, :2]).max(axis=1), local[:, 2])
    focal = 0.5 * _PIXELS / np.tan(min(float(angles.max()) + 0.01, _WIDEST))
    half = 0.5 * _PIXELS
    return Camera("around", _PIXELS, _PIXELS, np.array([[focal, 0, half], [0, focal, half], [0, 0, 1]]), pose)

"""Poses between OpenCV's cameras, as scenes have them, and viser's: positions, quaternions, fields of view."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from splashbench.scene import Camera

# Radians within which a camera's up is the scene's: orbiting from there stays level.
_LEVEL = 0.01
# How far from the liquid an overview is: of its size, and of the cameras' distance at the least and at the most, as
# photographs hang from the cameras.
_FAR, _NEAREST, _FARTHEST = 2.6, 0.6, 0.8
# By which two views may differ and be one, as a share of the way to what is looked at, and in radians.
_SAME = 1e-4


def quaternion(rotation: ArrayLike) -> NDArray[np.float64]:
    """w, x, y, z of `rotation` [3, 3]."""
    return np.asarray(Rotation.from_matrix(np.asarray(rotation)).as_quat()[[3, 0, 1, 2]])


def turned_to(up: ArrayLike) -> NDArray[np.float64]:
    """A rotation [3, 3] that turns the z axis to `up` [3]."""
    z = np.asarray(up, dtype=np.float64) / np.linalg.norm(np.asarray(up, dtype=np.float64))
    x = np.cross(z, np.eye(3)[int(np.abs(z).argmin())])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def vertical_fov(camera: Camera) -> float:
    """The field of view from the image's top to its bottom, radians."""
    return 2 * math.atan(camera.height / (2 * camera.K[1, 1]))


@dataclass(frozen=True)
class View:
    """Where a client looks from: position, look_at, up [3] in scene units; fov, vertical, radians."""

    position: NDArray[np.float64]
    look_at: NDArray[np.float64]
    up: NDArray[np.float64]
    fov: float

    def near(self, other: View) -> bool:
        """Whether the two show the same, as far as 32-bit floats and a screen go."""
        reach = float(np.linalg.norm(self.look_at - self.position)) or 1.0
        places = np.concatenate([self.position - other.position, self.look_at - other.look_at])
        ups = self.up / np.linalg.norm(self.up) - other.up / np.linalg.norm(other.up)
        largest = max(np.abs(places).max() / reach, np.abs(ups).max(), abs(self.fov - other.fov))
        return bool(largest < _SAME)

    def rotation(self) -> NDArray[np.float64]:
        """World from camera [3, 3], OpenCV axes."""
        forward = self.look_at - self.position
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, self.up)
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward], axis=1)

    def camera(self, name: str, width: int, height: int) -> Camera:
        """The camera that sees it in an image of `width` times `height` pixels."""
        focal = height / (2 * math.tan(self.fov / 2))
        w2c = np.eye(4)
        w2c[:3, :3] = self.rotation().T
        w2c[:3, 3] = -w2c[:3, :3] @ self.position
        return Camera(name, width, height, np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), w2c)


def view_of(camera: Camera, middle: ArrayLike, up: ArrayLike, aspect: float) -> View:
    """The view through `camera`, whose whole image is to be seen on a screen of `aspect` (width over height).

    Args:
        middle: [3], what it looks at: the view turns about a point at its depth.
        up: [3], of the scene.

    A principal point off the centre cannot be shown, and is taken to be there.
    """
    forward, own_up = camera.w2c[2, :3], -camera.w2c[1, :3]
    depth = float((np.asarray(middle) - camera.center) @ forward)
    depth = depth if depth > 0 else float(np.linalg.norm(np.asarray(middle) - camera.center)) or 1.0
    # The scene's up shows the same picture where it lies in the plane of the camera's up and its line of sight.
    scene_up = np.asarray(up, dtype=np.float64)
    level = abs(float(scene_up @ camera.w2c[0, :3])) < _LEVEL and float(scene_up @ own_up) > 0.05
    tall = math.tan(vertical_fov(camera) / 2)
    wide = camera.width / (2 * camera.K[0, 0])
    return View(
        camera.center,
        camera.center + forward * depth,
        scene_up if level else own_up,
        2 * math.atan(max(tall, wide / aspect)),
    )


def overview(cameras: Sequence[Camera], middle: ArrayLike, size: float, up: ArrayLike) -> View:
    """A view of the liquid, `size` large and around `middle` [3], from behind the camera that looks the most alike."""
    center, vertical = np.asarray(middle, dtype=np.float64), np.asarray(up, dtype=np.float64)
    offsets = np.array([camera.center - center for camera in cameras])
    mean = offsets.mean(axis=0)
    chosen = offsets[int((offsets @ mean).argmax())]
    level = chosen - (chosen @ vertical) * vertical
    if np.linalg.norm(level) < 1e-3 * np.linalg.norm(chosen) or not np.linalg.norm(chosen) > 0:
        level = turned_to(vertical)[:, 0]
    away = float(np.median(np.linalg.norm(offsets, axis=1)))
    distance = float(np.clip(_FAR * size, _NEAREST * away, _FARTHEST * away)) if away > 0 else _FAR * size
    # A little aside and above.
    side = np.cross(vertical, level)
    direction = level / np.linalg.norm(level) + 0.35 * side / np.linalg.norm(side) + 0.6 * vertical
    position = center + distance * direction / np.linalg.norm(direction)
    return View(position, center, vertical, math.radians(45))


def client_view(client: Any) -> View:
    """Where a client of viser's looks from."""
    camera = client.camera
    return View(
        np.array(camera.position, dtype=np.float64),
        np.array(camera.look_at, dtype=np.float64),
        np.array(camera.up_direction, dtype=np.float64),
        float(camera.fov),
    )


def client_picture(client: Any) -> NDArray[np.uint8]:
    """What a client of viser's sees, uint8 [H, W, 4], as large as its window: others it would stretch.

    It sorts Gaussians for a picture only where that is from another place than the window. So it is, by a hair: else
    the order is that of an earlier view where the window's own sorting takes its time.
    """
    view = client_view(client)
    hair = np.linalg.norm(view.look_at - view.position) * np.random.default_rng().uniform(1e-6, 3e-6, 3)
    return np.asarray(
        client.get_render(
            int(client.camera.image_height),
            int(client.camera.image_width),
            wxyz=quaternion(view.rotation()),
            position=view.position + hair,
            fov=view.fov,
            transport_format="png",
            timeout=120.0,
        )
    )


def set_client_view(client: Any, view: View) -> None:
    """Let a client of viser's look from there."""
    camera = client.camera
    with client.atomic():
        # The place first: setting it moves what is looked at along.
        camera.position = view.position
        camera.look_at = view.look_at
        camera.up_direction = view.up
        camera.fov = view.fov

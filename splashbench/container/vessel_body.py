"""An upright body of rings of one outline along an axis, the shape of bowls, jugs and tanks; and a vessel of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from splashbench.arrays import Floats
from splashbench.observe.container import depth_image
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh


@dataclass(frozen=True, eq=False)
class VesselBody:
    """Rings of one outline along an axis, scene units.

    middle: [3] the axis's point of height 0. frame: [3, 3], two unit vectors across the axis, and the axis. outline:
    [angles, 2] points of the ring of radius 1. heights, radii: [K] of the rings.
    """

    middle: Floats
    frame: Floats
    outline: Floats
    heights: Floats
    radii: Floats

    def rings(self, radii: Floats) -> Floats:
        """Points [K, angles, 3] of rings of `radii` [K] at the heights."""
        middles = self.middle + self.heights[:, None] * self.frame[2]
        points: Floats = middles[:, None] + radii[:, None, None] * (self.outline @ self.frame[:2])
        return points

    def part(self, first: int, last: int) -> VesselBody:
        """Without the rings below number `first` and from `last` on."""
        return VesselBody(self.middle, self.frame, self.outline, self.heights[first:last], self.radii[first:last])

    def mesh(self) -> ContainerMesh:
        """The surface, with a floor and without a lid."""
        points = self.rings(self.radii)
        count, angles = points.shape[:2]
        floor = self.middle + self.heights[0] * self.frame[2]
        here = np.arange(count * angles).reshape(count, angles)
        beside = np.roll(here, -1, axis=1)
        faces = [
            np.stack([here[:-1], beside[:-1], beside[1:]], axis=-1).reshape(-1, 3),
            np.stack([here[:-1], beside[1:], here[1:]], axis=-1).reshape(-1, 3),
            np.stack([np.full(angles, count * angles), beside[0], here[0]], axis=-1),
        ]
        return ContainerMesh(np.vstack([points.reshape(-1, 3), floor]), np.concatenate(faces))


@dataclass(frozen=True, eq=False)
class Vessel:
    """The outside of a vessel, scene units. body: the surface, open at the rim."""

    body: VesselBody

    @cached_property
    def mesh(self) -> ContainerMesh:
        """The surface, open at the rim."""
        return self.body.mesh()

    @property
    def up(self) -> Floats:
        """Unit vector [3] along the axis, from the foot to the rim."""
        return self.body.frame[2]

    @property
    def rim(self) -> Floats:
        """The ring [N, 3] at which the surface ends."""
        return self.body.rings(self.body.radii)[-1]

    def masks(self, cameras: Sequence[Camera]) -> dict[str, NDArray[np.bool_]]:
        """Its silhouettes, bool [H, W] by camera name."""
        return {camera.name: np.isfinite(depth_image(self.mesh, camera)) for camera in cameras}


def frame_about(up: Floats) -> Floats:
    """Three unit vectors [3, 3], the last along `up` [3]."""
    up = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    first = np.eye(3)[int(np.argmin(np.abs(up)))]
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up])


def superellipse(aspect: float, exponent: float, turn: float, points: int) -> Floats:
    """Points [N, 2] of the outline |x / a|^p + |y a|^p = 1, a = exp(aspect), turned; corners are among them."""
    angles = np.arange(points) * (2 * np.pi / points)
    x, y = np.cos(angles), np.sin(angles)
    length = (np.abs(x) ** exponent + np.abs(y) ** exponent) ** (-1 / exponent)
    x, y = x * length * np.exp(aspect), y * length * np.exp(-aspect)
    return np.stack([np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y], axis=1)

"""The near wall of an open container, which cuts the liquid's picture pixel by pixel. Not in the paper.

A camera that looks over a rim sees the pool end there, and the rim's edge runs through pixels. Liquid behind the wall
is drawn whole and then cut by the share of each pixel that the wall takes up: a Gaussian is wider than a pixel, and to
leave out carriers one by one would fray the edge. The near wall are the faces on the camera's side of the container
that have no room for liquid in front of them: its outside, and the top of its rim.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from splashbench.observe.container import depth_image, hidden_share
from splashbench.observe.kernels import sample
from splashbench.observe.occlusion import focal_length
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh

from .vessel import Vessel

# How far from a face, in voxels of the vessel, it is looked for room: beyond a wall that its grid makes thicker.
_BESIDE = 1.5
_ROOM = 0.25
# Pixels of an image are divided into so many along each side, or two where it has more than these pixels.
_PARTS, _MANY_PIXELS = 4, 500_000
# Gaussians reach so many tolerances (hull voxels) beyond their carriers.
_REACH = 4.0


@dataclass(frozen=True, eq=False)
class NearWall:
    """The near wall in one camera's image [H, W].

    share: float32 in [0, 1], how much of each pixel it takes up. depth: float32 of the pixels' middles, scene units,
    inf where it is not. rest: the depth of the container's other faces. reach: pixels that Gaussians may extend beyond
    their carriers.
    """

    camera: Camera
    share: np.ndarray
    depth: np.ndarray
    rest: np.ndarray
    reach: int

    def hidden(self, points: np.ndarray, tolerance: float) -> np.ndarray:
        """float32 [n] in [0, 1]: how far `points` [n, 3] (scene units) are hidden; those near the wall's edge are not,
        as the wall will cut them. tolerance: see `LiquidOcclusion`."""
        by_rest = hidden_share(points, self.rest, self.camera, tolerance)
        wholly = hidden_share(points, self._deepest, self.camera, tolerance)
        return np.maximum(by_rest, (wholly > 0.999).astype(np.float32))

    def in_front(self, points: np.ndarray, tolerance: float) -> np.ndarray:
        """bool [n]: `points` [n, 3] in front of the wall, as liquid that runs down its outside. Those beside the wall
        in the image are not: what is nearer than a part of the wall may still be within. tolerance: see
        `LiquidOcclusion`."""
        pixels, depth = self.camera.project(points)
        column, row = np.floor(np.nan_to_num(pixels)).astype(np.int64).T
        within = (depth > 0) & (column >= 0) & (column < self.camera.width) & (row >= 0) & (row < self.camera.height)
        found = np.zeros(len(points), dtype=bool)
        limit = self.depth[row[within], column[within]]
        found[within] = np.isfinite(limit) & (depth[within] < limit + tolerance)
        return found

    @cached_property
    def _deepest(self) -> np.ndarray:
        """float32 [H, W]: the wall's largest depth within reach of each pixel, inf where it ends there."""
        return cv2.dilate(self.depth, np.ones((2 * self.reach + 1, 2 * self.reach + 1), np.uint8))


def room_beside(mesh: ContainerMesh, vessel: Vessel) -> np.ndarray:
    """bool [F, 2]: whether there is room for liquid at the front and at the back of each face of `mesh`; the front is
    where its corners are seen in counter-clockwise order."""
    corners = mesh.triangles
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    away = _BESIDE * vessel.grid.voxel * normals
    middles = corners.mean(axis=1)
    top = np.array(vessel.grid.shape) - 1
    sides = []
    for points in (middles + away, middles - away):
        nodes = vessel.grid.to_voxels(points @ vessel.turn.T)
        beyond = (nodes < 0).any(axis=1) | (nodes > top).any(axis=1)
        sides.append((sample(vessel.inside, nodes) > _ROOM) & ~beyond)
    return np.stack(sides, axis=1)


def near_wall(
    mesh: ContainerMesh, room: np.ndarray, up: np.ndarray, camera: Camera, tolerance: float
) -> NearWall | None:
    """The near wall of `mesh` for `camera`; None where it shows none. room: of `room_beside`. up: unit vector [3].
    tolerance: see `LiquidOcclusion`."""
    corners = mesh.triangles
    middles = corners.mean(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    towards = camera.center - middles
    faces_camera = (normals * towards).sum(axis=1) > 0
    room_in_front = np.where(faces_camera, room[:, 0], room[:, 1])
    centre = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    away = centre - camera.center
    away = away - (away @ up) * up
    outside = ~room_in_front & ((middles - centre) @ away < 0)
    if not outside.any() or outside.all():
        return None
    outer, inner = (ContainerMesh(mesh.vertices, mesh.faces[chosen]) for chosen in (outside, ~outside))
    depth, rest = depth_image(outer, camera), depth_image(inner, camera)
    # The outside of the far wall is seen from behind, through the inside: not at all.
    parts = _PARTS if camera.width * camera.height <= _MANY_PIXELS else 2
    fine = camera.scaled(parts)
    covered = depth_image(outer, fine) < depth_image(inner, fine)
    share = covered.reshape(camera.height, parts, camera.width, parts).mean(axis=(1, 3), dtype=np.float32)
    depth = np.where(depth < rest, depth, np.float32(np.inf))
    distances = depth[np.isfinite(depth)]
    if not len(distances):
        return None
    pixel = float(np.median(distances)) / focal_length(camera)
    return NearWall(camera, share, depth, rest, max(2, int(np.ceil(_REACH * tolerance / pixel))))

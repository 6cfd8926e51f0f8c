"""The container as a vessel: where it can hold liquid, and how deep each pixel looks into it. Not in the paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
from scipy.ndimage import binary_fill_holes

from splashbench.observe.container import solid_distance
from splashbench.observe.grid import Bounds, Grid
from splashbench.observe.kernels import sample, trilinear
from splashbench.parallel import over_range
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh

VESSEL_CELLS = 96
# Nodes of a slice that walls must enclose for it to hold anything.
_SMALLEST_ROOM = 4
# Share of the corners of a node's cell, weighted by nearness, that walls must enclose.
_ENCLOSED = 0.25
# What stands for the distance, in the vessel's voxels, where it can hold nothing.
_ELSEWHERE = 20.0


def upright(gravity: np.ndarray) -> np.ndarray:
    """Rotation [3, 3] from scene axes to axes whose third points up, against `gravity` (unit vector)."""
    up = -np.asarray(gravity, dtype=np.float64)
    side = np.eye(3)[int(np.argmin(np.abs(up)))]
    first = np.cross(side, up)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up])


@dataclass(frozen=True)
class Vessel:
    """Where a container can hold liquid.

    turn: [3, 3] scene axes to upright ones. grid: over the container, upright axes, scene units. solid: float32, signed
    distance to the walls in voxels, negative in them. inside: float32 of 0 and 1, free space that walls enclose
    sideways. rim: greatest height of it, scene units.
    """

    turn: np.ndarray
    grid: Grid
    solid: np.ndarray
    inside: np.ndarray
    rim: float

    @classmethod
    def of(cls, mesh: ContainerMesh, gravity: np.ndarray, cells: int = VESSEL_CELLS) -> Vessel | None:
        """The vessel that `mesh` is, or None where it encloses nothing (a plate, a mesh with holes)."""
        turn = upright(gravity)
        vertices = mesh.vertices @ turn.T
        bounds = Bounds(vertices.min(axis=0), vertices.max(axis=0)).padded(0.08)
        grid = Grid.over(bounds, cells)
        solid = solid_distance(ContainerMesh(vertices, mesh.faces), grid)
        wall = solid < 0.5  # half a voxel thicker, so that a thin wall has no holes between the nodes
        inside = np.zeros(grid.shape, dtype=np.float32)
        for k in range(grid.shape[2]):
            filled = binary_fill_holes(wall[:, :, k])
            if (filled & ~wall[:, :, k]).sum() >= _SMALLEST_ROOM:
                inside[:, :, k] = filled & (solid[:, :, k] > 0)
        levels = np.nonzero(inside.any(axis=(0, 1)))[0]
        if len(levels) == 0:
            return None
        return cls(turn, grid, solid, inside, float(grid.origin[2] + grid.voxel * levels[-1]))

    def height(self, points: np.ndarray) -> np.ndarray:
        """Height of `points` [..., 3] (scene units), scene units above the scene's origin."""
        return np.asarray(points) @ self.turn[2]

    def room(self, grid: Grid) -> np.ndarray:
        """Signed distance of the nodes of `grid` to the wall from within: float32 of its shape, its voxels, negative
        where the vessel can hold liquid, large elsewhere."""
        room = np.empty(grid.shape, dtype=np.float32)
        # Of the nodes' numbers, coordinates in the vessel's grid.
        origin = (self.turn @ grid.origin - self.grid.origin) / self.grid.voxel
        turn = self.turn * (grid.voxel / self.grid.voxel)
        scale = self.grid.voxel / grid.voxel
        over_range(_room, grid.shape[0], self.solid, self.inside, origin, np.ascontiguousarray(turn), scale, room)
        return room

    def foot(self, axis: Callable[[np.ndarray], np.ndarray]) -> float:
        """Height at which what comes down along `axis`, from heights [N] to upright places [N, 2], meets the wall from
        within; the rim where it does not come in."""
        heights = self.rim - 0.5 * self.grid.voxel * np.arange(2 * self.grid.shape[2])
        points = np.concatenate([axis(heights), heights[:, None]], axis=1)
        within = sample(self.inside, self.grid.to_voxels(points)) > _ENCLOSED
        return float(heights[int(np.argmin(within))]) if within.any() and within[0] else self.rim

    def walled(self, points: np.ndarray) -> np.ndarray:
        """bool [N]: whether `points` [N, 3] (scene units) lie in the container's walls."""
        return sample(self.solid, self.grid.to_voxels(points @ self.turn.T)) < 0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _room(
    solid: np.ndarray,
    inside: np.ndarray,
    origin: np.ndarray,
    turn: np.ndarray,
    scale: float,
    room: np.ndarray,
    start: int,
    stop: int,
) -> None:
    top_x, top_y, top_z = solid.shape[0] - 1.0, solid.shape[1] - 1.0, solid.shape[2] - 1.0
    elsewhere = np.float32(_ELSEWHERE * scale)
    for i in range(start, stop):
        for j in range(room.shape[1]):
            for k in range(room.shape[2]):
                x = origin[0] + turn[0, 0] * i + turn[0, 1] * j + turn[0, 2] * k
                y = origin[1] + turn[1, 0] * i + turn[1, 1] * j + turn[1, 2] * k
                z = origin[2] + turn[2, 0] * i + turn[2, 1] * j + turn[2, 2] * k
                room[i, j, k] = elsewhere
                if x < 0 or y < 0 or z < 0 or x > top_x or y > top_y or z > top_z:
                    continue
                distance = -trilinear(solid, x, y, z)
                if distance > 0 or trilinear(inside, x, y, z) > _ENCLOSED:
                    room[i, j, k] = distance * scale


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _lowest(
    solid: np.ndarray,
    inside: np.ndarray,
    ray: np.ndarray,
    eye: np.ndarray,
    corner: np.ndarray,
    stride: int,
    opaque: bool,
    heights: np.ndarray,
    start: int,
    stop: int,
) -> None:
    nx, ny, nz = solid.shape
    top = np.array([nx - 1.0, ny - 1.0, nz - 1.0])
    for row in range(start, stop):
        v = corner[1] + row * stride + 0.5
        for column in range(heights.shape[1]):
            u = corner[0] + column * stride + 0.5
            direction = ray[:, 0] * u + ray[:, 1] * v + ray[:, 2]
            direction /= np.sqrt((direction**2).sum())
            near, far = 0.0, 1e9
            for axis in range(3):
                if abs(direction[axis]) > 1e-12:
                    a = -eye[axis] / direction[axis]
                    b = (top[axis] - eye[axis]) / direction[axis]
                    near, far = max(near, min(a, b)), min(far, max(a, b))
                elif eye[axis] < 0 or eye[axis] > top[axis]:
                    far = -1.0
            lowest = np.inf
            s = near
            while s <= far:
                x = eye[0] + s * direction[0]
                y = eye[1] + s * direction[1]
                z = eye[2] + s * direction[2]
                if opaque and trilinear(solid, x, y, z) < 0:
                    break
                if inside[int(x + 0.5), int(y + 0.5), int(z + 0.5)] > 0:
                    lowest = min(lowest, z)
                s += 0.5
            heights[row, column] = lowest


def lowest_heights(
    vessel: Vessel, camera: Camera, corner: np.ndarray, shape: tuple[int, int], stride: int, opaque: bool
) -> np.ndarray:
    """How deep each pixel looks into the vessel: float32 `shape`, scene units of height, inf where it does not.

    Pixels are `stride` apart from `corner` (x, y). A pool covers a pixel when its level is above that height.
    """
    grid = vessel.grid
    ray = vessel.turn @ camera.w2c[:3, :3].T @ np.linalg.inv(camera.K)
    eye = (vessel.turn @ camera.center - grid.origin) / grid.voxel
    heights = np.empty(shape, dtype=np.float32)
    over_range(
        _lowest, shape[0], vessel.solid, vessel.inside, ray, eye, corner.astype(np.float64), stride, opaque, heights
    )
    return (heights * np.float32(grid.voxel) + np.float32(grid.origin[2])).astype(np.float32)

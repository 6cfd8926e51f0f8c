"""Geometry of the container's mesh: its depth image in a camera, the points it hides, the distance to its walls.

Pure geometry of the scene's mesh (`Scene.container_mesh`). What follows for carving is in occlusion.py.
"""

from __future__ import annotations

import numpy as np

from splashbench.observe import mesh_kernels
from splashbench.observe.grid import Grid
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh

# The nearest depth that is drawn, as a share of the largest depth of the mesh.
_NEAR = 1e-4
# Voxels within which distances to the mesh are exact.
_EXACT = 4.0
_LIMIT_VOXELS = 20.0


def depth_image(mesh: ContainerMesh, camera: Camera) -> np.ndarray:
    """Depth (camera z, scene units) of the nearest surface at each pixel's centre: float32 [H, W], inf where none.

    Both sides of a face count. What lies behind the camera, or nearer to it than 1e-4 of the mesh's largest depth, is
    cut off.
    """
    local = mesh.vertices @ camera.w2c[:3, :3].T + camera.w2c[:3, 3]
    near = nearest_drawn(local[:, 2])
    if near <= 0:
        return np.full((camera.height, camera.width), np.inf, dtype=np.float32)
    clipped = _in_front(local[mesh.faces], near)
    homogeneous = clipped @ camera.K.T
    inverse = 1.0 / clipped[..., 2:]
    return mesh_kernels.raster(
        np.concatenate([homogeneous[..., :2] * inverse, inverse], axis=-1), camera.height, camera.width
    )


def nearest_drawn(depths: np.ndarray) -> float:
    """The least depth at which `depth_image` draws a mesh whose vertices have these; none is drawn where it is not
    positive."""
    return _NEAR * float(depths.max())


def _in_front(triangles: np.ndarray, near: float) -> np.ndarray:
    """The parts of `triangles` [F, 3, 3] (camera coordinates) with z >= `near`, as triangles."""
    front = triangles[..., 2] >= near
    count = front.sum(axis=1)
    parts = [triangles[count == 3]]
    for corners in (1, 2):
        chosen, sides = triangles[count == corners], front[count == corners]
        # Turn each so that the corner that differs from the two others comes first.
        odd = np.argmax(sides == (corners == 1), axis=1)
        rows = np.arange(len(chosen))
        a, b, c = (chosen[rows, (odd + turn) % 3] for turn in range(3))
        ab, ac = _cut(a, b, near), _cut(a, c, near)
        if corners == 1:
            parts.append(np.stack([a, ab, ac], axis=1))
        else:
            parts += [np.stack([ab, b, c], axis=1), np.stack([ab, c, ac], axis=1)]
    return np.concatenate(parts)


def _cut(a: np.ndarray, b: np.ndarray, near: float) -> np.ndarray:
    """Where the sides a-b [N, 3] meet the plane z = `near`."""
    share = (near - a[:, 2:]) / (b[:, 2:] - a[:, 2:])
    points = a + share * (b - a)
    points[:, 2] = near
    return points


def solid_distance(mesh: ContainerMesh, grid: Grid) -> np.ndarray:
    """Signed distance to the mesh on the nodes of `grid`: float32 [nx, ny, nz], voxels, clipped to +-20.

    Negative inside the container's walls, positive in the free space about them, that inside the bowl included. Exact
    up to 4 voxels from the surface, and to a few tenths beyond. A mesh that is not closed has no inside: its distance
    is positive everywhere.
    """
    triangles = (mesh.triangles - grid.origin) / grid.voxel
    distance = mesh_kernels.unsigned_distance(triangles, grid.shape, _EXACT, _LIMIT_VOXELS)
    if not mesh.is_closed:
        return distance
    walls = mesh_kernels.inside(triangles, grid.shape, mesh.is_oriented)
    return np.where(walls, -distance, distance)


def hidden(points: np.ndarray, depth: np.ndarray, camera: Camera, tolerance: float) -> np.ndarray:
    """bool [n]: whether the container hides `points` [n, 3] (scene units) from `camera`.

    depth: of the container seen by `camera` (`depth_image`). A point is hidden where it lies more than `tolerance`
    (scene units) behind the depth at its pixel; points beside the image or behind the camera are not.
    """
    return mesh_kernels.behind(points, camera.projection, depth, tolerance)


def hidden_share(points: np.ndarray, depth: np.ndarray, camera: Camera, tolerance: float) -> np.ndarray:
    """As `hidden`, by how much: float32 [n] in [0, 1], the share of a pixel about each point in which it is hidden.

    A rim runs through pixels. What lies near its outline is half hidden there and does not vanish as a whole.
    """
    return mesh_kernels.share_behind(points, camera.projection, depth, tolerance)

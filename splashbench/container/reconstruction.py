"""The container's surface from the footage itself, where nobody has scanned it.

An opaque container hides liquid from the views behind its wall. Carving away what such a view does not show is the
largest single error of a hull. To know what is hidden takes no scan, only the depth of the wall. The plates' depths
(splashbench/background) are fused on a grid within the container masks, as a truncated signed distance (Curless and
Levoy 1996). For each view a node in front of the depth is free, one a little behind it is not, and the mean over views
decides. A node outside a mask is free. A node is dropped unless two views agree on its depth.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import marching_cubes

from splashbench.background.clean_plate import make_clean_plate
from splashbench.background.depth import SWEEP_SIDE, DepthMap, depth_maps, pixels_at
from splashbench.container.entry import in_pairs, masks_of, require_place, write_entry
from splashbench.container.verification import Projection, overlay, verify
from splashbench.errors import SplashbenchError
from splashbench.observe import Bounds, Grid
from splashbench.observe.container import depth_image
from splashbench.progress import track
from splashbench.scene import Camera, Scene
from splashbench.scene.container import ContainerMesh

# Cells along the longest side of the grid.
_CELLS = 128
# Distances in front of a view's depth count up to so many cells.
_FRONT = 1.5
# Down to so many cells behind its depth, a view counts for a wall. A wall thinner than that is thinned by the views of
# its other side. Less leaves holes where the views' depths disagree.
_BEHIND = 11.0
_SMOOTHING = 0.6
# What a depth that no other view confirms counts beside one that is confirmed.
_DOUBTED = 0.15
# The grid reaches beyond the confirmed points, of which so many on either end may be wrong.
_OUTLIERS = 0.02
_MARGIN = 0.4
_LEAST_POINTS = 100
# Pieces smaller than this share of the largest are errors of the depth.
_LEAST_PIECE = 0.02
# Less of the masks than this is a piece of the container, or an error.
_LEAST_COVER = 0.6
_REMEDY = (
    "check masks and poses; a container without texture, or one that is seen through, takes a scan (`splashbench scene"
    " place-container`)"
)
# Files are told apart by what they hold, so that scene.json, and with it the scene's digest, changes with the mesh.
_FILE = "container_from_footage_{}.ply"


@dataclass(frozen=True)
class Reconstruction:
    """A container from the footage.

    Attributes:
        mesh: in scene units, near its own origin, so that its file keeps the precision.
        pose: mesh to scene, [4, 4].
        projections: how it and the mask agree in each camera that has one, held-out ones too.
    """

    mesh: ContainerMesh
    pose: NDArray[np.float64]
    projections: dict[str, Projection]


def write_reconstruction(scene: Scene, reconstruction: Reconstruction, replace: bool = False) -> Path:
    """Write the mesh into the scene's folder and name it in scene.json; returns its path. Other fields stay.

    replace: whether a container may be there already; an earlier reconstruction's file goes.

    Raises SplashbenchError as `require_place` does.
    """
    require_place(scene, replace)
    mesh = trimesh.Trimesh(reconstruction.mesh.vertices, reconstruction.mesh.faces, process=False)
    content = mesh.export(file_type="ply")
    name = _FILE.format(hashlib.sha256(content).hexdigest()[:8])
    write_entry(
        scene, name, lambda path: path.write_bytes(content), reconstruction.pose, {"container_transparent": False}
    )
    for path in scene.directory.glob(_FILE.format("*")):
        if path.name != name:
            path.unlink()
    return scene.directory / name


@dataclass(frozen=True)
class _PlateView:
    """What one training view shows: its container mask, of `mask_camera`, and the depth of its plate.

    seen: bool [H, W], at the size of `depth`, what the plate shows.
    """

    mask_camera: Camera
    mask: NDArray[np.bool_]
    depth: DepthMap
    seen: NDArray[np.bool_]

    def within(self, points: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Whether points [N, 3] project into the mask, and whether beside it; neither beyond the image."""
        rows, columns, inside = _pixels(self.mask_camera, points)
        on_mask = self.mask[rows, columns]
        return inside & on_mask, inside & ~on_mask

    def distances(self, points: NDArray[np.float64]) -> tuple[NDArray, NDArray[np.bool_], NDArray[np.bool_]]:
        """How far points [N, 3] lie in front of what the view shows, scene units; whether it shows something there at
        all, and whether another view confirms that."""
        camera = self.depth.camera
        rows, columns, inside = _pixels(camera, points)
        away = points @ camera.w2c[2, :3] + camera.w2c[2, 3]
        shown = inside & self.seen[rows, columns]
        return 1.0 / self.depth.inverse[rows, columns] - away, shown, shown & self.depth.trusted[rows, columns]

    def confirmed(self) -> NDArray[np.float64]:
        """Points [N, 3] of the plate within the mask, as deep as another view confirms."""
        points = self.depth.lifted()[self.depth.trusted]
        return points[self.within(points)[0]]


def _pixels(camera: Camera, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray]:
    """Rows and columns (within the image) at which points [N, 3] are seen, and whether they are of the image."""
    uv, depth = camera.project(points)
    return pixels_at(camera, np.where(depth[:, None] > 0, uv, -1.0))


def container_from_footage(scene: Scene, masked: Scene | None = None) -> Reconstruction:
    """What the training views show of the container; test views take no part.

    masked: the scene before it was cropped, of the same cameras, which has the container masks; None for `scene`.

    Raises SplashbenchError where fewer than two training cameras have a mask, and where too few pixels within the masks
    have a depth that two views agree on: a container without texture, or one that is seen through.
    """
    masks, mask_cameras = masks_of(scene, masked)
    where = (masked or scene).directory / "container_mask"
    training = scene.training()
    # All views are swept: those without a mask confirm the others' depths.
    plates = [
        make_clean_plate(training, name, SWEEP_SIDE) for name in track(training.train, "collecting what stands still")
    ]
    maps = depth_maps(training.initial_points(), plates)
    views = [
        _PlateView(mask_cameras[name], masks[name], depth, plate.seen)
        for name, depth, plate in zip(training.train, maps, plates)
        if name in masks
    ]
    confirmed = np.concatenate([view.confirmed() for view in views])
    if len(confirmed) < _LEAST_POINTS:
        raise SplashbenchError(
            f"{scene.directory}: the views agree on the depth of {len(confirmed)} pixels within the masks of {where},"
            f" {_LEAST_POINTS} are needed; {_REMEDY}"
        )
    low, high = np.quantile(confirmed, [_OUTLIERS, 1 - _OUTLIERS], axis=0)
    grid = Grid.over(Bounds(low, high).padded(_MARGIN), _CELLS)
    mesh = _surface(grid, views)
    if mesh is None:
        raise SplashbenchError(f"{scene.directory}: the depths within the masks of {where} make no surface; {_REMEDY}")
    # As the file has it.
    mesh = ContainerMesh(mesh.vertices.astype(np.float32), mesh.faces)
    windows = {name: _in_window(mask, mask_cameras[name], scene.cameras[name]) for name, mask in masks.items()}
    pose = np.eye(4)
    pose[:3, 3] = grid.origin
    projections = verify(mesh, pose, [scene.cameras[name] for name in windows], windows)
    overlap = float(np.median([projections[name].iou for name in masks if name in scene.train]))
    if overlap < _LEAST_COVER:
        raise SplashbenchError(
            f"{scene.directory}: the surface found overlaps the masks of {where} by {overlap:.2f} (intersection over"
            f" union, median of the training views), {_LEAST_COVER} are needed; {_REMEDY}"
        )
    return Reconstruction(mesh, pose, projections)


def _in_window(mask: NDArray[np.bool_], of: Camera, camera: Camera) -> NDArray[np.bool_]:
    """`mask` [H, W] of a camera as `camera` sees it, the same one with another window."""
    at = _positions(camera) @ (of.K @ np.linalg.inv(camera.K))[:2].T
    rows, columns, inside = pixels_at(of, at)
    return np.asarray(inside & mask[rows, columns]).reshape(camera.height, camera.width)


def _positions(camera: Camera) -> NDArray[np.float64]:
    """The centres of all pixels, row by row, homogeneous [H W, 3]."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    return np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)


def _surface(grid: Grid, views: list[_PlateView]) -> ContainerMesh | None:
    """The surface relative to the grid's origin, scene units; None where there is none."""
    field = np.stack([_fused(points, grid.voxel, views) for points in _slabs(grid)])
    field = ndimage.gaussian_filter(field, _SMOOTHING, mode="nearest")
    pieces, count = ndimage.label(field < 0)
    if not count:
        return None
    sizes = np.bincount(pieces.ravel())[1:]
    small = np.flatnonzero(sizes < _LEAST_PIECE * sizes.max()) + 1
    field[np.isin(pieces, small)] = 1.0
    # Closed at the grid's faces.
    vertices, faces, _, _ = marching_cubes(np.pad(field, 1, constant_values=1.0), 0.0)
    return ContainerMesh((vertices - 1) * grid.voxel, faces[:, ::-1])


def _slabs(grid: Grid) -> Iterator[NDArray[np.float64]]:
    """The grid's nodes, [ny, nz, 3] at a time: all at once would take hundreds of megabytes."""
    nx, ny, nz = grid.shape
    plane = np.stack(np.meshgrid(0, np.arange(ny), np.arange(nz), indexing="ij"), axis=-1)[0]
    for i in track(range(nx), "fusing depths"):
        yield grid.to_scene(plane + np.array([i, 0, 0]))


def _fused(points: NDArray[np.float64], voxel: float, views: list[_PlateView]) -> NDArray[np.float64]:
    """The truncated signed distance at points [ny, nz, 3], in [-1, 1]: positive where it is free."""
    flat = points.reshape(-1, 3)
    total, weights = np.zeros(len(flat)), np.zeros(len(flat))
    known, free = np.zeros(len(flat), bool), np.zeros(len(flat), bool)
    for view in views:
        within, beside = view.within(flat)
        distance, shown, confirmed = view.distances(flat)
        counts = within & (distance > -_BEHIND * voxel)
        weight = np.where(confirmed, 1.0, _DOUBTED) * (counts & shown)
        total += weight * np.clip(distance / (_FRONT * voxel), -1, 1)
        weights += weight
        known |= counts & confirmed
        free |= beside
    known &= ~free
    return np.where(known, total / np.where(known, weights, 1), 1.0).reshape(points.shape[:2])


def picture(scene: Scene, reconstruction: Reconstruction, width: int = 480) -> NDArray[np.uint8]:
    """To judge by eye, a row per camera: the first image with the mesh's outline, the mesh lit from the camera.

    RGB uint8 [H, W, 3].
    """
    placed = reconstruction.mesh.placed(reconstruction.pose)
    pictures = []
    for name, camera in scene.cameras.items():
        small = camera.scaled(min(1.0, width / camera.width))
        pictures.append(
            overlay(reconstruction.mesh, reconstruction.pose, camera, image=scene.image(name, 0), width=small.width)
        )
        pictures.append(_lit(depth_image(placed, small), small))
    return in_pairs(pictures)


def _lit(depth: NDArray[np.float32], camera: Camera) -> NDArray[np.uint8]:
    """A surface of this depth [H, W], lit from the camera: grey where there is one, black elsewhere."""
    rays = (_positions(camera) @ np.linalg.inv(camera.K).T).reshape(*depth.shape, 3)
    points = rays * np.where(np.isfinite(depth), depth, np.nan)[..., None]
    normals = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    length = np.linalg.norm(normals, axis=-1) * np.linalg.norm(rays, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        light = np.nan_to_num(np.abs((normals * rays).sum(axis=-1)) / length)
    grey = np.clip(40 + 215 * light, 0, 255) * np.isfinite(depth)
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=-1)

"""Where the fit of a container's outlines begins.

The search puts the mesh upright at the place where the masks' centres meet, at many turns about the vertical axis. It
matches the silhouettes' centres (and areas, where the scale is unknown) and takes the turns whose silhouettes overlap
most with the masks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from splashbench.alignment import triangulate
from splashbench.arrays import Floats
from splashbench.container.mask_views import MaskView, centre_of, make_view
from splashbench.container.stance import Axis, Stance, angle_between, direction, rotation_about, upright
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh

# Longer side of a mask in pixels (at most) and margin about it (as a share of it) of the views that are searched.
_SEARCH = (64.0, 0.6)
_TURNS = 24
# Starts beyond the best of each axis.
_MORE_STARTS = 5
# Turns closer than this are neighbours, of which one is tried.
_NEIGHBOUR_RADIANS = 0.6
_SETTLING_STEPS = 4
# Of the cameras' mean up direction beside that which their level x axes leave.
_MEAN_UP_WEIGHT = 0.01


def find_starts(
    mesh: ContainerMesh,
    cameras: Sequence[Camera],
    masks: Mapping[str, NDArray[np.bool_]],
    axes: Sequence[Axis],
    upward: Floats,
    scale: float | None,
    initial: Stance | None,
) -> list[tuple[Axis, Stance]]:
    """Where fits begin: per axis the turn whose silhouettes overlap most with the masks, and the best of the rest.

    scale: scene units per unit of the mesh; None where it is free. initial: one more start, which comes first.
    """
    views = [make_view(camera, masks[camera.name], *_SEARCH) for camera in cameras]
    position, size = _place_of_masks(cameras, masks)
    start_scale = size / float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) if scale is None else scale
    candidates: list[tuple[float, Axis, Stance]] = []
    for axis in axes:
        standing = upright(axis, upward)
        for angle in np.arange(_TURNS) * 2 * np.pi / _TURNS:
            stance = Stance(start_scale, rotation_about(upward, angle) @ standing, position)
            settled, overlap = settle(mesh, views, stance, scale is None)
            candidates.append((overlap, axis, settled))
    candidates.sort(key=lambda candidate: -candidate[0])
    chosen = [next(candidate for candidate in candidates if candidate[1] == axis) for axis in axes]
    # The best lie side by side; take no two neighbours.
    for candidate in candidates:
        if len(chosen) >= len(axes) + _MORE_STARTS:
            break
        if all(
            candidate[1] != other[1] or angle_between(candidate[2].rotation, other[2].rotation) > _NEIGHBOUR_RADIANS
            for other in chosen
        ):
            chosen.append(candidate)
    starts = [(axis, stance) for _, axis, stance in chosen]
    if initial is not None:
        axis = max(axes, key=lambda axis: float(upward @ initial.rotation @ direction(axis)))
        starts.insert(0, (axis, Stance(initial.scale if scale is None else scale, initial.rotation, initial.position)))
    return starts


def _place_of_masks(cameras: Sequence[Camera], masks: Mapping[str, NDArray[np.bool_]]) -> tuple[Floats, float]:
    """Where the masks' centres meet, [3], and the container's size there, scene units.

    Masks that the border cuts have their centre elsewhere, and are left out where two others remain.
    """
    uncut = [camera for camera in cameras if not _is_cut(masks[camera.name])]
    used = uncut if len(uncut) >= 2 else cameras
    centres = [np.append(centre_of(masks[camera.name]), 1.0) for camera in used]
    rays = np.array([np.linalg.solve(camera.K, centre)[:2] for camera, centre in zip(used, centres)])
    position = triangulate(rays, np.array([camera.w2c for camera in used]))
    sizes = []
    for camera in used:
        rows, columns = np.nonzero(masks[camera.name])
        depth = float(camera.project(position[None])[1][0])
        sizes.append(np.hypot(np.ptp(rows) + 1, np.ptp(columns) + 1) * abs(depth) / camera.K[0, 0])
    return position, float(np.median(sizes))


def _is_cut(mask: NDArray[np.bool_]) -> bool:
    return bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())


def settle(mesh: ContainerMesh, views: Sequence[MaskView], stance: Stance, scale_free: bool) -> tuple[Stance, float]:
    """Moves the mesh, without turning it, until its silhouettes' centres are those of the masks.

    With `scale_free` the areas are matched too. Returns the best stance on the way and its mean overlap (intersection
    over union).
    """
    best, best_overlap = stance, -1.0
    for _ in range(_SETTLING_STEPS):
        rows, gaps, growth, overlaps = [], [], [], []
        for view in views:
            rendered = np.isfinite(view.depth(mesh, stance)).astype(np.float32)
            overlaps.append(float(np.minimum(rendered, view.mask).sum() / np.maximum(rendered, view.mask).sum()))
            if not rendered.any():
                continue
            gaps.append(centre_of(view.mask) - centre_of(rendered))
            growth.append(0.5 * np.log(view.mask.sum() / rendered.sum()))
            local = view.camera.w2c[:3, :3] @ stance.position + view.camera.w2c[:3, 3]
            slope = np.zeros((2, 3))
            slope[:, :2] = view.camera.K[:2, :2] / local[2]
            slope[:, 2] = -(view.camera.K[:2, :2] @ local[:2]) / local[2] ** 2
            rows.append(slope @ view.camera.w2c[:3, :3])
        if float(np.mean(overlaps)) > best_overlap:
            best, best_overlap = stance, float(np.mean(overlaps))
        if len(rows) < 2:
            break
        step = np.linalg.lstsq(np.concatenate(rows), np.concatenate(gaps), rcond=None)[0]
        scale = stance.scale * float(np.exp(np.median(growth))) if scale_free else stance.scale
        stance = Stance(scale, stance.rotation, stance.position + step)
    return best, best_overlap


def simplified(mesh: ContainerMesh, cells: int) -> ContainerMesh:
    """The mesh with vertices merged in a raster of `cells` over its longest side: for small pictures of it."""
    low = mesh.vertices.min(axis=0)
    size = float((mesh.vertices.max(axis=0) - low).max())
    cell = np.floor((mesh.vertices - low) / (size / cells)).astype(np.int64)
    _, merged, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    merged = merged.ravel()
    vertices = np.stack([np.bincount(merged, mesh.vertices[:, k]) / count for k in range(3)], axis=1)
    faces = merged[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    faces = faces[np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1]]
    return ContainerMesh(vertices, faces) if len(faces) else mesh


def upward_of(cameras: Sequence[Camera]) -> Floats:
    """Up [3] as the cameras are held: square to their x axes (they are level, but look down) and near their mean up."""
    sideways = np.array([camera.w2c[0, :3] for camera in cameras])
    mean = -np.mean([camera.w2c[1, :3] for camera in cameras], axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    spread = sideways.T @ sideways / len(cameras)
    # Cameras that look the same way leave the pitch open: there their mean decides.
    spread += _MEAN_UP_WEIGHT * (np.eye(3) - np.outer(mean, mean))
    up = np.linalg.eigh(spread)[1][:, 0]
    return up if up @ mean >= 0 else -up

"""Aligning a mesh with its silhouettes in several posed cameras.

The search starts upright at the place where the masks' centres meet, at many turns about the vertical axis, and
matches the silhouettes' centres (and areas, where the scale is unknown). The fit then moves the mesh by Gauss-Newton
steps, so that its rendered outlines meet those of the masks: each outline point is paired with the nearest of the
other outline, in both directions as in iterative closest points (Besl and McKay, IEEE TPAMI 14(2), 1992), and counts by
its distance along the normal. The point of the surface that makes an outline point comes from the rendered depth; as
the surface is seen edge-on there, its own sliding over the mesh changes no normal distance to first order. Tukey's
weights discard what has no counterpart: a hand before the container, a mask with a piece missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splashbench.container.contours import Array, Contour, find_contour
from splashbench.observe import mesh_kernels
from splashbench.observe.container import depth_image
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh

# Pairs of outline points whose normals differ by more than 60 degrees belong to different edges.
_SAME_EDGE_COSINE = 0.5
# Tukey's constant in standard deviations, and the least in pixels, so that quantisation alone discards nothing.
_TUKEY = 4.685
_LEAST_TUKEY_PX = 2.0
# Damping as a share of the mean curvature: holds still what the outlines do not say (a bowl's turn).
_DAMPING = 1e-3
# Gauss-Newton ends where the outlines move by less than this many pixels on average.
_STILL_PX = 0.01
_SEARCH_STEPS = 4


@dataclass(frozen=True, eq=False)
class Stance:
    """Where the centred mesh stands: x -> scale * rotation @ x + position, scene units."""

    scale: float
    rotation: Array  # [3, 3]
    position: Array  # [3]

    def moved(self, step: Array, length: float) -> Stance:
        """After a step [6 or 7]: position, rotation vector times `length`, and logarithm of the scale times it."""
        from scipy.spatial.transform import Rotation

        rotation = Rotation.from_rotvec(step[3:6] / length).as_matrix() @ self.rotation
        scale = self.scale * float(np.exp(step[6] / length)) if len(step) > 6 else self.scale
        return Stance(scale, rotation, self.position + step[:3])


@dataclass(frozen=True, eq=False)
class View:
    """A camera of a window of the image, at the working resolution, and the mask there (shares from 0 to 1)."""

    camera: Camera
    mask: NDArray[np.float32]
    contour: Contour
    factor: float  # working pixels per pixel of the image

    def depth(self, mesh: ContainerMesh, stance: Stance) -> NDArray[np.float32]:
        """Depth [H, W] of the mesh in scene units; inf where it is not seen."""
        return _depth(mesh, camera_of_mesh(self.camera, stance)) * np.float32(stance.scale)


def _depth(mesh: ContainerMesh, camera: Camera) -> NDArray[np.float32]:
    """`depth_image`, faster for a mesh that lies wholly before the camera: each vertex is projected once."""
    local = mesh.vertices @ camera.w2c[:3, :3].T + camera.w2c[:3, 3]
    z = local[:, 2:]
    if z.min() <= 1e-3 * z.max():
        return depth_image(mesh, camera)
    pixels = (local @ camera.K.T)[:, :2] / z
    return mesh_kernels.raster(np.concatenate([pixels, 1 / z], axis=1)[mesh.faces], camera.height, camera.width)


def camera_of_mesh(camera: Camera, stance: Stance) -> Camera:
    """The camera in the frame of the mesh and in its unit: it sees the mesh as `camera` sees the placed one."""
    w2c = np.eye(4)
    w2c[:3, :3] = camera.w2c[:3, :3] @ stance.rotation
    w2c[:3, 3] = (camera.w2c[:3, :3] @ stance.position + camera.w2c[:3, 3]) / stance.scale
    return replace(camera, w2c=w2c)


def make_view(camera: Camera, mask: NDArray[np.bool_], extent: float, margin: float) -> View:
    """`mask` [H, W] at the resolution where its longer side is at most `extent` pixels, cut out with a margin.

    margin: share of the mask's longer side that is kept around it.
    """
    import cv2

    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    longer = max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1
    scaled = camera.scaled(min(1.0, extent / longer))
    ratio = np.array([scaled.width / camera.width, scaled.height / camera.height])
    room = max(margin * longer * ratio.max(), 8.0)
    x0, y0 = (max(0, int(low * r - room)) for low, r in zip((columns[0], rows[0]), ratio))
    x1 = min(scaled.width, int(np.ceil((columns[-1] + 1) * ratio[0] + room)))
    y1 = min(scaled.height, int(np.ceil((rows[-1] + 1) * ratio[1] + room)))
    small = cv2.resize(mask.astype(np.float32), (scaled.width, scaled.height), interpolation=cv2.INTER_AREA)
    part = np.ascontiguousarray(small[y0:y1, x0:x1])
    return View(scaled.cropped(x0, y0, x1 - x0, y1 - y0), part, find_contour(part), float(ratio.max()))


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Outline points of one view in pairs: signed normal distances [N] in pixels and their slopes [N, 7]."""

    residuals: Array
    slopes: Array
    n_rendered: int  # points of the rendered outline and of the mask's, those without a partner as well
    n_mask: int


def _pairs(view: View, mesh: ContainerMesh, stance: Stance, length: float, reach: float) -> _Pairs:
    depth = view.depth(mesh, stance)
    rendered = find_contour(np.isfinite(depth))
    nothing = _Pairs(np.zeros(0), np.zeros((0, 7)), len(rendered.points), len(view.contour.points))
    if not nothing.n_rendered or not nothing.n_mask:
        return nothing
    forth_gap, forth = view.contour.tree.query(rendered.points)
    back_gap, back = rendered.tree.query(view.contour.points)
    of_rendered = np.concatenate([np.arange(nothing.n_rendered), back])
    of_mask = np.concatenate([forth, np.arange(nothing.n_mask)])
    normal = rendered.normals[of_rendered] + view.contour.normals[of_mask]
    cosine = np.einsum("ij,ij->i", rendered.normals[of_rendered], view.contour.normals[of_mask])
    kept = (np.concatenate([forth_gap, back_gap]) <= reach) & (cosine >= _SAME_EDGE_COSINE)
    pixels, z = rendered.points, _depth_inside(depth, rendered.points)
    kept &= np.isfinite(z[of_rendered])
    of_rendered, of_mask, normal = of_rendered[kept], of_mask[kept], normal[kept]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    residuals = np.einsum("ij,ij->i", normal, pixels[of_rendered] - view.contour.points[of_mask])

    camera = view.camera
    local = np.linalg.solve(camera.K, np.column_stack([pixels, np.ones(len(pixels))]).T).T
    local = (local * z[:, None])[of_rendered]
    # d pixel / d camera coordinates, contracted with the normal.
    in_plane = normal @ camera.K[:2, :2] / local[:, 2:]
    towards = -np.einsum("ij,ij->i", in_plane, local[:, :2]) / local[:, 2]
    slope = np.column_stack([in_plane, towards]) @ camera.w2c[:3, :3]
    arm = (local - camera.w2c[:3, 3]) @ camera.w2c[:3, :3] - stance.position
    turning = np.cross(arm, slope) / length
    growing = np.einsum("ij,ij->i", arm, slope)[:, None] / length
    return replace(nothing, residuals=residuals, slopes=np.concatenate([slope, turning, growing], axis=1))


def _depth_inside(depth: NDArray[np.float32], points: Array) -> Array:
    """Depth [N] of the surface at outline points, from the silhouette's pixels next to them."""
    import cv2

    nearest = cv2.erode(depth, np.ones((3, 3), np.uint8))
    column, row = np.floor(points).astype(int).T
    found = nearest[np.clip(row, 0, depth.shape[0] - 1), np.clip(column, 0, depth.shape[1] - 1)]
    return found.astype(np.float64)


@dataclass(frozen=True, eq=False)
class Fit:
    """A stance and how well its outlines meet the masks'.

    cost: RMS distance of outline points in pixels of the working resolution, none counted beyond `reach`.
    curvatures [V, 7, 7] and slopes [V, 7]: the normal equations of each view at the stance.
    """

    stance: Stance
    cost: float
    curvatures: Array
    slopes: Array


def refine(
    mesh: ContainerMesh,
    views: Sequence[View],
    stance: Stance,
    free: Sequence[int],
    length: float,
    reach: float,
    steps: int,
    axis: Array | None = None,
) -> Fit:
    """Gauss-Newton from `stance`; the best of all stances on the way.

    free: which of position (0..2), rotation (3..5) and scale (6) may change. axis: unit vector [3] about which the
    mesh must not turn. length: scene units over which rotation is measured. reach: pixels within which outlines are
    paired.
    """
    best: Fit | None = None
    chosen = np.array(free)
    for _ in range(steps + 1):
        found = [_pairs(view, mesh, stance, length, reach) for view in views]
        fit = _normal_equations(stance, found, reach)
        if best is None or fit.cost < best.cost:
            best = fit
        curvature, slope = fit.curvatures.sum(axis=0)[np.ix_(chosen, chosen)], fit.slopes.sum(axis=0)[chosen]
        mean = float(np.trace(curvature)) / len(chosen)
        if mean <= 0:
            break
        damped = curvature + _DAMPING * mean * np.eye(len(chosen))
        if axis is not None:
            turn = np.zeros(7)
            turn[3:6] = axis
            damped += 1e6 * mean * np.outer(turn, turn)[np.ix_(chosen, chosen)]
        step = np.zeros(7)
        step[chosen] = -np.linalg.solve(damped, slope)
        # Never further than outlines were paired.
        step *= min(1.0, 0.3 * length / max(float(np.linalg.norm(step[:6])), 1e-12))
        moved = float(np.sqrt(np.mean([np.mean((f.slopes @ step) ** 2) for f in found if len(f.slopes)])))
        stance = stance.moved(step if 6 in free else step[:6], length)
        if moved < _STILL_PX:
            break
    assert best is not None  # the loop runs at least once
    return best


def _normal_equations(stance: Stance, found: Sequence[_Pairs], reach: float) -> Fit:
    """Weighted by Tukey's function of the residuals, whose scale is robust too."""
    residuals = np.concatenate([pairs.residuals for pairs in found])
    total = sum(pairs.n_rendered + pairs.n_mask for pairs in found)
    if not len(residuals):
        return Fit(stance, np.inf, np.zeros((len(found), 7, 7)), np.zeros((len(found), 7)))
    deviation = 1.4826 * float(np.median(np.abs(residuals)))
    limit = min(max(_TUKEY * deviation, _LEAST_TUKEY_PX), reach)
    curvatures, slopes = [], []
    for pairs in found:
        weight = np.square(np.clip(1 - np.square(pairs.residuals / limit), 0.0, None))
        weighted = pairs.slopes * weight[:, None]
        curvatures.append(weighted.T @ pairs.slopes)
        slopes.append(weighted.T @ pairs.residuals)
    missing = total - len(residuals)
    squares = float(np.square(np.minimum(np.abs(residuals), reach)).sum()) + missing * reach**2
    return Fit(stance, float(np.sqrt(squares / total)), np.array(curvatures), np.array(slopes))


def settle(mesh: ContainerMesh, views: Sequence[View], stance: Stance, scale_free: bool) -> tuple[Stance, float]:
    """Moves the mesh, without turning it, until its silhouettes' centres are those of the masks.

    With `scale_free` the areas are matched too. Returns the best stance on the way and its mean overlap (intersection
    over union).
    """
    best, best_overlap = stance, -1.0
    for _ in range(_SEARCH_STEPS):
        rows, gaps, growth, overlaps = [], [], [], []
        for view in views:
            shown = np.isfinite(view.depth(mesh, stance)).astype(np.float32)
            overlaps.append(float(np.minimum(shown, view.mask).sum() / np.maximum(shown, view.mask).sum()))
            if not shown.any():
                continue
            gaps.append(centre_of(view.mask) - centre_of(shown))
            growth.append(0.5 * np.log(view.mask.sum() / shown.sum()))
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


def centre_of(mask: NDArray) -> Array:
    """Centre (u, v) of a silhouette [H, W] in pixels."""
    total = float(mask.sum())
    columns, rows = mask.sum(axis=0, dtype=np.float64), mask.sum(axis=1, dtype=np.float64)
    return np.array([columns @ (np.arange(mask.shape[1]) + 0.5), rows @ (np.arange(mask.shape[0]) + 0.5)]) / total


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

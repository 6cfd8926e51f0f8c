"""Placing the scanned container into the scene by its masks, and gravity from how it stands.

The paper aligns the cleaned meshes with the capture by hand and verifies them by projecting them into the calibrated
images (Sec. S1.3); here the silhouettes decide (`alignment`). Only the cameras that are handed over take part, so that
held-out views can verify (`check`) what they did not decide. Clicked points are in `points`.

What silhouettes cannot tell is settled by rule and said: a bowl may be turned about its axis at will, a box by half a
turn, and a closed box may stand on its head.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splashbench.container.alignment import Fit, Stance, View, centre_of, make_view, refine, settle, simplified
from splashbench.container.contours import Array, find_contour
from splashbench.container.verification import Projection, project
from splashbench.errors import SplashbenchError
from splashbench.prepare.poses.metric import triangulate
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh

Axis = Literal["x", "-x", "y", "-y", "z", "-z"]
#: directions of a mesh that may point up, the likeliest first: where silhouettes fit alike, the first is taken
AXES: tuple[Axis, ...] = ("y", "z", "-z", "-y", "x", "-x")
Turn = Literal["determined", "repeats", "free"]

# Longer side of a mask in pixels (at most) and margin about it (as a share of it) of the views that are searched.
_SEARCH = (64.0, 0.6)
# For each fit likewise, then the reach of the pairing (as such a share) and the number of steps.
_COARSE = (96.0, 0.6, 0.5, 12)
_MEDIUM = (300.0, 0.25, 0.15, 12)
_FINE = (1000.0, 0.08, 0.04, 12)
# Cells over the mesh's longest side until the fine fit, for which alone a scan is drawn whole. Fewer than so many faces
# are always drawn.
_SEARCH_CELLS, _COARSE_CELLS, _MEDIUM_CELLS = 40, 64, 96
_FEW_FACES = 4000
_TURNS = 24
# Starts of the coarse fit beyond the best of each axis, and of the medium one.
_MORE_STARTS = 5
_MEDIUM_STARTS = 3
# Fits whose costs differ by less than this share plus this many pixels are alike.
_ALIKE = (1.05, 0.02)
# Turns whose outlines differ by less than a pixel of the image, or this share of the container, cannot be told apart.
_SAME_OUTLINE = 0.005
_SAME_POINTS = 98  # percentile of the outline's points
_TURN_STEP_DEGREES, _BROAD_STEP_DEGREES = 3, 15
# Of the cameras' mean up direction beside that which their level x axes leave.
_MEAN_UP_WEIGHT = 0.01
# Added to the wanted turn, so that a container that stands square to the scene's axes never lies between two turns.
_TIE_DEGREES = 10.0


@dataclass(frozen=True, eq=False)
class Placement:
    """The container's mesh in the scene.

    Attributes:
        pose: [4, 4], mesh to scene; its upper left is `scale` times a rotation.
        scale: scene units per unit of the mesh.
        up_axis: the direction of the mesh that points up.
        up: that direction in the scene, [3], unit length.
        up_is_ambiguous: another direction of the mesh fits as well.
        turn: whether the rotation about the vertical axis is "determined", "repeats" (there are `equivalent_turns`
            of them that look the same) or is "free" (it looks the same however turned).
        equivalent_turns: 1 where determined, 0 where free.
        cameras: those that decided.
        projections: per camera that decided, overlap and distance of the outlines (see `check`).
        cost_px: RMS distance of the outlines (of the clicked points) over all of `cameras`, occluded parts counted no
            further than the fit's reach; pixels of the image, or where a mask is longer than 1000 of them, of the
            image reduced to that.
        position_sigma, tilt_sigma_degrees: jackknife over the cameras that decided: how far the container's centre
            (scene units) and its vertical axis would lie elsewhere with other such cameras. None for two cameras.
        point_rms_px: per camera, the error of clicked points; empty where none were used.
    """

    pose: Array
    scale: float
    up_axis: str
    up: Array
    up_is_ambiguous: bool
    turn: Turn
    equivalent_turns: int
    cameras: tuple[str, ...]
    projections: dict[str, Projection]
    cost_px: float | None = None
    position_sigma: float | None = None
    tilt_sigma_degrees: float | None = None
    point_rms_px: dict[str, float] | None = None


def place_by_silhouettes(
    mesh: ContainerMesh,
    cameras: Sequence[Camera],
    masks: Mapping[str, NDArray[np.bool_]],
    *,
    up: Axis | None = None,
    metres_per_unit: float | None = 1.0,
    gravity: ArrayLike | None = (0.0, -1.0, 0.0),
    initial: ArrayLike | None = None,
    source: str = "container masks",
) -> Placement:
    """Place `mesh` so that its silhouettes are `masks`.

    Args:
        cameras: pinhole cameras in metres; those without a mask take no part. Give training cameras only.
        masks: camera name -> bool [H, W], True on the container.
        up: the mesh's direction that points up; None tries all six.
        metres_per_unit: metres per unit of the mesh; None finds the scale.
        gravity: [3] in the scene, where the search begins; the fit is free to tilt. None: unknown, the cameras are
            taken to be held upright on average.
        initial: [4, 4] mesh to scene, one more start; of what silhouettes cannot tell the nearest to it is taken.
        source: names the masks in messages.

    Raises SplashbenchError for fewer than two masks, an empty mask or one of another size than its camera's image.
    """
    used = _checked(cameras, masks, source)
    body = _Body.of(mesh)
    upward = _upwards(used) if gravity is None else -np.asarray(gravity, dtype=np.float64)
    upward = upward / np.linalg.norm(upward)
    searched, coarse, medium = (
        body.mesh if len(body.mesh.faces) <= _FEW_FACES else simplified(body.mesh, cells)
        for cells in (_SEARCH_CELLS, _COARSE_CELLS, _MEDIUM_CELLS)
    )
    first = None if initial is None else body.stance(np.asarray(initial, dtype=np.float64))
    axes = AXES if up is None else (up,)
    starts = _starts(searched, used, masks, axes, upward, metres_per_unit, first)

    free = (0, 1, 2, 3, 4, 5) if metres_per_unit is not None else (0, 1, 2, 3, 4, 5, 6)
    fits = [(axis, _fit(coarse, used, masks, _COARSE, stance, free)) for axis, stance in starts]
    fits = sorted(fits, key=lambda item: item[1].cost)[:_MEDIUM_STARTS] + _best_of_each(fits, axes)
    # Twice the same start fits twice the same.
    unique = {id(fit): (axis, fit) for axis, fit in fits if fit.cost <= 2 * fits[0][1].cost + 1}
    fits = [(axis, _fit(medium, used, masks, _MEDIUM, fit.stance, free)) for axis, fit in unique.values()]
    lowest = min(fit.cost for _, fit in fits)
    if not np.isfinite(lowest):
        raise SplashbenchError(f"{source}: the mesh is seen in no camera wherever it is put; check mesh and masks")
    alike = [(axis, fit) for axis, fit in fits if fit.cost <= lowest * _ALIKE[0] + _ALIKE[1]]
    axis = min((axis for axis, _ in alike), key=AXES.index)
    fit = min((fit for other, fit in alike if other == axis), key=lambda fit: fit.cost)

    wanted = _upright(axis, upward) if first is None else first.rotation
    views = [make_view(camera, masks[camera.name], *_MEDIUM[:2]) for camera in used]
    turn, count, stance, vertical = _settled_turn(body, medium, views, fit.stance, axis, wanted)
    fit = _fit(body.mesh, used, masks, _FINE, stance, free, vertical if turn == "free" else None)
    pose = body.pose(fit.stance)
    position_sigma, tilt_sigma = _jackknife(fit, free, body.length * fit.stance.scale, axis)
    return Placement(
        pose=pose,
        scale=fit.stance.scale,
        up_axis=axis,
        up=fit.stance.rotation @ direction(axis),
        up_is_ambiguous=len({axis for axis, _ in alike}) > 1,
        turn=turn,
        equivalent_turns=count,
        cameras=tuple(camera.name for camera in used),
        projections={camera.name: project(mesh, pose, camera, masks[camera.name]) for camera in used},
        cost_px=fit.cost,
        position_sigma=position_sigma,
        tilt_sigma_degrees=tilt_sigma,
    )


def up_from_container(placement: Placement) -> tuple[float, float, float]:
    """Where up is, unit vector in the scene's frame, from a container that stands on a level table.

    For sessions without a flat board: place with `gravity=None`, then turn the scene so that this is +y.
    """
    x, y, z = placement.up / np.linalg.norm(placement.up)
    return float(x), float(y), float(z)


def _checked(cameras: Sequence[Camera], masks: Mapping[str, NDArray[np.bool_]], source: str) -> list[Camera]:
    used = [camera for camera in cameras if camera.name in masks]
    if len(used) < 2:
        raise SplashbenchError(f"{source}: {len(used)} of the cameras to fit has a mask, two are needed; add masks")
    for camera in used:
        mask = masks[camera.name]
        if mask.shape != (camera.height, camera.width):
            size = "x".join(str(n) for n in mask.shape[::-1])
            raise SplashbenchError(
                f"{source}: the mask of camera {camera.name} is {size}, its images are {camera.width}x{camera.height};"
                " give masks of the same frames"
            )
        if not mask.any():
            raise SplashbenchError(f"{source}: the mask of camera {camera.name} is empty; draw it or leave it out")
        if not len(find_contour(mask).points):
            raise SplashbenchError(
                f"{source}: the mask of camera {camera.name} has no outline inside the image; draw it or leave it out"
            )
    return used


@dataclass(frozen=True, eq=False)
class _Body:
    """The mesh with its surface's centre at the origin: `mesh`; `centre` [3] and half the diagonal, mesh units.

    axes: [3, 3] principal axes of the surface in columns; sizes [3] its variances along them.
    """

    mesh: ContainerMesh
    centre: Array
    length: float
    axes: Array
    sizes: Array

    @classmethod
    def of(cls, mesh: ContainerMesh) -> _Body:
        corners = mesh.triangles
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        area = area / area.sum()
        centre = area @ corners.mean(axis=1)
        # Second moments of a triangle: of its corners and of its centre, with weights 1/12 and 9/12.
        offset, middle = corners - centre, corners.mean(axis=1) - centre
        moments = np.einsum("f,fki,fkj->ij", area, offset, offset) / 12 + 0.75 * (middle * area[:, None]).T @ middle
        sizes, axes = np.linalg.eigh(moments)
        length = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) / 2
        return cls(ContainerMesh(mesh.vertices - centre, mesh.faces), centre, length, axes, sizes)

    def pose(self, stance: Stance) -> Array:
        """The pose [4, 4] of the mesh as it came."""
        pose = np.eye(4)
        pose[:3, :3] = stance.scale * stance.rotation
        pose[:3, 3] = stance.position - pose[:3, :3] @ self.centre
        return pose

    def stance(self, pose: Array) -> Stance:
        """The stance of a pose [4, 4] without shear."""
        scale = float(np.cbrt(np.linalg.det(pose[:3, :3])))
        return Stance(scale, pose[:3, :3] / scale, pose[:3, :3] @ self.centre + pose[:3, 3])

    def vertical(self, axis: Axis) -> Array:
        """The axis [3] of the mesh about which it may look alike: a principal one near `axis`, else `axis` itself.

        A scan is rarely level in its own coordinates.
        """
        along = direction(axis)
        nearest = int(np.argmax(np.abs(along @ self.axes)))
        own = self.axes[:, nearest] * np.sign(along @ self.axes[:, nearest])
        others = np.delete(self.sizes, nearest)
        apart = np.abs(others - self.sizes[nearest]).min() > 3 * np.ptp(others)
        return own if apart and own @ along > 0.9 else along


def direction(axis: str) -> Array:
    """The unit vector [3] of an axis of the mesh such as "-z"."""
    found = np.zeros(3)
    found["xyz".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    return found


def _upwards(cameras: Sequence[Camera]) -> Array:
    """Up as the cameras hold it: square to their x axes, as cameras are level but look down, and near their mean up."""
    sideways = np.array([camera.w2c[0, :3] for camera in cameras])
    mean = -np.mean([camera.w2c[1, :3] for camera in cameras], axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    spread = sideways.T @ sideways / len(cameras)
    # Cameras that look the same way leave the pitch open: there their mean decides.
    spread += _MEAN_UP_WEIGHT * (np.eye(3) - np.outer(mean, mean))
    up = np.linalg.eigh(spread)[1][:, 0]
    return up if up @ mean >= 0 else -up


def _upright(axis: Axis, upward: Array) -> Array:
    """The least rotation [3, 3] that takes `axis` of the mesh up in a scene with y up, then that to `upward`."""
    return _least_rotation(np.array([0.0, 1.0, 0.0]), upward) @ _least_rotation(
        direction(axis), np.array([0.0, 1.0, 0.0])
    )


def _least_rotation(a: Array, b: Array) -> Array:
    """The smallest rotation [3, 3] that takes unit vector a to b; about z or x where they are opposite."""
    from scipy.spatial.transform import Rotation

    normal, cosine = np.cross(a, b), float(a @ b)
    if np.linalg.norm(normal) < 1e-9:
        other = np.array([0.0, 0.0, 1.0]) if abs(a[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
        return np.eye(3) if cosine > 0 else Rotation.from_rotvec(np.pi * other).as_matrix()
    angle = np.arctan2(np.linalg.norm(normal), cosine)
    return Rotation.from_rotvec(angle * normal / np.linalg.norm(normal)).as_matrix()


def _about(axis: Array, angle: float) -> Array:
    """Rotation [3, 3] about a unit vector by `angle` radians."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(angle * axis).as_matrix()


def _starts(
    mesh: ContainerMesh,
    cameras: Sequence[Camera],
    masks: Mapping[str, NDArray[np.bool_]],
    axes: Sequence[Axis],
    upward: Array,
    scale: float | None,
    first: Stance | None,
) -> list[tuple[Axis, Stance]]:
    """Where fits begin: per axis the turn whose silhouettes overlap most with the masks, and the best of the rest."""
    views = [make_view(camera, masks[camera.name], *_SEARCH) for camera in cameras]
    position, reach = _where(cameras, masks)
    begun = reach / float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) if scale is None else scale
    tried: list[tuple[float, Axis, Stance]] = []
    for axis in axes:
        upright = _upright(axis, upward)
        for angle in np.arange(_TURNS) * 2 * np.pi / _TURNS:
            stance = Stance(begun, _about(upward, angle) @ upright, position)
            settled, overlap = settle(mesh, views, stance, scale is None)
            tried.append((overlap, axis, settled))
    tried.sort(key=lambda start: -start[0])
    chosen = [next(start for start in tried if start[1] == axis) for axis in axes]
    # The best lie side by side; take no two neighbours.
    for start in tried:
        if len(chosen) >= len(axes) + _MORE_STARTS:
            break
        if all(start[1] != other[1] or _angle(start[2].rotation, other[2].rotation) > 0.6 for other in chosen):
            chosen.append(start)
    found = [(axis, stance) for _, axis, stance in chosen]
    if first is not None:
        axis = max(axes, key=lambda axis: float(upward @ first.rotation @ direction(axis)))
        found.insert(0, (axis, Stance(first.scale if scale is None else scale, first.rotation, first.position)))
    return found


def _where(cameras: Sequence[Camera], masks: Mapping[str, NDArray[np.bool_]]) -> tuple[Array, float]:
    """Where the masks' centres meet, [3], and the container's size there, scene units.

    Masks that the border cuts have their centre elsewhere, and are left out where two others remain.
    """
    whole = [camera for camera in cameras if not _is_cut(masks[camera.name])]
    used = whole if len(whole) >= 2 else cameras
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


def _angle(a: Array, b: Array) -> float:
    """Angle in radians of the rotation between two rotations [3, 3]."""
    return float(np.arccos(np.clip((np.trace(a.T @ b) - 1) / 2, -1, 1)))


def _fit(
    mesh: ContainerMesh,
    cameras: Sequence[Camera],
    masks: Mapping[str, NDArray[np.bool_]],
    level: tuple[float, float, float, int],
    stance: Stance,
    free: Sequence[int],
    axis: Array | None = None,
) -> Fit:
    extent, margin, reach, steps = level
    views = [make_view(camera, masks[camera.name], extent, margin) for camera in cameras]
    pixels = max(max(view.mask.shape) for view in views) / (1 + 2 * margin)
    length = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) / 2 * stance.scale
    return refine(mesh, views, stance, free, length, max(reach * pixels, 4.0), steps, axis)


def _best_of_each(fits: Sequence[tuple[Axis, Fit]], axes: Sequence[Axis]) -> list[tuple[Axis, Fit]]:
    found = []
    for axis in axes:
        own = [item for item in fits if item[0] == axis]
        if own:
            found.append(min(own, key=lambda item: item[1].cost))
    return found


def _settled_turn(
    body: _Body, mesh: ContainerMesh, views: Sequence[View], stance: Stance, axis: Axis, wanted: Array
) -> tuple[Turn, int, Stance, Array]:
    """How far the outlines tell the turn about the vertical axis, and of the turns that look alike the one to take.

    Returns that, how many look alike (0: all), the stance turned, and the axis in the scene [3].
    """
    own = body.vertical(axis)
    shown = [find_contour(np.isfinite(view.depth(mesh, stance))) for view in views]

    def alike(degrees: int) -> bool:
        return _looks_alike(mesh, views, shown, _turned(stance, own, float(np.deg2rad(degrees))))

    vertical = stance.rotation @ own
    # The turn that brings the rotation nearest to the wanted one: the largest trace of wanted^T A(turn) R.
    between = stance.rotation @ wanted.T
    skew = np.array([between[2, 1] - between[1, 2], between[0, 2] - between[2, 0], between[1, 0] - between[0, 1]])
    nearest = np.arctan2(-vertical @ skew, np.trace(between) - vertical @ between @ vertical)
    # These compose to every turn that is tried below.
    fine, broad = range(_TURN_STEP_DEGREES, _BROAD_STEP_DEGREES, _TURN_STEP_DEGREES), range(0, 360, _BROAD_STEP_DEGREES)
    if all(alike(degrees) for degrees in (*fine, *broad)):
        return "free", 0, _turned(stance, own, float(nearest)), vertical
    angles = np.arange(0, 360, _TURN_STEP_DEGREES)
    runs = _runs(np.array([alike(degrees) for degrees in angles.tolist()]))
    if len(runs) < 2:
        return "determined", 1, stance, vertical
    target = nearest + np.deg2rad(_TIE_DEGREES)
    options = [np.deg2rad(angles[run[len(run) // 2]]) for run in runs]
    chosen = max(options, key=lambda angle: float(np.cos(angle - target)))
    return "repeats", len(runs), _turned(stance, own, float(chosen)), vertical


def _turned(stance: Stance, own: Array, angle: float) -> Stance:
    """Turned by `angle` radians about the axis `own` of the mesh, through its centre."""
    return Stance(stance.scale, stance.rotation @ _about(own, angle), stance.position)


def _looks_alike(mesh: ContainerMesh, views: Sequence[View], shown: Sequence, stance: Stance) -> bool:
    for view, before in zip(views, shown):
        now = find_contour(np.isfinite(view.depth(mesh, stance)))
        if not len(now.points) or not len(before.points):
            continue
        tolerance = max(view.factor, _SAME_OUTLINE * float(np.ptp(before.points, axis=0).max()))
        for one, other in ((now, before), (before, now)):
            if np.percentile(one.distances_to(other), _SAME_POINTS) > tolerance:
                return False
    return True


def _runs(alike: NDArray[np.bool_]) -> list[list[int]]:
    """Indices of each run of True around a circle; the one that holds the first entry, which is True, comes first."""
    breaks = np.flatnonzero(~alike)
    if not len(breaks):
        return [list(range(len(alike)))]
    order = np.roll(np.arange(len(alike)), -int(breaks[-1]) - 1)
    runs: list[list[int]] = []
    for position, index in enumerate(order.tolist()):
        if not alike[index]:
            continue
        if position and alike[order[position - 1]]:
            runs[-1].append(index)
        else:
            runs.append([index])
    return sorted(runs, key=lambda run: 0 not in run)


def _jackknife(fit: Fit, free: Sequence[int], length: float, axis: Axis) -> tuple[float | None, float | None]:
    """Sigmas of the centre (scene units) and of the vertical axis (degrees) from leaving out one camera at a time.

    One Gauss-Newton step each (Efron's jackknife): unlike the curvature alone it knows that the errors of
    neighbouring points of an outline, and of a whole mask, go together.
    """
    n = len(fit.curvatures)
    if n < 3:
        return None, None
    chosen = np.array(free)
    curvature, slope = fit.curvatures.sum(axis=0), fit.slopes.sum(axis=0)
    steps = np.zeros((n, 7))
    for k in range(n):
        rest = (curvature - fit.curvatures[k])[np.ix_(chosen, chosen)]
        # What the outlines do not say has no sigma: leave it where it is.
        steps[k, chosen] = -np.linalg.pinv(rest, rcond=1e-4, hermitian=True) @ (slope - fit.slopes[k])[chosen]
    covariance = (n - 1) / n * (steps - steps.mean(axis=0)).T @ (steps - steps.mean(axis=0))
    vertical = fit.stance.rotation @ direction(axis)
    across = np.eye(3) - np.outer(vertical, vertical)
    tilt = across @ covariance[3:6, 3:6] @ across / length**2
    return float(np.sqrt(np.trace(covariance[:3, :3]))), float(np.rad2deg(np.sqrt(np.trace(tilt))))

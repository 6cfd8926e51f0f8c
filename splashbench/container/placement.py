"""Placing a scanned container in the scene by its masks.

The paper aligns the cleaned meshes with the capture by hand, and verifies them by projecting them into the calibrated
images (Sec. S1.3). Here the silhouettes decide: `starts` finds where to begin, `outline_fit` moves the mesh until its
outlines meet the masks', `symmetry` settles what they leave open. Only the cameras that are handed over take part, so
that held-out views can verify (`verification`) what they did not decide. `clicked_points` places by points instead.

What silhouettes cannot tell is settled by rule and reported: a bowl may be turned about its axis at will, a box by half
a turn, and a closed box may stand on its head.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splashbench.arrays import Floats
from splashbench.container.contours import find_contour
from splashbench.container.mask_views import make_view
from splashbench.container.outline_fit import OutlineFit, jackknife, refine
from splashbench.container.stance import AXES, Axis, CentredMesh, Stance, direction, upright
from splashbench.container.starts import find_starts, simplified, upward_of
from splashbench.container.symmetry import Turn, settle_turn
from splashbench.container.verification import Projection, project
from splashbench.errors import SplashbenchError
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh


class _FitLevel(NamedTuple):
    """How fine a fit is.

    extent: longer side of a mask in pixels, at most. margin: about it, as a share of it. reach: of the pairing, as such
    a share. steps: of Gauss-Newton.
    """

    extent: float
    margin: float
    reach: float
    steps: int


_COARSE = _FitLevel(96.0, 0.6, 0.5, 12)
_MEDIUM = _FitLevel(300.0, 0.25, 0.15, 12)
_FINE = _FitLevel(1000.0, 0.08, 0.04, 12)
# Cells over the mesh's longest side until the fine fit, for which alone a scan is drawn whole. Fewer than so many faces
# are always drawn.
_SEARCH_CELLS, _COARSE_CELLS, _MEDIUM_CELLS = 40, 64, 96
_FEW_FACES = 4000
# Starts of the medium fit beyond the best of each axis.
_MEDIUM_STARTS = 3
# Fits whose costs differ by less than this share plus this many pixels are alike.
_ALIKE = (1.05, 0.02)


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
        projections: per camera that decided, overlap and distance of the outlines (see `verification`).
        cost_px: RMS distance of the outlines (of the clicked points) over all of `cameras`, occluded parts counted no
            further than the fit's reach; pixels of the image, or where a mask is longer than 1000 of them, of the
            image reduced to that.
        position_sigma, tilt_sigma_degrees: jackknife over the cameras that decided: how far the container's centre
            (scene units) and its vertical axis would lie elsewhere with other such cameras. None for two cameras.
        point_rms_px: per camera, the error of clicked points; empty where none were used.
    """

    pose: Floats
    scale: float
    up_axis: str
    up: Floats
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
    used = _cameras_with_masks(cameras, masks, source)
    body = CentredMesh.of(mesh)
    upward = upward_of(used) if gravity is None else -np.asarray(gravity, dtype=np.float64)
    upward = upward / np.linalg.norm(upward)
    searched, coarse, medium = (
        body.mesh if len(body.mesh.faces) <= _FEW_FACES else simplified(body.mesh, cells)
        for cells in (_SEARCH_CELLS, _COARSE_CELLS, _MEDIUM_CELLS)
    )
    initial_stance = None if initial is None else body.stance(np.asarray(initial, dtype=np.float64))
    axes = AXES if up is None else (up,)
    starts = find_starts(searched, used, masks, axes, upward, metres_per_unit, initial_stance)

    free = (0, 1, 2, 3, 4, 5) if metres_per_unit is not None else (0, 1, 2, 3, 4, 5, 6)
    fits = [(axis, _fit(coarse, used, masks, _COARSE, stance, free)) for axis, stance in starts]
    fits = sorted(fits, key=lambda item: item[1].cost)[:_MEDIUM_STARTS] + _best_of_each(fits, axes)
    # Twice the same start fits twice the same.
    distinct = {id(fit): (axis, fit) for axis, fit in fits if fit.cost <= 2 * fits[0][1].cost + 1}
    fits = [(axis, _fit(medium, used, masks, _MEDIUM, fit.stance, free)) for axis, fit in distinct.values()]
    lowest = min(fit.cost for _, fit in fits)
    if not np.isfinite(lowest):
        raise SplashbenchError(f"{source}: the mesh is seen in no camera wherever it is put; check mesh and masks")
    alike = [(axis, fit) for axis, fit in fits if fit.cost <= lowest * _ALIKE[0] + _ALIKE[1]]
    axis = min((axis for axis, _ in alike), key=AXES.index)
    fit = min((fit for other, fit in alike if other == axis), key=lambda fit: fit.cost)

    preferred = upright(axis, upward) if initial_stance is None else initial_stance.rotation
    views = [make_view(camera, masks[camera.name], _MEDIUM.extent, _MEDIUM.margin) for camera in used]
    turn, count, stance, vertical = settle_turn(body, medium, views, fit.stance, axis, preferred)
    fit = _fit(body.mesh, used, masks, _FINE, stance, free, vertical if turn == "free" else None)
    pose = body.pose(fit.stance)
    position_sigma, tilt_sigma = jackknife(fit, free, body.length * fit.stance.scale, axis)
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


def _cameras_with_masks(cameras: Sequence[Camera], masks: Mapping[str, NDArray[np.bool_]], source: str) -> list[Camera]:
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


def _fit(
    mesh: ContainerMesh,
    cameras: Sequence[Camera],
    masks: Mapping[str, NDArray[np.bool_]],
    level: _FitLevel,
    stance: Stance,
    free: Sequence[int],
    axis: Floats | None = None,
) -> OutlineFit:
    views = [make_view(camera, masks[camera.name], level.extent, level.margin) for camera in cameras]
    pixels = max(max(view.mask.shape) for view in views) / (1 + 2 * level.margin)
    length = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) / 2 * stance.scale
    return refine(mesh, views, stance, free, length, max(level.reach * pixels, 4.0), level.steps, axis)


def _best_of_each(fits: Sequence[tuple[Axis, OutlineFit]], axes: Sequence[Axis]) -> list[tuple[Axis, OutlineFit]]:
    best = []
    for axis in axes:
        of_axis = [item for item in fits if item[0] == axis]
        if of_axis:
            best.append(min(of_axis, key=lambda item: item[1].cost))
    return best

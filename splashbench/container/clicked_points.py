"""Placing the container by clicked points: a point of the mesh and its pixels in several images.

The start: points clicked in two cameras are triangulated and aligned with the mesh in closed form (`umeyama`). The
three that agree best with all the others decide, so that one click on the wrong corner does not spoil the start. Where
too few are shared, one camera alone gives the start (perspective from n points).

The fit: all clicks of all cameras decide together by their distance in the images, under a loss that bounds what one of
them can do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from splashbench.alignment import triangulate, umeyama
from splashbench.arrays import Floats
from splashbench.container.placement import Placement
from splashbench.container.stance import AXES, Axis, Stance, direction
from splashbench.container.verification import verify
from splashbench.errors import SplashbenchError
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh

# Clicks further off than a few pixels lose their weight (Cauchy's loss).
_CLICK_PX = 3.0
_MAX_TRIPLES = 400
# Points whose extent across their longest line is less than this share of it lie on a line.
_LINE = 0.02


@dataclass(frozen=True, eq=False)
class ClickedPoint:
    """A point [3] of the mesh and where cameras see it: camera name -> (u, v) in pixels, pixel centres at +0.5."""

    point: tuple[float, float, float]
    pixels: dict[str, tuple[float, float]]


def place_by_points(
    mesh: ContainerMesh,
    cameras: Sequence[Camera],
    clicks: Sequence[ClickedPoint],
    *,
    up: Axis | None = None,
    gravity: Sequence[float] | None = None,
    metres_per_unit: float | None = 1.0,
    masks: Mapping[str, NDArray[np.bool_]] | None = None,
    source: str = "container points",
) -> Placement:
    """Place `mesh` so that its clicked points fall on their pixels.

    Args:
        up: the direction of the mesh that points up; None takes the one that ends up nearest to against `gravity`
            ([3], scene's frame), "y" where that is None too. It decides nothing about the pose.
        cameras: pinhole cameras; pixels are those of their undistorted images. Give training cameras only.
        metres_per_unit: metres per unit of the mesh; None finds the scale.
        masks: where given, the placement's overlaps are measured on them; they decide nothing.

    Raises SplashbenchError where the points do not determine the placement: fewer than three, or all on a line.
    """
    names = {camera.name for camera in cameras}
    points = np.array([click.point for click in clicks], dtype=np.float64).reshape(-1, 3)
    clicked = [{name: np.array(pixel) for name, pixel in click.pixels.items() if name in names} for click in clicks]
    used = [camera for camera in cameras if any(camera.name in pixels for pixels in clicked)]
    _require_spread(points[[bool(pixels) for pixels in clicked]], source)
    start = _start(used, points, clicked, metres_per_unit, source)

    from scipy.optimize import least_squares

    observed = [
        (k, camera, pixels[camera.name]) for camera in used for k, pixels in enumerate(clicked) if camera.name in pixels
    ]
    centre = points.mean(axis=0)
    length = float(np.linalg.norm(points - centre, axis=1).max()) * start.scale
    free = 7 if metres_per_unit is None else 6

    def residuals(step: Floats) -> Floats:
        return _errors(start.moved(step, length), centre, points, observed).ravel()

    if 2 * len(observed) < free:
        raise SplashbenchError(f"{source}: {len(observed)} clicks leave the placement open; click more points")
    solved = least_squares(residuals, np.zeros(free), loss="cauchy", f_scale=_CLICK_PX, x_scale=length)
    singular = np.linalg.svd(solved.jac, compute_uv=False)
    if singular[-1] < 1e-4 * singular[0]:
        raise SplashbenchError(f"{source}: the clicks leave the placement open; click points in more cameras")
    stance = start.moved(solved.x, length)
    pose = np.eye(4)
    pose[:3, :3] = stance.scale * stance.rotation
    pose[:3, 3] = stance.position - pose[:3, :3] @ centre
    errors = np.square(_errors(stance, centre, points, observed)).sum(axis=1)
    of_camera = {camera.name: errors[[other is camera for _, other, _ in observed]] for camera in used}
    upward: Axis = up or "y"
    if up is None and gravity is not None:
        falling = [float(np.dot(stance.rotation @ direction(axis), gravity)) for axis in AXES]
        upward = AXES[int(np.argmin(falling))]
    return Placement(
        pose=pose,
        scale=stance.scale,
        up_axis=upward,
        up=stance.rotation @ direction(upward),
        up_is_ambiguous=False,
        turn="determined",
        equivalent_turns=1,
        cameras=tuple(camera.name for camera in used),
        projections=verify(mesh, pose, used, masks or {}),
        cost_px=float(np.sqrt(errors.mean())),
        point_rms_px={name: float(np.sqrt(squares.mean())) for name, squares in of_camera.items()},
    )


def _require_spread(points: Floats, source: str) -> None:
    if len(points) < 3:
        raise SplashbenchError(
            f"{source}: {len(points)} points are seen by cameras to fit, three are needed; click more"
        )
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[1] <= _LINE * spread[0]:
        raise SplashbenchError(f"{source}: all points lie on a line; click one beside it")


def _errors(stance: Stance, centre: Floats, points: Floats, observed: Sequence[tuple[int, Camera, Floats]]) -> Floats:
    """Distances [N, 2] in pixels of the placed points from their clicks."""
    placed = stance.scale * (points - centre) @ stance.rotation.T + stance.position
    return np.array([camera.project(placed[k : k + 1])[0][0] - pixel for k, camera, pixel in observed])


def _start(
    cameras: Sequence[Camera], points: Floats, clicked: Sequence[Mapping[str, Floats]], scale: float | None, source: str
) -> Stance:
    """The placement to begin with, of the points less their mean."""
    by_name = {camera.name: camera for camera in cameras}
    shared = [k for k, pixels in enumerate(clicked) if len(pixels) >= 2]
    centre = points.mean(axis=0)
    candidates: list[Stance] = []
    if len(shared) >= 3:
        placed = np.array([_triangulated(by_name, clicked[k]) for k in shared])
        for triple in _triples(len(shared)):
            source_points = points[[shared[k] for k in triple]] - centre
            spread = np.linalg.svd(source_points - source_points.mean(axis=0), compute_uv=False)
            if spread[1] > _LINE * spread[0]:
                candidates.append(_aligned(source_points, placed[list(triple)], scale))
        candidates.append(_aligned(points[shared] - centre, placed, scale))
    if scale is not None:
        candidates += [
            candidate
            for camera in cameras
            if (candidate := _from_one_camera(camera, points - centre, clicked, scale)) is not None
        ]
    if not candidates:
        raise SplashbenchError(
            f"{source}: no three points are clicked in two cameras each, nor four in one with the scale known;"
            " click the same points in more cameras"
        )
    observed = [(k, by_name[name], pixel) for k, pixels in enumerate(clicked) for name, pixel in pixels.items()]

    def typical_error(candidate: Stance) -> float:
        errors = np.linalg.norm(_errors(candidate, centre, points, observed), axis=1)
        return float(np.median(errors) + 1e-3 * np.mean(np.minimum(errors, 1e3)))

    return min(candidates, key=typical_error)


def _triples(n: int) -> list[tuple[int, ...]]:
    """Every three of n, or evenly spaced ones of them where there are too many."""
    count = n * (n - 1) * (n - 2) // 6
    if count <= _MAX_TRIPLES:
        return list(combinations(range(n), 3))
    rng = np.random.default_rng(0)
    return [tuple(rng.choice(n, 3, replace=False).tolist()) for _ in range(_MAX_TRIPLES)]


def _triangulated(cameras: Mapping[str, Camera], pixels: Mapping[str, Floats]) -> Floats:
    rays = [np.linalg.solve(cameras[name].K, np.append(pixel, 1.0))[:2] for name, pixel in pixels.items()]
    return triangulate(np.array(rays), np.array([cameras[name].w2c for name in pixels]))


def _aligned(points: Floats, placed: Floats, scale: float | None) -> Stance:
    similarity = umeyama(points, placed)
    # The best rotation does not depend on the scale.
    size = similarity.scale if scale is None else scale
    return Stance(size, similarity.rotation, placed.mean(axis=0) - size * similarity.rotation @ points.mean(axis=0))


def _from_one_camera(
    camera: Camera, points: Floats, clicked: Sequence[Mapping[str, Floats]], scale: float
) -> Stance | None:
    """From four or more clicks in one image (SQPnP, Terzakis and Lourakis, ECCV 2020)."""
    import cv2

    chosen = [k for k, pixels in enumerate(clicked) if camera.name in pixels]
    if len(chosen) < 4:
        return None
    pixels = np.array([clicked[k][camera.name] for k in chosen])
    try:
        solved, turn, shift = cv2.solvePnP(scale * points[chosen], pixels, camera.K, None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:
        return None
    if not solved:
        return None
    back = camera.w2c[:3, :3].T
    return Stance(scale, back @ cv2.Rodrigues(turn)[0], back @ (shift.ravel() - camera.w2c[:3, 3]))

"""Fitting a mesh's outlines to those of masks in several posed cameras.

Gauss-Newton steps move the mesh until its rendered outlines meet the masks'. Each outline point is paired with the
nearest of the other outline, in both directions, as in iterative closest points (Besl and McKay, IEEE TPAMI 14(2),
1992). It counts by its distance along the normal. The point of the surface that makes an outline point comes from the
rendered depth. The surface is seen edge-on there, so its sliding over the mesh changes no normal distance to first
order. Tukey's weights discard what has no counterpart: a hand before the container, a mask with a piece missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splashbench.arrays import Floats
from splashbench.container.contours import find_contour
from splashbench.container.mask_views import MaskView
from splashbench.container.stance import Axis, Stance, direction
from splashbench.scene.container import ContainerMesh

# Pairs of outline points whose normals differ by more than 60 degrees belong to different edges.
_SAME_EDGE_COSINE = 0.5
# Tukey's constant in standard deviations, and the least in pixels, so that quantisation alone discards nothing.
_TUKEY = 4.685
_LEAST_TUKEY_PX = 2.0
# Damping as a share of the mean curvature: what the outlines leave open (a bowl's turn) stays as it is.
_DAMPING = 1e-3
# Gauss-Newton ends where the outlines move by less than this many pixels on average.
_STILL_PX = 0.01


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Outline points of one view in pairs: signed normal distances [N] in pixels and their slopes [N, 7]."""

    residuals: Floats
    slopes: Floats
    n_rendered: int  # points of the rendered outline and of the mask's, those without a partner as well
    n_mask: int


def _pairs(view: MaskView, mesh: ContainerMesh, stance: Stance, length: float, reach: float) -> _Pairs:
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
    paired = (np.concatenate([forth_gap, back_gap]) <= reach) & (cosine >= _SAME_EDGE_COSINE)
    pixels, z = rendered.points, _depth_inside(depth, rendered.points)
    paired &= np.isfinite(z[of_rendered])
    of_rendered, of_mask, normal = of_rendered[paired], of_mask[paired], normal[paired]
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


def _depth_inside(depth: NDArray[np.float32], points: Floats) -> Floats:
    """Depth [N] of the surface at outline points, from the silhouette's pixels next to them."""
    import cv2

    nearest = cv2.erode(depth, np.ones((3, 3), np.uint8))
    column, row = np.floor(points).astype(int).T
    values = nearest[np.clip(row, 0, depth.shape[0] - 1), np.clip(column, 0, depth.shape[1] - 1)]
    return values.astype(np.float64)


@dataclass(frozen=True, eq=False)
class OutlineFit:
    """A stance and how well its outlines meet the masks'.

    cost: RMS distance of outline points in pixels of the working resolution, none counted beyond `reach`.
    curvatures [V, 7, 7] and slopes [V, 7]: the normal equations of each view at the stance.
    """

    stance: Stance
    cost: float
    curvatures: Floats
    slopes: Floats


def refine(
    mesh: ContainerMesh,
    views: Sequence[MaskView],
    stance: Stance,
    free: Sequence[int],
    length: float,
    reach: float,
    steps: int,
    axis: Floats | None = None,
) -> OutlineFit:
    """Gauss-Newton from `stance`; the best of all stances on the way.

    free: which of position (0..2), rotation (3..5) and scale (6) may change. axis: unit vector [3] about which the
    mesh must not turn. length: scene units over which rotation is measured. reach: pixels within which outlines are
    paired.
    """
    best: OutlineFit | None = None
    columns = np.array(free)
    for _ in range(steps + 1):
        pairs = [_pairs(view, mesh, stance, length, reach) for view in views]
        fit = _normal_equations(stance, pairs, reach)
        if best is None or fit.cost < best.cost:
            best = fit
        curvature, slope = fit.curvatures.sum(axis=0)[np.ix_(columns, columns)], fit.slopes.sum(axis=0)[columns]
        mean = float(np.trace(curvature)) / len(columns)
        if mean <= 0:
            break
        damped = curvature + _DAMPING * mean * np.eye(len(columns))
        if axis is not None:
            turn = np.zeros(7)
            turn[3:6] = axis
            damped += 1e6 * mean * np.outer(turn, turn)[np.ix_(columns, columns)]
        step = np.zeros(7)
        step[columns] = -np.linalg.solve(damped, slope)
        # Never further than outlines were paired.
        step *= min(1.0, 0.3 * length / max(float(np.linalg.norm(step[:6])), 1e-12))
        moved = float(np.sqrt(np.mean([np.mean((p.slopes @ step) ** 2) for p in pairs if len(p.slopes)])))
        stance = stance.moved(step if 6 in free else step[:6], length)
        if moved < _STILL_PX:
            break
    assert best is not None  # the loop runs at least once
    return best


def _normal_equations(stance: Stance, per_view: Sequence[_Pairs], reach: float) -> OutlineFit:
    """Weighted by Tukey's function of the residuals, whose scale is robust too."""
    residuals = np.concatenate([pairs.residuals for pairs in per_view])
    total = sum(pairs.n_rendered + pairs.n_mask for pairs in per_view)
    if not len(residuals):
        return OutlineFit(stance, np.inf, np.zeros((len(per_view), 7, 7)), np.zeros((len(per_view), 7)))
    deviation = 1.4826 * float(np.median(np.abs(residuals)))
    limit = min(max(_TUKEY * deviation, _LEAST_TUKEY_PX), reach)
    curvatures, slopes = [], []
    for pairs in per_view:
        weight = np.square(np.clip(1 - np.square(pairs.residuals / limit), 0.0, None))
        weighted = pairs.slopes * weight[:, None]
        curvatures.append(weighted.T @ pairs.slopes)
        slopes.append(weighted.T @ pairs.residuals)
    unpaired = total - len(residuals)
    squares = float(np.square(np.minimum(np.abs(residuals), reach)).sum()) + unpaired * reach**2
    return OutlineFit(stance, float(np.sqrt(squares / total)), np.array(curvatures), np.array(slopes))


def jackknife(fit: OutlineFit, free: Sequence[int], length: float, axis: Axis) -> tuple[float | None, float | None]:
    """Sigmas of the centre (scene units) and of the vertical axis (degrees) from leaving out one camera at a time.

    One Gauss-Newton step each (Efron's jackknife): unlike the curvature alone it knows that the errors of
    neighbouring points of an outline, and of a whole mask, go together.
    """
    n = len(fit.curvatures)
    if n < 3:
        return None, None
    columns = np.array(free)
    curvature, slope = fit.curvatures.sum(axis=0), fit.slopes.sum(axis=0)
    steps = np.zeros((n, 7))
    for k in range(n):
        rest = (curvature - fit.curvatures[k])[np.ix_(columns, columns)]
        # What the outlines do not say has no sigma: leave it where it is.
        steps[k, columns] = -np.linalg.pinv(rest, rcond=1e-4, hermitian=True) @ (slope - fit.slopes[k])[columns]
    covariance = (n - 1) / n * (steps - steps.mean(axis=0)).T @ (steps - steps.mean(axis=0))
    vertical = fit.stance.rotation @ direction(axis)
    across = np.eye(3) - np.outer(vertical, vertical)
    tilt = across @ covariance[3:6, 3:6] @ across / length**2
    return float(np.sqrt(np.trace(covariance[:3, :3]))), float(np.rad2deg(np.sqrt(np.trace(tilt))))

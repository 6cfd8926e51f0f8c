"""Gaussians in the scene to ellipses in the image, and the gradients back (EWA splatting, gsplat's conventions).

A Gaussian with mean m and covariance S seen by a camera (R, t, K) falls on the pixel K (R m + t), with the covariance
J R S R^T J^T + blur, J being the Jacobian of the pinhole projection at the (clamped) mean. What compositing needs of it
is one row of a table, the columns below; log2 alpha at an offset (dx, dy) from the centre is the quadratic form
L + A dx^2 + B dx dy + C dy^2.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from splashbench.render.constants import BLUR_VARIANCE, JACOBIAN_MARGIN, LOG2_MIN_ALPHA, MIN_ALPHA, NEAR_PLANE

# Columns of the splat table, float32 [N, SPLAT_COLUMNS].
X, Y = 0, 1  # centre, px
A, B, C = 2, 3, 4  # quadratic form of log2 alpha, 1 / px^2
LOG2_OPACITY = 5
RED, GREEN, BLUE = 6, 7, 8
HALF_HEIGHT = 9  # the ellipse alpha = MIN_ALPHA reaches this far above and below the centre, px
SLOPE = 10  # the middle of the ellipse moves this many columns per row
ROW_SCALE, ROW_FALL = 11, 12  # squared half-width of row dy is ROW_SCALE - ROW_FALL dy^2, px^2
HALF_WIDTH = 13
SPLAT_COLUMNS = 16

Scalar = Any  # a float32 in compiled code, which Python's types cannot say
Vector = tuple[Scalar, Scalar, Scalar]

_LOG2_E = np.float32(1.0 / math.log(2.0))
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)
_BLUR = np.float32(BLUR_VARIANCE)
_NEAR = np.float32(NEAR_PLANE)
_MIN_ALPHA = np.float32(MIN_ALPHA)
_LOG2_MIN_ALPHA = np.float32(LOG2_MIN_ALPHA)


def camera_row(K: np.ndarray, w2c: np.ndarray, width: int, height: int) -> np.ndarray:
    """A camera as the kernels read it, float32 [20]: R row by row, t, fx, fy, cx, cy, and the clamp of x/z and y/z."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = JACOBIAN_MARGIN * width / fx, JACOBIAN_MARGIN * height / fy
    clamp = (-cx / fx - margin_x, (width - cx) / fx + margin_x, -cy / fy - margin_y, (height - cy) / fy + margin_y)
    return np.concatenate([w2c[:3, :3].ravel(), w2c[:3, 3], (fx, fy, cx, cy), clamp]).astype(np.float32)


@numba.njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _linearise(camera: np.ndarray, x: Scalar, y: Scalar, z: Scalar) -> tuple[Vector, Vector, Scalar, Scalar, Scalar]:
    """Rows a, b of J R [3] each, 1 / z, and the clamped x/z and y/z at which J is taken."""
    inverse_z = _ONE / z
    tx = min(max(x * inverse_z, camera[16]), camera[17])
    ty = min(max(y * inverse_z, camera[18]), camera[19])
    jx, jxz = camera[12] * inverse_z, -camera[12] * tx * inverse_z
    jy, jyz = camera[13] * inverse_z, -camera[13] * ty * inverse_z
    a = (jx * camera[0] + jxz * camera[6], jx * camera[1] + jxz * camera[7], jx * camera[2] + jxz * camera[8])
    b = (jy * camera[3] + jyz * camera[6], jy * camera[4] + jyz * camera[7], jy * camera[5] + jyz * camera[8])
    return a, b, inverse_z, tx, ty


@numba.njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _times(S: np.ndarray, v: Vector) -> Vector:
    """S v for the covariance S [3, 3]."""
    return (
        S[0, 0] * v[0] + S[0, 1] * v[1] + S[0, 2] * v[2],
        S[1, 0] * v[0] + S[1, 1] * v[1] + S[1, 2] * v[2],
        S[2, 0] * v[0] + S[2, 1] * v[1] + S[2, 2] * v[2],
    )


@numba.njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _dot(a: Vector, b: Vector) -> Scalar:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def project(
    means: np.ndarray,
    covariances: np.ndarray,
    opacities: np.ndarray,
    colors: np.ndarray,
    camera: np.ndarray,
    width: int,
    height: int,
    start: int,
    stop: int,
    splats: np.ndarray,
    depths: np.ndarray,
) -> None:
    """Fill rows [start, stop) of `splats` [N, SPLAT_COLUMNS] and `depths` [N]; a depth of -1 means not drawn.

    Not drawn are Gaussians nearer than the near plane, fainter than one grey level, wholly outside the image, with a
    projected covariance that is not positive, or with an entry that is not finite.
    """
    for i in range(start, stop):
        depths[i] = -_ONE
        m, S, opacity = means[i], covariances[i], opacities[i]
        total = m[0] + m[1] + m[2] + opacity + colors[i, 0] + colors[i, 1] + colors[i, 2]
        for row in range(3):
            total += S[row, 0] + S[row, 1] + S[row, 2]
        if not math.isfinite(total) or opacity < _MIN_ALPHA:
            continue
        x = camera[0] * m[0] + camera[1] * m[1] + camera[2] * m[2] + camera[9]
        y = camera[3] * m[0] + camera[4] * m[1] + camera[5] * m[2] + camera[10]
        z = camera[6] * m[0] + camera[7] * m[1] + camera[8] * m[2] + camera[11]
        if z < _NEAR:
            continue
        a, b, inverse_z, _, _ = _linearise(camera, x, y, z)
        Sa, Sb = _times(S, a), _times(S, b)
        xx, xy, yy = _dot(a, Sa) + _BLUR, _dot(a, Sb), _dot(b, Sb) + _BLUR
        determinant = xx * yy - xy * xy
        # Beyond these bounds float32 has no digits left for the quadratic form.
        if not (determinant > _ZERO and xx > _ZERO and xx < np.float32(1e12) and yy < np.float32(1e12)):
            continue
        u, v = camera[12] * x * inverse_z + camera[14], camera[13] * y * inverse_z + camera[15]
        log2_opacity = np.float32(math.log2(opacity))
        # At the edge of the footprint log2 alpha is LOG2_MIN_ALPHA: d^T inverse(covariance) d = reach.
        reach = np.float32(2.0) / _LOG2_E * (log2_opacity - _LOG2_MIN_ALPHA)
        half_width, half_height = math.sqrt(reach * xx), math.sqrt(reach * yy)
        if u + half_width <= _ZERO or u - half_width >= width or v + half_height <= _ZERO or v - half_height >= height:
            continue
        s = splats[i]
        s[X], s[Y] = u, v
        s[A] = -_HALF * _LOG2_E * yy / determinant
        s[B] = _LOG2_E * xy / determinant
        s[C] = -_HALF * _LOG2_E * xx / determinant
        s[LOG2_OPACITY] = log2_opacity
        s[RED], s[GREEN], s[BLUE] = colors[i, 0], colors[i, 1], colors[i, 2]
        s[HALF_HEIGHT], s[HALF_WIDTH] = half_height, half_width
        s[SLOPE] = xy / yy
        s[ROW_SCALE], s[ROW_FALL] = reach * determinant / yy, determinant / (yy * yy)
        depths[i] = z


@numba.njit(nogil=True, cache=True, error_model="numpy")
def project_backward(
    means: np.ndarray,
    covariances: np.ndarray,
    opacities: np.ndarray,
    camera: np.ndarray,
    ids: np.ndarray,
    splats: np.ndarray,
    slots: np.ndarray,
    slot_starts: np.ndarray,
    start: int,
    stop: int,
    grad_means: np.ndarray,
    grad_covariances: np.ndarray,
    grad_opacities: np.ndarray,
    grad_colors: np.ndarray,
) -> None:
    """Sum each splat's slots over the tiles, in order, and carry the sums back to the Gaussian it came from.

    `slots` [S, 9] holds, per (splat, tile), with s = alpha dL/dalpha and (dx, dy) the pixel's offset from the centre,
    the sums of s, s dx, s dy, s dx^2, s dx dy, s dy^2 and the three colour gradients.
    """
    sums = np.empty(9, np.float32)
    for k in range(start, stop):
        if slot_starts[k] == slot_starts[k + 1]:
            continue
        sums[:] = _ZERO
        for slot in range(slot_starts[k], slot_starts[k + 1]):
            for j in range(9):
                sums[j] += slots[slot, j]
        i, s = ids[k], splats[k]
        grad_colors[i, 0], grad_colors[i, 1], grad_colors[i, 2] = sums[6], sums[7], sums[8]
        grad_opacities[i] = sums[0] / opacities[i]
        # The conic Q is the inverse of the projected covariance: log2 alpha = L - log2(e) d^T Q d / 2.
        ln2 = _ONE / _LOG2_E
        qa, qb, qc = -np.float32(2.0) * ln2 * s[A], -ln2 * s[B], -np.float32(2.0) * ln2 * s[C]
        grad_u, grad_v = qa * sums[1] + qb * sums[2], qb * sums[1] + qc * sums[2]
        # dL/dQ is -1/2 sum of s d d^T; the gradient of an inverse gives dL/dcovariance = -Q (dL/dQ) Q.
        ga, gb, gc = _HALF * sums[3], _HALF * sums[4], _HALF * sums[5]
        p, q, r, t = qa * ga + qb * gb, qa * gb + qb * gc, qb * ga + qc * gb, qb * gb + qc * gc
        gxx, gxy, gyy = p * qa + q * qb, p * qb + q * qc, r * qb + t * qc
        m, S = means[i], covariances[i]
        x = camera[0] * m[0] + camera[1] * m[1] + camera[2] * m[2] + camera[9]
        y = camera[3] * m[0] + camera[4] * m[1] + camera[5] * m[2] + camera[10]
        z = camera[6] * m[0] + camera[7] * m[1] + camera[8] * m[2] + camera[11]
        a, b, inverse_z, tx, ty = _linearise(camera, x, y, z)
        Sa, Sb = _times(S, a), _times(S, b)
        two = np.float32(2.0)
        for row in range(3):
            for column in range(3):
                grad_covariances[i, row, column] = (
                    gxx * a[row] * a[column]
                    + gxy * (a[row] * b[column] + b[row] * a[column])
                    + gyy * b[row] * b[column]
                )
        grad_a = (
            two * (gxx * Sa[0] + gxy * Sb[0]), two * (gxx * Sa[1] + gxy * Sb[1]), two * (gxx * Sa[2] + gxy * Sb[2]),
        )  # fmt: skip
        grad_b = (
            two * (gxy * Sa[0] + gyy * Sb[0]), two * (gxy * Sa[1] + gyy * Sb[1]), two * (gxy * Sa[2] + gyy * Sb[2]),
        )  # fmt: skip
        right, down, forward = (
            (camera[0], camera[1], camera[2]), (camera[3], camera[4], camera[5]), (camera[6], camera[7], camera[8]),
        )  # fmt: skip
        # J = [[fx/z, 0, -fx tx/z], [0, fy/z, -fy ty/z]], with tx = x/z and ty = y/z unless clamped.
        fx_z, fy_z = camera[12] * inverse_z, camera[13] * inverse_z
        grad_jx, grad_jxz = _dot(grad_a, right), _dot(grad_a, forward)
        grad_jy, grad_jyz = _dot(grad_b, down), _dot(grad_b, forward)
        grad_x, grad_y = fx_z * grad_u, fy_z * grad_v
        grad_z = -inverse_z * (grad_x * x + grad_y * y)
        grad_z += inverse_z * (fx_z * (tx * grad_jxz - grad_jx) + fy_z * (ty * grad_jyz - grad_jy))
        if tx == x * inverse_z:
            grad_x -= fx_z * inverse_z * grad_jxz
            grad_z += fx_z * inverse_z * tx * grad_jxz
        if ty == y * inverse_z:
            grad_y -= fy_z * inverse_z * grad_jyz
            grad_z += fy_z * inverse_z * ty * grad_jyz
        for j in range(3):
            grad_means[i, j] = right[j] * grad_x + down[j] * grad_y + forward[j] * grad_z

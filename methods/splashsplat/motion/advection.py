"""Forecast and correction of carriers (paper, Eqs. carrier_forecast and sdf_correction).

Positions are transport-grid coordinates, distances transport voxels, velocities voxels per frame.
"""

from __future__ import annotations

import numba
import numpy as np

from splashbench.parallel import over_range

from .velocity import Factor, factors, velocity_at

MIN_STRETCH, MAX_STRETCH = 1 / 3, 3.0
_SMALL_LOOP = 1024
# Of Jacobi's method, at the most; three by three they are done after five or six.
_SWEEPS = 12
# Squared singular values below this share of the largest are lost in the rounding of F^T F.
_FLAT = 1e-9


@numba.njit(cache=True, error_model="numpy", inline="always")
def _midpoint(
    control: np.ndarray, factor: tuple[float, float, float], x: float, y: float, z: float, duration: float
) -> tuple[float, float, float]:
    """The velocity half a `duration` after (x, y, z)."""
    u, v, w = velocity_at(control, factor, x, y, z)
    half = 0.5 * duration
    return velocity_at(control, factor, x + half * u, y + half * v, z + half * w)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _moved(
    control: np.ndarray,
    factor: tuple[float, float, float],
    positions: np.ndarray,
    duration: float,
    moved: np.ndarray,
    start: int,
    stop: int,
) -> None:
    for n in range(start, stop):
        x, y, z = float(positions[n, 0]), float(positions[n, 1]), float(positions[n, 2])
        u, v, w = _midpoint(control, factor, x, y, z, duration)
        moved[n, 0] = x + duration * u
        moved[n, 1] = y + duration * v
        moved[n, 2] = z + duration * w


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _forecast(
    control: np.ndarray,
    factor: tuple[float, float, float],
    positions: np.ndarray,
    deformation: np.ndarray,
    duration: float,
    moved: np.ndarray,
    deformed: np.ndarray,
    start: int,
    stop: int,
) -> None:
    for n in range(start, stop):
        x, y, z = float(positions[n, 0]), float(positions[n, 1]), float(positions[n, 2])
        u, v, w = _midpoint(control, factor, x, y, z, duration)
        moved[n, 0] = x + duration * u
        moved[n, 1] = y + duration * v
        moved[n, 2] = z + duration * w
        gradient = np.empty((3, 3))
        for b in range(3):
            dx, dy, dz = 1.0 * (b == 0), 1.0 * (b == 1), 1.0 * (b == 2)
            high = velocity_at(control, factor, x + dx, y + dy, z + dz)
            low = velocity_at(control, factor, x - dx, y - dy, z - dz)
            gradient[0, b] = 0.5 * (high[0] - low[0])
            gradient[1, b] = 0.5 * (high[1] - low[1])
            gradient[2, b] = 0.5 * (high[2] - low[2])
        for a in range(3):
            for b in range(3):
                value = float(deformation[n, a, b])
                for c in range(3):
                    value += duration * gradient[a, c] * deformation[n, c, b]
                deformed[n, a, b] = value


@numba.njit(cache=True, error_model="numpy")
def _diagonalised(a: np.ndarray, v: np.ndarray) -> None:
    """Jacobi's method: the symmetric `a` [3, 3] becomes diagonal, and `v` [3, 3] has its eigenvectors; in place."""
    for i in range(3):
        for j in range(3):
            v[i, j] = 1.0 if i == j else 0.0
    for _ in range(_SWEEPS):
        if abs(a[0, 1]) + abs(a[0, 2]) + abs(a[1, 2]) == 0.0:
            return
        for p, q in ((0, 1), (0, 2), (1, 2)):
            if a[p, q] == 0.0:
                continue
            theta = 0.5 * (a[q, q] - a[p, p]) / a[p, q]
            t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
            t = -t if theta < 0 else t
            c = 1.0 / np.sqrt(t * t + 1.0)
            s = t * c
            for k in range(3):
                a[k, p], a[k, q] = c * a[k, p] - s * a[k, q], s * a[k, p] + c * a[k, q]
            for k in range(3):
                a[p, k], a[q, k] = c * a[p, k] - s * a[q, k], s * a[p, k] + c * a[q, k]
            a[p, q] = a[q, p] = 0.0
            for k in range(3):
                v[k, p], v[k, q] = c * v[k, p] - s * v[k, q], s * v[k, p] + c * v[k, q]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _clamp(deformation: np.ndarray, flat: np.ndarray, start: int, stop: int) -> None:
    """Clamps singular values to [1/3, 3], in place; flat: bool, of those that are so flat that this does not do."""
    F, a, v, between = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    share = np.empty(3)
    for n in range(start, stop):
        for i in range(3):
            for j in range(3):
                F[i, j] = deformation[n, i, j]
        square = 0.0
        for i in range(3):
            for j in range(3):
                square += F[i, j] * F[i, j]
        det = (
            F[0, 0] * (F[1, 1] * F[2, 2] - F[1, 2] * F[2, 1])
            - F[0, 1] * (F[1, 0] * F[2, 2] - F[1, 2] * F[2, 0])
            + F[0, 2] * (F[1, 0] * F[2, 1] - F[1, 1] * F[2, 0])
        )
        # The largest singular value is at most |F|, the smallest at least 2 |det F| / |F|^2, as the product of the
        # other two is at most |F|^2 / 2: most carriers need no decomposition.
        if 0 < square <= MAX_STRETCH**2 and 2 * abs(det) >= MIN_STRETCH * square:
            continue
        for i in range(3):
            for j in range(3):
                a[i, j] = 0.0
                for k in range(3):
                    a[i, j] += F[k, i] * F[k, j]
        _diagonalised(a, v)
        least, most = min(a[0, 0], a[1, 1], a[2, 2]), max(a[0, 0], a[1, 1], a[2, 2])
        if least >= MIN_STRETCH**2 and most <= MAX_STRETCH**2:
            continue
        if not least > _FLAT * most:
            flat[n] = True
            continue
        # F = U S V^T: F V diag(clamped / S) V^T has the clamped values in place of S.
        for i in range(3):
            stretch = np.sqrt(a[i, i])
            share[i] = min(max(stretch, MIN_STRETCH), MAX_STRETCH) / stretch
        for i in range(3):
            for j in range(3):
                between[i, j] = 0.0
                for k in range(3):
                    between[i, j] += v[i, k] * share[k] * v[j, k]
        for i in range(3):
            for j in range(3):
                deformation[n, i, j] = F[i, 0] * between[0, j] + F[i, 1] * between[1, j] + F[i, 2] * between[2, j]


def clamp_stretch(deformation: np.ndarray) -> np.ndarray:
    """Deformation gradients [N, 3, 3] with their singular values clamped to [1/3, 3], float32."""
    clamped = np.array(deformation, dtype=np.float32, order="C")
    flat = np.zeros(len(clamped), dtype=bool)
    over_range(_clamp, len(clamped), clamped, flat, smallest=_SMALL_LOOP)
    if flat.any():
        left, stretch, right = np.linalg.svd(clamped[flat])
        clamped[flat] = (left * np.clip(stretch, MIN_STRETCH, MAX_STRETCH)[:, None, :]) @ right
    return clamped


def moved(control: np.ndarray, factor: Factor, positions: np.ndarray, duration: float = 1.0) -> np.ndarray:
    """Positions [N, 3] of `forecast`, float32, without F, which takes most of its time."""
    positions = np.ascontiguousarray(positions, np.float32)
    ends = np.empty_like(positions)
    fixed = (np.ascontiguousarray(control, np.float32), factors(factor), positions, float(duration))
    over_range(_moved, len(positions), *fixed, ends, smallest=_SMALL_LOOP)
    return ends


def forecast(
    control: np.ndarray, factor: Factor, positions: np.ndarray, deformation: np.ndarray, duration: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Positions [N, 3] by midpoint RK2 and F by (I + duration grad u) F, singular values clamped.

    control, factor: see velocity.py. duration: in frames; a fraction gives the state between two frames.
    """
    positions = np.ascontiguousarray(positions, np.float32)
    deformation = np.ascontiguousarray(deformation, np.float32)
    moved, deformed = np.empty_like(positions), np.empty_like(deformation)
    fixed = (np.ascontiguousarray(control, np.float32), factors(factor), positions, deformation, float(duration))
    over_range(_forecast, len(positions), *fixed, moved, deformed, smallest=_SMALL_LOOP)
    return moved, clamp_stretch(deformed)

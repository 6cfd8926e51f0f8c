"""The coarse velocity field u_t between two observations (paper, Eq. velocity_fit and "Observed motion").

Minimises sum over the narrow band of (phi[t+1](q) - phi[t](q - u(q)))^2 by residual descent on a control grid. Each
step: per-node Gauss-Newton displacement, averaged per control cell, Gaussian-smoothed, blended with its
divergence-free projection, clipped. Lengths are in transport voxels and velocities in voxels per frame, whatever the
frame lasts.

The paper smooths the field after each step, which shrinks it towards zero the more, the wider the Gaussian; smoothing
the update only was measured to carry farther, and is the default. Its width is given in voxels, and of which grid is
open: the band and the bound in the same sentence are in transport voxels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numba
import numpy as np
from scipy import fft
from scipy.ndimage import gaussian_filter

from splashbench.parallel import over_range

from ..kernel.descend import Descent

_SMALL_LOOP = 1024

#: Transport voxels per control cell: one number, or one along each axis where the cells are no cubes.
Factor = int | tuple[float, float, float]


@dataclass(frozen=True)
class VelocitySettings:
    """Settings of the fit; the defaults are the paper's, except `smooth` and `smoothing_unit`, whose voxels `smoothing`
    is in: the "control" grid's cells or "transport" voxels."""

    steps: int = 35
    step_size: float = 0.45
    band: float = 4.0
    smoothing: float = 0.6
    smooth: Literal["update", "field"] = "update"
    smoothing_unit: Literal["control", "transport"] = "control"
    projection_blend: float = 0.35
    limit: float = 8.0


def factors(factor: Factor) -> tuple[float, float, float]:
    """Transport voxels per control cell along each axis."""
    if isinstance(factor, tuple):
        return factor
    return float(factor), float(factor), float(factor)


def control_shape(shape: tuple[int, int, int], factor: Factor) -> tuple[int, int, int]:
    """Shape of the control grid whose cells are `factor` voxels of a transport grid of `shape`."""
    nx, ny, nz = (max(math.ceil(n / f - 1e-6), 2) for n, f in zip(shape, factors(factor)))
    return nx, ny, nz


def factor_of_sides(shape: tuple[int, int, int], cells: int) -> Factor:
    """The factor with `cells` control cells along every side of a transport grid of `shape`, none below a voxel."""
    fx, fy, fz = (max(n / cells, 1.0) for n in shape)
    return fx, fy, fz


def cell_numbers(nodes: np.ndarray, factor: Factor, coarse: tuple[int, int, int]) -> np.ndarray:
    """Number of the control cell of each transport node [N, 3], int64 [N], on a control grid of shape `coarse`."""
    cells = np.floor((nodes + 0.5) / np.array(factors(factor))).astype(np.int64)
    return np.asarray(np.ravel_multi_index(tuple(np.minimum(cells, np.array(coarse) - 1).T), coarse))


@numba.njit(cache=True, error_model="numpy", inline="always")
def _locate(shape: tuple[int, ...], x: float, y: float, z: float) -> tuple[int, int, int, float, float, float]:
    """Cell (i, j, k) holding (x, y, z), clamped to the grid, and the fractions within it."""
    x = min(max(x, 0.0), shape[0] - 1.0)
    y = min(max(y, 0.0), shape[1] - 1.0)
    z = min(max(z, 0.0), shape[2] - 1.0)
    i, j, k = min(int(x), shape[0] - 2), min(int(y), shape[1] - 2), min(int(z), shape[2] - 2)
    return i, j, k, x - i, y - j, z - k


@numba.njit(cache=True, error_model="numpy")
def velocity_at(
    control: np.ndarray, factor: tuple[float, float, float], x: float, y: float, z: float
) -> tuple[float, float, float]:
    """u at transport-grid coordinates (x, y, z); control: [cx, cy, cz, 3], nodes at the middles of their cells.

    factor: transport voxels per control cell along each axis.
    """
    fx, fy, fz = factor
    i, j, k, a, b, c = _locate(
        control.shape, (x - 0.5 * (fx - 1)) / fx, (y - 0.5 * (fy - 1)) / fy, (z - 0.5 * (fz - 1)) / fz
    )
    u, v, w = 0.0, 0.0, 0.0
    for di in range(2):
        wi = a if di else 1 - a
        for dj in range(2):
            wj = wi * (b if dj else 1 - b)
            for dk in range(2):
                weight = wj * (c if dk else 1 - c)
                u += weight * control[i + di, j + dj, k + dk, 0]
                v += weight * control[i + di, j + dj, k + dk, 1]
                w += weight * control[i + di, j + dj, k + dk, 2]
    return u, v, w


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _velocities_at(
    control: np.ndarray,
    factor: tuple[float, float, float],
    positions: np.ndarray,
    velocities: np.ndarray,
    start: int,
    stop: int,
) -> None:
    for n in range(start, stop):
        u, v, w = velocity_at(control, factor, positions[n, 0], positions[n, 1], positions[n, 2])
        velocities[n, 0], velocities[n, 1], velocities[n, 2] = u, v, w


def velocities_at(control: np.ndarray, factor: Factor, positions: np.ndarray) -> np.ndarray:
    """u at transport-grid `positions` [N, 3], float64 [N, 3], voxels per frame; control: see `velocity_at`."""
    velocities = np.empty((len(positions), 3))
    control, positions = np.ascontiguousarray(control, np.float32), np.ascontiguousarray(positions, np.float64)
    fixed = (control, factors(factor), positions)
    over_range(_velocities_at, len(positions), *fixed, velocities, smallest=_SMALL_LOOP)
    return velocities


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _with_gradient(phi: np.ndarray, beside: np.ndarray, start: int, stop: int) -> None:
    last = (phi.shape[0] - 1, phi.shape[1] - 1, phi.shape[2] - 1)
    for i in range(start, stop):
        left, right = max(i - 1, 0), min(i + 1, last[0])
        for j in range(phi.shape[1]):
            front, back = max(j - 1, 0), min(j + 1, last[1])
            for k in range(phi.shape[2]):
                under, above = max(k - 1, 0), min(k + 1, last[2])
                beside[i, j, k, 0] = phi[i, j, k]
                beside[i, j, k, 1] = (phi[right, j, k] - phi[left, j, k]) / np.float32(right - left)
                beside[i, j, k, 2] = (phi[i, back, k] - phi[i, front, k]) / np.float32(back - front)
                beside[i, j, k, 3] = (phi[i, j, above] - phi[i, j, under]) / np.float32(above - under)


def with_gradient(phi: np.ndarray) -> np.ndarray:
    """`phi` and its central differences side by side, one-sided at the faces of the grid: float32 [nx, ny, nz, 4]."""
    beside = np.empty((*phi.shape, 4), np.float32)
    over_range(_with_gradient, phi.shape[0], np.ascontiguousarray(phi, np.float32), beside)
    return beside


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _count_band(
    before: np.ndarray,
    after: np.ndarray,
    band: float,
    cells: tuple[np.ndarray, np.ndarray, np.ndarray],
    counts: np.ndarray,
) -> None:
    for i in range(before.shape[0]):
        for j in range(before.shape[1]):
            row = counts[cells[0][i], cells[1][j]]
            for k in range(before.shape[2]):
                if abs(before[i, j, k]) < band or abs(after[i, j, k]) < band:
                    row[cells[2][k]] += 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _collect_band(
    before: np.ndarray,
    after: np.ndarray,
    band: float,
    cells: tuple[np.ndarray, np.ndarray, np.ndarray],
    places: np.ndarray,
    nodes: np.ndarray,
) -> None:
    for i in range(before.shape[0]):
        for j in range(before.shape[1]):
            row = places[cells[0][i], cells[1][j]]
            for k in range(before.shape[2]):
                if abs(before[i, j, k]) < band or abs(after[i, j, k]) < band:
                    place = row[cells[2][k]]
                    nodes[place, 0], nodes[place, 1], nodes[place, 2] = i, j, k
                    row[cells[2][k]] = place + 1


def band_nodes(
    before: np.ndarray, after: np.ndarray, band: float, factor: Factor, coarse: tuple[int, int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Nodes within `band` voxels of the surface before or after, int32 [M, 3] by control cell of a grid of shape
    `coarse`, and int64 [C + 1]: of cell c they are from the c-th of these to the next."""
    cells = tuple(
        np.minimum(np.floor((np.arange(n) + 0.5) / width).astype(np.int64), top - 1)
        for n, width, top in zip(before.shape, factors(factor), coarse)
    )
    counts = np.zeros(coarse, np.int64)
    _count_band(before, after, band, cells, counts)
    starts = np.concatenate([[0], np.cumsum(counts)])
    nodes = np.empty((int(starts[-1]), 3), np.int32)
    _collect_band(before, after, band, cells, starts[:-1].reshape(coarse).copy(), nodes)
    return nodes, starts


class DivergenceFree:
    """Projection of fields [nx, ny, nz, 3] onto divergence-free ones, by Fourier transform with zero padding.

    The symbol is that of the central difference, so it is this discrete divergence that vanishes; spacing: of the
    nodes along each axis. Padding by half the size keeps opposite faces from seeing each other: twice the size takes
    twice as long, and changes velocities by less than a step of their fit does. Axis by axis, most of the padding need
    not be transformed.
    """

    def __init__(self, shape: tuple[int, int, int], spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> None:
        self.shape = shape
        self.padded = tuple(fft.next_fast_len(n + -(-n // 2), real=True) for n in shape)
        px, py, pz = self.padded
        waves = (np.fft.fftfreq(px)[:, None, None], np.fft.fftfreq(py)[:, None], np.fft.rfftfreq(pz))
        relative = [width / min(spacing) for width in spacing]
        self.symbol = [(np.sin(2 * np.pi * wave) / width).astype(np.float32) for wave, width in zip(waves, relative)]
        square = np.square(self.symbol[0]) + np.square(self.symbol[1]) + np.square(self.symbol[2])
        self.inverse = np.where(square > 1e-9, 1 / np.maximum(square, 1e-9), 0).astype(np.float32)

    def __call__(self, field: np.ndarray) -> np.ndarray:
        """The divergence-free part of `field`, float32 [nx, ny, nz, 3]."""
        (nx, ny, _), (px, py, pz) = self.shape, self.padded
        spectrum = fft.rfft(np.ascontiguousarray(np.moveaxis(field, -1, 0), np.float32), pz, axis=3)
        spectrum = fft.fft(spectrum, px, axis=1)
        spectrum = fft.fft(spectrum, py, axis=2)
        along = self.symbol[0] * spectrum[0]
        along += self.symbol[1] * spectrum[1]
        along += self.symbol[2] * spectrum[2]
        along *= self.inverse
        for symbol, component in zip(self.symbol, spectrum):
            component -= symbol * along
        spectrum = fft.ifft(spectrum, axis=1, norm="forward")[:, :nx]
        spectrum = fft.ifft(spectrum, axis=2, norm="forward")[:, :, :ny]
        free = fft.irfft(spectrum, pz, axis=3, norm="forward")[..., : self.shape[2]]
        return np.moveaxis(free * np.float32(1 / (px * py * pz)), 0, -1)


@dataclass(frozen=True)
class VelocityFit:
    """u between two frames as control values float32 [cx, cy, cz, 3], voxels per frame, and how well it explains them.

    residual_before, residual: mean |phi[t+1](q) - phi[t](q - u(q))| over the band, voxels, at the start and with u.
    """

    control: np.ndarray
    residual_before: float
    residual: float


def fit_velocity(
    before: np.ndarray,
    after: np.ndarray,
    factor: Factor,
    settings: VelocitySettings | None = None,
    start: np.ndarray | None = None,
) -> VelocityFit:
    """Fit u_t to phi_t (`before`) and phi_{t+1} (`after`), float32 [nx, ny, nz] in voxels of their grid.

    factor: transport voxels per control cell. start: the control values that the descent starts from, by default no
    motion. Zero motion where either frame has no liquid.
    """
    settings = settings or VelocitySettings()
    coarse = control_shape(before.shape, factor)
    control: np.ndarray = np.zeros((*coarse, 3), dtype=np.float32)
    before, after = (np.ascontiguousarray(phi, np.float32) for phi in (before, after))
    if not (before < 0).any() or not (after < 0).any():
        return VelocityFit(control, 0.0, 0.0)
    nodes, starts = band_nodes(before, after, settings.band, factor, coarse)
    if len(nodes) == 0:
        return VelocityFit(control, 0.0, 0.0)
    if start is not None:
        control += start
    counts = np.diff(starts).reshape(*coarse, 1).astype(np.float32)
    voxels = factors(factor)
    in_voxels = settings.smoothing_unit == "transport"
    sigma = tuple(settings.smoothing / (width if in_voxels else 1.0) for width in voxels)
    weight = _smoothed(counts, sigma) + np.float32(1e-3)
    divergence_free = DivergenceFree(coarse, voxels)
    descent = Descent(with_gradient(before), after, nodes, starts, coarse, voxels)

    first = None
    for _ in range(settings.steps):
        update, residual = descent.step(control, settings.step_size)
        first = residual if first is None else first
        if settings.smooth == "update":
            # Normalised by the equally smoothed count: cells without band nodes take their neighbours' motion.
            control += _smoothed(update, sigma) / weight
        else:
            control = _smoothed(control + update / np.maximum(counts, 1), sigma)
        blend = settings.projection_blend
        control = (1 - blend) * control + blend * divergence_free(control)
        speed = np.sqrt((control**2).sum(axis=-1, keepdims=True))
        slowed = control * np.minimum(1, settings.limit / np.maximum(speed, 1e-6))
        control = np.ascontiguousarray(slowed, dtype=np.float32)
    return VelocityFit(control, first or 0.0, descent.step(control, settings.step_size)[1])


def _smoothed(field: np.ndarray, sigma: tuple[float, ...]) -> np.ndarray:
    """Gaussian smoothing of [nx, ny, nz, channels] along the three spatial axes, `sigma` cells along each."""
    return gaussian_filter(field, (*sigma, 0))

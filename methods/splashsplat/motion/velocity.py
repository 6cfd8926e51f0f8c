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
def _descend(
    before: np.ndarray,
    after: np.ndarray,
    control: np.ndarray,
    factor: tuple[float, float, float],
    nodes: np.ndarray,
    starts: np.ndarray,
    step: float,
    update: np.ndarray,
    residual: np.ndarray,
    start: int,
    stop: int,
) -> None:
    """Sums the band nodes' displacements into update [C, 3] and absolute residuals into residual [C], per control cell.

    before: [nx, ny, nz, 4], phi_t and its gradient side by side. nodes: int32 [M, 3], sorted by control cell; the
    nodes of cell c are starts[c]:starts[c + 1].
    """
    for cell in range(start, stop):
        for n in range(starts[cell], starts[cell + 1]):
            x, y, z = nodes[n, 0], nodes[n, 1], nodes[n, 2]
            u, v, w = velocity_at(control, factor, x, y, z)
            i, j, k, a, b, c = _locate(before.shape, x - u, y - v, z - w)
            phi, gx, gy, gz = 0.0, 0.0, 0.0, 0.0
            for di in range(2):
                wi = a if di else 1 - a
                for dj in range(2):
                    wj = wi * (b if dj else 1 - b)
                    for dk in range(2):
                        weight = wj * (c if dk else 1 - c)
                        phi += weight * before[i + di, j + dj, k + dk, 0]
                        gx += weight * before[i + di, j + dj, k + dk, 1]
                        gy += weight * before[i + di, j + dj, k + dk, 2]
                        gz += weight * before[i + di, j + dj, k + dk, 3]
            error = after[x, y, z] - phi
            # phi[t](q - u) grows along -u: a positive error asks for a displacement against the gradient. The 0.05
            # keeps ridges, where the central difference vanishes, from throwing the field about.
            scale = -step * error / (gx * gx + gy * gy + gz * gz + 0.05)
            update[cell, 0] += scale * gx
            update[cell, 1] += scale * gy
            update[cell, 2] += scale * gz
            residual[cell] += abs(error)


class DivergenceFree:
    """Projection of fields [nx, ny, nz, 3] onto divergence-free ones, by Fourier transform with zero padding.

    The symbol is that of the central difference, so it is this discrete divergence that vanishes; spacing: of the
    nodes along each axis. Padding to twice the size keeps opposite faces from seeing each other. The padding is a
    multiple of the field; axis by axis, most of it need not be transformed.
    """

    def __init__(self, shape: tuple[int, int, int], spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> None:
        self.shape = shape
        self.padded = tuple(fft.next_fast_len(2 * n, real=True) for n in shape)
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
    band = (np.abs(before) < settings.band) | (np.abs(after) < settings.band)
    if not band.any() or not (before < 0).any() or not (after < 0).any():
        return VelocityFit(control, 0.0, 0.0)
    if start is not None:
        control += start
    nodes = np.argwhere(band).astype(np.int32)
    cell = cell_numbers(nodes, factor, coarse)
    order = np.argsort(cell, kind="stable")
    nodes = np.ascontiguousarray(nodes[order])
    cells = int(np.prod(coarse))
    starts = np.searchsorted(cell[order], np.arange(cells + 1))
    counts = np.diff(starts).reshape(*coarse, 1).astype(np.float32)
    voxels = factors(factor)
    in_voxels = settings.smoothing_unit == "transport"
    sigma = tuple(settings.smoothing / (width if in_voxels else 1.0) for width in voxels)
    weight = _smoothed(counts, sigma) + np.float32(1e-3)
    divergence_free = DivergenceFree(coarse, voxels)

    with_gradient = np.stack([before, *np.gradient(before)], axis=-1).astype(np.float32)

    def descend() -> tuple[np.ndarray, float]:
        update, residual = np.zeros((cells, 3), np.float32), np.zeros(cells, np.float32)
        fixed = (with_gradient, after, control, voxels, nodes, starts, settings.step_size)
        over_range(_descend, cells, *fixed, update, residual)
        return update.reshape(*coarse, 3), float(residual.sum(dtype=np.float64) / len(nodes))

    first = None
    for _ in range(settings.steps):
        update, residual = descend()
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
    return VelocityFit(control, first or 0.0, descend()[1])


def _smoothed(field: np.ndarray, sigma: tuple[float, ...]) -> np.ndarray:
    """Gaussian smoothing of [nx, ny, nz, channels] along the three spatial axes, `sigma` cells along each."""
    return gaussian_filter(field, (*sigma, 0))

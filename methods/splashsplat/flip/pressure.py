"""The pressure of the FLIP solver: the Poisson system of the liquid cells, and its solution (numba kernels).

Faces that walls cover in part count by their open share (Batty, Bertails and Bridson, "A Fast Variational Framework
for Accurate Solid-Fluid Coupling", 2007). Cells without a particle are air at pressure 0, and so is what lies beyond
the grid. The preconditioner is the modified incomplete Cholesky factor of Bridson, "Fluid Simulation for Computer
Graphics" (2008). Everything runs on one thread in storage order: the same cells give the same bits. Grid and faces: see
grid.py. Time step and density are folded into the pressure, so that it is a velocity potential.
"""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def number_cells(positions: np.ndarray, shares: np.ndarray, buried: np.ndarray, number: np.ndarray) -> np.ndarray:
    """The liquid cells: int32 [M, 3], in storage order.

    These are the cells that hold a particle, and beside them the `buried` ones (bool [nx, ny, nz], middle inside a
    wall) that open faces link to them: their slit of free space is too thin to hold a particle reliably, and as air it
    would let the liquid drain into the wall. Cells without an open face do not count. number: int32 [nx, ny, nz],
    filled with -1; becomes each liquid cell's row.
    """
    nx, ny, nz = number.shape
    for n in range(len(positions)):
        i, j, k = int(positions[n, 0] + 0.5), int(positions[n, 1] + 0.5), int(positions[n, 2] + 0.5)
        number[min(i, nx - 1), min(j, ny - 1), min(k, nz - 1)] = -2
    # Three rounds, each from the marks of those before: into walls, the edges between two walls, and corners.
    for mark in range(-3, -6, -1):
        for i in range(nx):
            for j in range(ny):
                for k in range(nz):
                    if not buried[i, j, k] or number[i, j, k] < -1:
                        continue
                    wet = i > 0 and mark < number[i - 1, j, k] < -1 and shares[0, i, j, k] > 0
                    wet |= j > 0 and mark < number[i, j - 1, k] < -1 and shares[1, i, j, k] > 0
                    wet |= k > 0 and mark < number[i, j, k - 1] < -1 and shares[2, i, j, k] > 0
                    wet |= i < nx - 1 and mark < number[i + 1, j, k] < -1 and shares[0, i + 1, j, k] > 0
                    wet |= j < ny - 1 and mark < number[i, j + 1, k] < -1 and shares[1, i, j + 1, k] > 0
                    wet |= k < nz - 1 and mark < number[i, j, k + 1] < -1 and shares[2, i, j, k + 1] > 0
                    if wet:
                        number[i, j, k] = mark
    count = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if number[i, j, k] == -1:
                    continue
                around = shares[0, i, j, k] + shares[1, i, j, k] + shares[2, i, j, k]
                around += shares[0, i + 1, j, k] + shares[1, i, j + 1, k] + shares[2, i, j, k + 1]
                number[i, j, k] = -1
                if around > 0:
                    number[i, j, k] = count
                    count += 1
    cells = np.empty((count, 3), np.int32)
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                n = number[i, j, k]
                if n >= 0:
                    cells[n, 0], cells[n, 1], cells[n, 2] = i, j, k
    return cells


@numba.njit(cache=True, nogil=True, error_model="numpy")
def divergence(velocity: np.ndarray, shares: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Net outflow of each of the cells [M, 3] through the open part of its faces: float64 [M], 1/s for voxels/s."""
    out = np.empty(len(cells))
    for n in range(len(cells)):
        i, j, k = cells[n, 0], cells[n, 1], cells[n, 2]
        total = shares[0, i + 1, j, k] * velocity[0, i + 1, j, k] - shares[0, i, j, k] * velocity[0, i, j, k]
        total += shares[1, i, j + 1, k] * velocity[1, i, j + 1, k] - shares[1, i, j, k] * velocity[1, i, j, k]
        total += shares[2, i, j, k + 1] * velocity[2, i, j, k + 1] - shares[2, i, j, k] * velocity[2, i, j, k]
        out[n] = total
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def assemble(cells: np.ndarray, number: np.ndarray, shares: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The Poisson matrix of the liquid cells, air at pressure 0: neighbours, couplings [M, 6] and the diagonal [M].

    Columns: the cell before along x, y, z, then the one after; neighbour -1 where there is no liquid cell.
    """
    neighbours = np.full((len(cells), 6), -1, np.int32)
    couplings = np.zeros((len(cells), 6))
    diagonal = np.zeros(len(cells))
    place = np.empty(3, np.int64)
    for n in range(len(cells)):
        for side in range(6):
            a, after = side % 3, side // 3
            place[0], place[1], place[2] = cells[n, 0], cells[n, 1], cells[n, 2]
            place[a] += after
            share = shares[a, place[0], place[1], place[2]]
            diagonal[n] += share
            place[a] += after - 1
            if place[a] < 0 or place[a] >= number.shape[a]:
                continue
            neighbour = number[place[0], place[1], place[2]]
            if neighbour >= 0:
                neighbours[n, side] = neighbour
                couplings[n, side] = share
    return neighbours, couplings, diagonal


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _factor(neighbours: np.ndarray, couplings: np.ndarray, diagonal: np.ndarray) -> np.ndarray:
    """Reciprocal diagonal of the modified incomplete Cholesky factor, level zero, tuned with 0.97: float64 [M]."""
    inverse = np.zeros(len(diagonal))
    for n in range(len(diagonal)):
        if diagonal[n] == 0:
            continue
        pivot = diagonal[n]
        for side in range(3):
            before = neighbours[n, side]
            if before < 0:
                continue
            square = inverse[before] ** 2
            others = 0.0
            for other in range(3, 6):
                if other != side + 3:
                    others += couplings[before, other]
            pivot -= couplings[n, side] ** 2 * square + 0.97 * couplings[n, side] * others * square
        if pivot < 0.25 * diagonal[n]:
            pivot = diagonal[n]
        inverse[n] = 1 / np.sqrt(pivot)
    return inverse


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _precondition(
    neighbours: np.ndarray, couplings: np.ndarray, inverse: np.ndarray, residual: np.ndarray, out: np.ndarray
) -> None:
    for n in range(len(residual)):
        value = residual[n]
        for side in range(3):
            before = neighbours[n, side]
            if before >= 0:
                value += couplings[n, side] * inverse[before] * out[before]
        out[n] = value * inverse[n]
    for n in range(len(residual) - 1, -1, -1):
        value = out[n]
        for side in range(3, 6):
            after = neighbours[n, side]
            if after >= 0:
                value += couplings[n, side] * inverse[n] * out[after]
        out[n] = value * inverse[n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _dot(a: np.ndarray, b: np.ndarray) -> float:
    # Not np.dot: BLAS sums in an order that depends on its threads.
    total = 0.0
    for n in range(len(a)):
        total += a[n] * b[n]
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def solve(
    neighbours: np.ndarray,
    couplings: np.ndarray,
    diagonal: np.ndarray,
    right: np.ndarray,
    iterations: int,
    tolerance: float,
) -> tuple[np.ndarray, int]:
    """Preconditioned conjugate gradients: pressures [M] and the number of iterations taken.

    Stops when no entry of the residual exceeds `tolerance` times the largest of `right`.
    """
    pressure, residual, direction = np.zeros(len(right)), np.zeros(len(right)), np.zeros(len(right))
    product, improved = np.empty(len(right)), np.empty(len(right))
    largest = 0.0
    for n in range(len(right)):
        if diagonal[n] > 0:
            residual[n] = right[n]
            largest = max(largest, abs(right[n]))
    if largest == 0:
        return pressure, 0
    inverse = _factor(neighbours, couplings, diagonal)
    before = 1.0
    for iteration in range(iterations):
        _precondition(neighbours, couplings, inverse, residual, improved)
        slope = _dot(residual, improved)
        for n in range(len(right)):
            direction[n] = improved[n] + slope / before * direction[n]
        before = slope
        for n in range(len(right)):
            value = diagonal[n] * direction[n]
            for side in range(6):
                if neighbours[n, side] >= 0:
                    value -= couplings[n, side] * direction[neighbours[n, side]]
            product[n] = value
        curvature = _dot(direction, product)
        if curvature <= 0:  # what is left is rounding in pockets without a surface, whose pressure has no level
            return pressure, iteration
        step = slope / curvature
        remaining = 0.0
        for n in range(len(right)):
            pressure[n] += step * direction[n]
            residual[n] -= step * product[n]
            remaining = max(remaining, abs(residual[n]))
        if remaining <= tolerance * largest:
            return pressure, iteration + 1
    return pressure, iterations


@numba.njit(cache=True, nogil=True, error_model="numpy")
def apply_pressure(
    velocity: np.ndarray,
    shares: np.ndarray,
    cells: np.ndarray,
    number: np.ndarray,
    pressure: np.ndarray,
    has_velocity: np.ndarray,
) -> None:
    """Subtracts the pressure gradient on the open faces of the liquid cells, in place; marks them in has_velocity."""
    place = np.empty(3, np.int64)
    for n in range(len(cells)):
        for side in range(6):
            a, after = side % 3, side // 3
            place[0], place[1], place[2] = cells[n, 0], cells[n, 1], cells[n, 2]
            place[a] += after
            i, j, k = place[0], place[1], place[2]
            if shares[a, i, j, k] == 0 or has_velocity[a, i, j, k] == 1:
                continue
            has_velocity[a, i, j, k] = 1
            low, high = 0.0, 0.0
            if i < number.shape[0] and j < number.shape[1] and k < number.shape[2] and number[i, j, k] >= 0:
                high = pressure[number[i, j, k]]
            place[a] -= 1
            if place[a] >= 0 and number[place[0], place[1], place[2]] >= 0:
                low = pressure[number[place[0], place[1], place[2]]]
            velocity[a, i, j, k] -= high - low

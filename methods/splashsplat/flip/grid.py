"""The staggered grid of the FLIP solver: particles to faces and back, walls, motion (numba kernels).

Cell (i, j, k) is the unit cube about node (i, j, k) of its grid. Velocities are float64 [3, nx + 1, ny + 1, nz + 1]:
component a lives on the cell faces at (i, j, k) - e_a / 2. Entries past the last face of a component belong to cells
outside the grid, which are air. Source: Zhu and Bridson, "Animating Sand as a Fluid" (2005).
"""

from __future__ import annotations

import numba
import numpy as np

from splashbench.observe.kernels import trilinear

# Points per axis at which a face is looked up in the walls' signed distance.
_FACE_POINTS = 4
# Faces that are open by less count as closed: they let nearly nothing through and make the system ill-conditioned.
_CLOSED = 0.02
# Particles are kept this far from the walls, in cells.
_CLEARANCE = 0.05
_SIDES = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]])


@numba.njit(cache=True, error_model="numpy")
def interpolate(velocity: np.ndarray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Velocity at grid coordinates (x, y, z), each component trilinear between its faces; clamped to the grid."""
    u = trilinear(velocity[0], x + 0.5, y, z)
    v = trilinear(velocity[1], x, y + 0.5, z)
    w = trilinear(velocity[2], x, y, z + 0.5)
    return u, v, w


@numba.njit(cache=True, nogil=True, error_model="numpy")
def to_faces(
    positions: np.ndarray,
    velocities: np.ndarray,
    momentum: np.ndarray,
    weight: np.ndarray,
    start: int,
    stop: int,
) -> None:
    """Trilinear particle-to-grid transfer of components start..stop: sums into momentum and weight, which are zero.

    positions, velocities: float64 [N, 3]; particles outside the grid must not be among them.
    """
    for a in range(start, stop):
        for n in range(len(positions)):
            x, y, z = positions[n, 0], positions[n, 1], positions[n, 2]
            x += 0.5 * (a == 0)
            y += 0.5 * (a == 1)
            z += 0.5 * (a == 2)
            i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
            for di in range(2):
                for dj in range(2):
                    for dk in range(2):
                        p, q, r = i + di, j + dj, k + dk
                        if p < 0 or q < 0 or r < 0:
                            continue
                        if p >= weight.shape[1] or q >= weight.shape[2] or r >= weight.shape[3]:
                            continue
                        part = (1 - abs(x - p)) * (1 - abs(y - q)) * (1 - abs(z - r))
                        weight[a, p, q, r] += part
                        momentum[a, p, q, r] += part * velocities[n, a]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def open_shares(solid: np.ndarray, shares: np.ndarray, start: int, stop: int) -> None:
    """Share of each face outside the walls, in [0, 1], into shares [3, nx + 1, ny + 1, nz + 1] for i in start..stop.

    solid: [nx, ny, nz] signed distance at the nodes, negative inside the walls.
    """
    for i in range(start, stop):
        for j in range(shares.shape[2]):
            for k in range(shares.shape[3]):
                for a in range(3):
                    x, y, z = i - 0.5 * (a == 0), j - 0.5 * (a == 1), k - 0.5 * (a == 2)
                    middle = trilinear(solid, x, y, z)
                    if abs(middle) > 2.0:
                        shares[a, i, j, k] = 1.0 * (middle > 0)
                        continue
                    free = 0
                    for m in range(_FACE_POINTS):
                        for n in range(_FACE_POINTS):
                            s = (m + 0.5) / _FACE_POINTS - 0.5
                            t = (n + 0.5) / _FACE_POINTS - 0.5
                            dx = 0.0 if a == 0 else s
                            dy = 0.0 if a == 1 else (s if a == 0 else t)
                            dz = 0.0 if a == 2 else t
                            free += trilinear(solid, x + dx, y + dy, z + dz) > 0
                    share = free / _FACE_POINTS**2
                    shares[a, i, j, k] = share if share >= _CLOSED else 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def extrapolate(velocity: np.ndarray, has_velocity: np.ndarray, layers: int, start: int, stop: int) -> None:
    """Carries components start..stop `layers` faces beyond those where it is known; what is farther becomes 0.

    Each new face takes the mean of the known ones among its six neighbours. has_velocity: uint8, shape of velocity, 1
    where known; faces that got a value become 1.
    """
    for a in range(start, stop):
        field, mark = velocity[a], has_velocity[a]
        nx, ny, nz = field.shape
        front = np.empty((field.size, 3), np.int32)
        begin, end = 0, 0
        for i in range(nx):
            for j in range(ny):
                for k in range(nz):
                    if mark[i, j, k] != 1:
                        field[i, j, k] = 0
                        continue
                    for s in range(6):
                        p, q, r = i + _SIDES[s, 0], j + _SIDES[s, 1], k + _SIDES[s, 2]
                        inside = 0 <= p < nx and 0 <= q < ny and 0 <= r < nz
                        if inside and mark[p, q, r] == 0:
                            mark[p, q, r] = 2
                            front[end, 0], front[end, 1], front[end, 2] = p, q, r
                            end += 1
        for _ in range(layers):
            last = end
            for n in range(begin, last):
                i, j, k = front[n, 0], front[n, 1], front[n, 2]
                total, count = 0.0, 0
                for s in range(6):
                    p, q, r = i + _SIDES[s, 0], j + _SIDES[s, 1], k + _SIDES[s, 2]
                    if not (0 <= p < nx and 0 <= q < ny and 0 <= r < nz):
                        continue
                    if mark[p, q, r] == 1:
                        total += field[p, q, r]
                        count += 1
                    elif mark[p, q, r] == 0:
                        mark[p, q, r] = 2
                        front[end, 0], front[end, 1], front[end, 2] = p, q, r
                        end += 1
                field[i, j, k] = total / count
            for n in range(begin, last):
                mark[front[n, 0], front[n, 1], front[n, 2]] = 1
            begin = last


@numba.njit(cache=True, nogil=True, error_model="numpy")
def slide(field: np.ndarray, walls: np.ndarray, normals: np.ndarray) -> None:
    """Takes the part along the wall's normal out of the closed faces `walls` [W, 4] (component, i, j, k), in place.

    normals: [W, 3], those of the wall at the faces.
    """
    excess = np.empty(len(walls))
    for n in range(len(walls)):
        a, i, j, k = walls[n, 0], walls[n, 1], walls[n, 2], walls[n, 3]
        u, v, w = interpolate(field, i - 0.5 * (a == 0), j - 0.5 * (a == 1), k - 0.5 * (a == 2))
        excess[n] = (u * normals[n, 0] + v * normals[n, 1] + w * normals[n, 2]) * normals[n, a]
    for n in range(len(walls)):
        field[walls[n, 0], walls[n, 1], walls[n, 2], walls[n, 3]] -= excess[n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def to_particles(
    field: np.ndarray,
    change: np.ndarray,
    positions: np.ndarray,
    flip_ratio: float,
    velocities: np.ndarray,
    start: int,
    stop: int,
) -> None:
    """Grid-to-particle transfer: flip_ratio of (own velocity + change of the grid's), the rest the grid's."""
    for n in range(start, stop):
        x, y, z = positions[n, 0], positions[n, 1], positions[n, 2]
        pic = interpolate(field, x, y, z)
        gain = interpolate(change, x, y, z)
        for a in range(3):
            velocities[n, a] = flip_ratio * (velocities[n, a] + gain[a]) + (1 - flip_ratio) * pic[a]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def drift(
    field: np.ndarray,
    inside: np.ndarray,
    solid: np.ndarray,
    duration: float,
    positions: np.ndarray,
    velocities: np.ndarray,
    deformation: np.ndarray,
    start: int,
    stop: int,
) -> None:
    """Moves particles by midpoint RK2 through `field` and out of the walls; those outside the grid fly on."""
    gradient, deformed = np.empty((3, 3)), np.empty((3, 3))
    for n in range(start, stop):
        if not inside[n]:
            for a in range(3):
                positions[n, a] += duration * velocities[n, a]
            continue
        x, y, z = positions[n, 0], positions[n, 1], positions[n, 2]
        u, v, w = interpolate(field, x, y, z)
        half = 0.5 * duration
        u, v, w = interpolate(field, x + half * u, y + half * v, z + half * w)
        if n < len(deformation):
            for b in range(3):
                dx, dy, dz = 1.0 * (b == 0), 1.0 * (b == 1), 1.0 * (b == 2)
                high = interpolate(field, x + dx, y + dy, z + dz)
                low = interpolate(field, x - dx, y - dy, z - dz)
                for a in range(3):
                    gradient[a, b] = 0.5 * (high[a] - low[a])
            for a in range(3):
                for b in range(3):
                    deformed[a, b] = deformation[n, a, b]
                    for c in range(3):
                        deformed[a, b] += duration * gradient[a, c] * deformation[n, c, b]
            for a in range(3):
                for b in range(3):
                    deformation[n, a, b] = deformed[a, b]
        p, q, r = x + duration * u, y + duration * v, z + duration * w
        for _ in range(3):
            depth = _CLEARANCE - trilinear(solid, p, q, r)
            if depth <= 0:
                break
            nx = trilinear(solid, p + 0.5, q, r) - trilinear(solid, p - 0.5, q, r)
            ny = trilinear(solid, p, q + 0.5, r) - trilinear(solid, p, q - 0.5, r)
            nz = trilinear(solid, p, q, r + 0.5) - trilinear(solid, p, q, r - 0.5)
            length = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-9)
            nx, ny, nz = nx / length, ny / length, nz / length
            p, q, r = p + depth * nx, q + depth * ny, r + depth * nz
            along = min(velocities[n, 0] * nx + velocities[n, 1] * ny + velocities[n, 2] * nz, 0.0)
            velocities[n, 0] -= along * nx
            velocities[n, 1] -= along * ny
            velocities[n, 2] -= along * nz
        # In a corner too narrow to be pushed out of, the particle stays where it was.
        if trilinear(solid, p, q, r) < 0:
            p, q, r = x, y, z
        positions[n, 0], positions[n, 1], positions[n, 2] = p, q, r

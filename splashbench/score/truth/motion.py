"""Endpoint error of a reconstruction's velocities against those of the true particles (docs/protocol.md).

The error covers true particles near the true surface, where a camera can see motion, that have a reconstructed particle
near them. Their share is a metric of its own, so that nobody gains by leaving the hard ones out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.scene import Particles
from splashbench.score.particles.copies import limited_copies

Vectors = NDArray[np.float64]

#: How far from the true surface a true particle may be, and how far from that a reconstructed one, voxels.
NEAR_SURFACE_VOXELS = 3.0
REACH_VOXELS = 3.0
#: The velocity at a true particle is that of this many reconstructed ones, by inverse squared distance.
NEIGHBOURS = 4
#: A particle is in free flight where its acceleration is gravity's to within this share.
FREE_FLIGHT_TOLERANCE = 0.2
# Softens the weight of a reconstructed particle that lies on the true one, voxels.
_SOFTENING = 1e-3


@dataclass(frozen=True)
class FrameMotion:
    """One step, over the n true particles that are near the surface and in reach of the reconstruction.

    Attributes:
        errors, moved: [n] voxels, length of the error and of the true displacement.
        airborne: [n] bool, in free flight over the step.
        near: how many true particles are near the surface, in reach or not.
    """

    errors: NDArray[np.float64]
    moved: NDArray[np.float64]
    airborne: NDArray[np.bool_]
    near: int

    @property
    def error(self) -> float | None:
        """Mean error, voxels."""
        return float(self.errors.mean()) if len(self.errors) else None

    @property
    def relative(self) -> float | None:
        """Sum of errors over sum of displacements: 1 for no motion."""
        return relative(self.errors, self.moved)

    @property
    def relative_airborne(self) -> float | None:
        """The same over the particles in free flight."""
        return relative(self.errors[self.airborne], self.moved[self.airborne])

    @property
    def coverage(self) -> float | None:
        """Share of the true particles near the surface that are in reach."""
        return len(self.errors) / self.near if self.near else None


def relative(errors: NDArray[np.float64], moved: NDArray[np.float64]) -> float | None:
    """sum errors / sum moved; None where nothing moves."""
    total = float(moved.sum())
    return float(errors.sum()) / total if total > 0 else None


def known_velocities(particles: Particles, t: int, times: NDArray[np.float64]) -> tuple[NDArray[np.intp], Vectors]:
    """Which particles have a velocity at frame `t` (indices [n]), and which (scene units per second, [n, 3]).

    The particles' own velocities where they have any, else the displacement to frame t + 1 of those alive in both.
    """
    if particles.velocities is not None:
        rows = np.flatnonzero(particles.active[t])
        return rows, particles.velocities[t, rows].astype(np.float64)
    rows = np.flatnonzero(particles.active[t] & particles.active[t + 1])
    moved = particles.positions[t + 1, rows].astype(np.float64) - particles.positions[t, rows]
    return rows, moved / (times[t + 1] - times[t])


def free_flight(true: Particles, t: int, times: NDArray[np.float64], gravity: Vectors) -> NDArray[np.bool_] | None:
    """Which of the N true particles fall freely from frame t to t + 1: |(v[t+1] - v[t]) / dt - g| < 0.2 |g|.

    gravity: [3] scene units per second squared. None where the truth has no velocities.
    """
    if true.velocities is None:
        return None
    velocities = true.velocities[t : t + 2].astype(np.float64)
    acceleration = (velocities[1] - velocities[0]) / (times[t + 1] - times[t])
    falling = np.linalg.norm(acceleration - gravity, axis=1) < FREE_FLIGHT_TOLERANCE * np.linalg.norm(gravity)
    return falling & true.active[t] & true.active[t + 1]


def frame_motion(
    true_positions: Vectors,
    true_moved: Vectors,
    airborne: NDArray[np.bool_],
    surface: Vectors,
    positions: Vectors,
    moved: Vectors,
) -> FrameMotion:
    """Compare displacements over one step. All lengths in voxels.

    Args:
        true_positions, true_moved, airborne: [N, 3], [N, 3], [N] of the true particles.
        surface: [S, 3] points of the true surface.
        positions, moved: [M, 3] of the reconstruction.
    """
    from scipy.spatial import cKDTree

    none = np.zeros(0)
    if len(surface) == 0 or len(true_positions) == 0:
        return FrameMotion(none, none, none.astype(bool), 0)
    distances, _ = cKDTree(surface).query(true_positions, distance_upper_bound=NEAR_SURFACE_VOXELS, workers=-1)
    near = np.isfinite(distances)
    true_positions, true_moved, airborne = true_positions[near], true_moved[near], airborne[near]
    if len(positions) == 0 or not near.any():
        return FrameMotion(none, none, none.astype(bool), len(true_positions))
    copies = limited_copies(positions, NEIGHBOURS)
    if copies is not None:
        positions, moved = positions[copies[0]], moved[copies[0]]
    distances, neighbours = cKDTree(positions).query(
        true_positions, NEIGHBOURS, distance_upper_bound=REACH_VOXELS, workers=-1
    )
    reached = np.isfinite(distances[:, 0])
    distances, neighbours = distances[reached], neighbours[reached]
    # Neighbours that are not there are infinitely far away, and their index is one past the end.
    weights = 1.0 / (np.square(distances) + _SOFTENING**2)
    weights /= weights.sum(axis=1, keepdims=True)
    averaged = np.einsum("nk,nkc->nc", weights, moved[np.minimum(neighbours, len(moved) - 1)])
    true_moved = true_moved[reached]
    return FrameMotion(
        np.linalg.norm(averaged - true_moved, axis=1),
        np.linalg.norm(true_moved, axis=1),
        airborne[reached],
        len(true_positions),
    )

"""Delta E: how much of the change in mechanical energy goes upwards (paper, "Metrics"; docs/protocol.md).

Passive liquid only dissipates. The energy is evaluated halfway between frames, in the form that is exactly constant
for ballistic flight at any time steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.scene import Particles
from splashbench.score.settings import PROTOCOL_V1, Protocol

_FLOAT32_ROUNDING = float(np.finfo(np.float32).eps)


@dataclass(frozen=True)
class EnergyChange:
    """Delta E in [0, 1], and r[t], J/kg, for each inner frame (None where no carrier lives through three frames)."""

    value: float
    changes: tuple[float | None, ...]


def energy_deviation(
    particles: Particles,
    times: NDArray[np.float64],
    up: NDArray[np.float64],
    metres_per_unit: float,
    protocol: Protocol = PROTOCOL_V1,
) -> EnergyChange | None:
    """Delta E = sum max(0, r) / sum |r| over the frames; None where no carrier lives through three frames.

    r[t] is the mean, over carriers alive at t-1, t and t+1, of e[t+1/2] - e[t-1/2], with
    e[t+1/2] = |x[t+1] - x[t]|^2 / (2 dt^2) + g ((y[t] + y[t+1]) / 2 + g dt^2 / 8) and the true, uneven dt.
    A change below the rounding of 32-bit positions counts as none, so motion that keeps its energy scores 0.

    Args:
        particles: positions [T, N, 3], scene units; a row is one carrier.
        times: [T] seconds.
        up: unit vector [3] against gravity.
        metres_per_unit: metric scale.
    """
    n_frames = particles.n_frames
    g = protocol.gravity_m_s2
    changes: list[float | None] = []
    for t in range(1, n_frames - 1):
        alive = particles.active[t - 1] & particles.active[t] & particles.active[t + 1]
        if not alive.any():
            changes.append(None)
            continue
        before, now, after = (
            particles.positions[s][alive].astype(np.float64) * metres_per_unit for s in (t - 1, t, t + 1)
        )
        first, rounding_first = _half_step_energy(before, now, times[t] - times[t - 1], up, g)
        second, rounding_second = _half_step_energy(now, after, times[t + 1] - times[t], up, g)
        change = float(np.mean(second - first))
        changes.append(0.0 if abs(change) <= rounding_first + rounding_second else change)
    measured = np.array([change for change in changes if change is not None])
    if measured.size == 0:
        return None
    total = float(np.abs(measured).sum())
    value = 0.0 if total == 0 else float(np.maximum(measured, 0).sum()) / total
    return EnergyChange(value, (None, *changes, None))


def _half_step_energy(
    start: NDArray[np.float64], end: NDArray[np.float64], dt: float, up: NDArray[np.float64], g: float
) -> tuple[NDArray[np.float64], float]:
    """Mechanical energy per unit mass [N], J/kg, halfway between two positions [N, 3], m.

    Also returns how far rounding the positions to 32 bits can move the mean of those energies.
    """
    squared = np.square(end - start).sum(axis=1) / dt**2
    height = 0.5 * (start + end) @ up
    reach = np.maximum(np.abs(start), np.abs(end)).max(axis=1)
    rounding = _FLOAT32_ROUNDING * float(np.mean(reach * (2 * np.sqrt(squared) / dt + g)))
    return 0.5 * squared + g * (height + g * dt * dt / 8), rounding

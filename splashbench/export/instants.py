"""At which instants a reconstruction is exported: its timesteps, some of them, or evenly in time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.replay import Reconstruction

MAX_FRAMES = 100_000
# How far from a timestep a time may be to be that timestep, in shares of the shortest step; decimals get rounded.
_SAME = 1e-3


def export_times(
    recorded: NDArray[np.float64],
    between: tuple[float | None, float | None] = (None, None),
    every: int = 1,
    fps: float | None = None,
) -> NDArray[np.float64]:
    """The instants [F] in seconds: timesteps of `recorded` [T], or so many a second by the method's own interpolation.

    Args:
        between: first and last second, both included; None is the recording's own.
        every: take each so-many-th of the timesteps that are left.
        fps: frames per second of the recording's time, from the first of its seconds on; excludes `every`.

    Raises SplashbenchError where no instant is left, or more than MAX_FRAMES.
    """
    start, end = recorded[0], recorded[-1]
    slack = _SAME * _shortest_step(recorded)
    low = start if between[0] is None else between[0]
    high = end if between[1] is None else between[1]
    if not low <= high:
        raise SplashbenchError(f"from {low:g} to {high:g} s is no time; give the earlier one first")
    if every < 1 or (fps is not None and (every != 1 or not 0 < fps < math.inf)):
        raise SplashbenchError(f"every {every} and {fps} frames a second do not go together; give one of them, above 0")
    none = (
        f"the recording has no instant from {low:g} to {high:g} s; it has {len(recorded)} from {start:g} to {end:g} s"
    )
    if fps is None:
        times = recorded[(recorded >= low - slack) & (recorded <= high + slack)][::every]
        if not len(times):
            raise SplashbenchError(none)
        return np.asarray(times, dtype=np.float64)
    low, high = max(low, start), min(high, end)
    if low > high:
        raise SplashbenchError(none)
    count = math.floor(min((high - low) * fps, 10.0 * MAX_FRAMES) + 1e-6) + 1
    if count > MAX_FRAMES:
        raise SplashbenchError(
            f"{fps:g} frames a second from {low:g} to {high:g} s are more than {MAX_FRAMES}; give fewer, or less time"
        )
    return np.asarray(np.minimum(low + np.arange(count) / fps, end), dtype=np.float64)


def all_or(reconstruction: Reconstruction, times: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """`times`, or all timesteps of the reconstruction where None. Raises SplashbenchError for times that are none."""
    if times is None:
        return reconstruction.times
    instants = np.asarray(times, dtype=np.float64)
    if instants.ndim != 1 or not len(instants) or not np.isfinite(instants).all() or (np.diff(instants) <= 0).any():
        raise SplashbenchError("the times of an export must be seconds that rise, one at least; see export_times")
    return instants


def timesteps(reconstruction: Reconstruction, times: NDArray[np.float64], what: str) -> NDArray[np.int64]:
    """Indices [F] of the timesteps that `times` are. Raises SplashbenchError where one is none: there is no `what`."""
    recorded = reconstruction.times
    after = np.searchsorted(recorded, times).clip(0, len(recorded) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(recorded[before] - times) < np.abs(recorded[after] - times), before, after)
    if (np.abs(recorded[nearest] - times) > _SAME * _shortest_step(recorded)).any():
        raise SplashbenchError(
            f"{reconstruction.submission.directory}: {what} are known at the timesteps alone; choose some of them "
            "(--every), not other instants (--fps)"
        )
    return np.asarray(nearest, dtype=np.int64)


def _shortest_step(recorded: NDArray[np.float64]) -> float:
    return float(np.diff(recorded).min()) if len(recorded) > 1 else 1.0

"""The timesteps of a scene: instants spread evenly over the motion, and each camera's source frame nearest to them.

The paper takes 50 timesteps over the motion interval (Sec. 3). The step is no whole number of source frames (Supp.,
"Scene Overview"), so every camera's frames lie up to half a source frame beside the nominal instant. A timestep's time
is the mean of its frames' true times on the reference clock, which are recorded per camera.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from splashbench.arrays import Flags, Floats, Indices
from splashbench.errors import SplashbenchError
from splashbench.prepare.audio.sync import ClockFit

_ROUNDING_S = 1e-6  # timestamps are whole ticks of the file's time base


@dataclass(frozen=True)
class Sampling:
    """Which source frame stands for which timestep, per camera.

    All times are seconds on the reference clock.

    Attributes:
        nominal: [T], instants spread evenly.
        times: [T], the mean of the cameras' true times.
        indices: camera -> [T] source frames.
        camera_times: camera -> [T] their true times.
        flagged: camera -> [T] whether the true time misses the nominal one by more than half a source frame: a dropped
            frame, or the end of the recording.
    """

    nominal: Floats
    times: Floats
    indices: dict[str, Indices]
    camera_times: dict[str, Floats]
    flagged: dict[str, Flags]

    @property
    def spread_s(self) -> Floats:
        """[T] latest minus earliest true time among the cameras of a timestep."""
        stacked = np.stack(list(self.camera_times.values()))
        return np.asarray(stacked.max(axis=0) - stacked.min(axis=0))


def sample_times(interval: tuple[float, float], timesteps: int = 50) -> Floats:
    """[timesteps] instants from the interval's start to its end, both included, evenly spaced."""
    start, end = interval
    if timesteps < 2 or not start < end:
        raise ValueError("sampling needs at least two timesteps and an interval that runs forwards")
    return np.linspace(start, end, timesteps)


def sample_frames(times: Floats, frame_times: Mapping[str, Floats], clocks: Mapping[str, ClockFit]) -> Sampling:
    """Pick each camera's nearest source frame for every instant.

    `times`: [T] increasing, reference clock; `frame_times`: camera -> [N] local seconds
    (`Recording.frame_times`); `clocks`: from `sync.estimate_sync`. Raises SplashbenchError when a camera did
    not record the interval, or when a frame would have to stand for two timesteps.
    """
    indices: dict[str, Indices] = {}
    camera_times: dict[str, Floats] = {}
    flagged: dict[str, Flags] = {}
    for camera, local in frame_times.items():
        common = clocks[camera].to_reference(local)
        if len(common) < 2:
            raise SplashbenchError(f"camera {camera}: its pour recording has {len(common)} frames; film a video")
        period = float(np.median(np.diff(common)))
        if times[0] < common[0] - period or times[-1] > common[-1] + period:
            raise SplashbenchError(
                f"camera {camera} recorded {common[0]:.3f} to {common[-1]:.3f} s on the reference clock, not all "
                f"of the motion ({times[0]:.3f} to {times[-1]:.3f} s); narrow motion_interval in session.toml"
            )
        nearest = _nearest(common, times)
        if (np.diff(nearest) <= 0).any():
            most = int((times[-1] - times[0]) / period) + 1
            raise SplashbenchError(
                f"camera {camera}: {len(times)} timesteps in {times[-1] - times[0]:.3f} s fall on the same source "
                f"frame twice; set timesteps in session.toml to {max(2, most)} or fewer, or widen motion_interval"
            )
        indices[camera] = nearest
        camera_times[camera] = common[nearest]
        flagged[camera] = np.abs(common[nearest] - times) > period / 2 + _ROUNDING_S
    mean = np.mean(np.stack(list(camera_times.values())), axis=0)
    return Sampling(np.asarray(times, np.float64), mean, indices, camera_times, flagged)


def _nearest(increasing: Floats, times: Floats) -> Indices:
    """Index of the entry nearest to each time; the earlier one of two equally near."""
    after = np.clip(np.searchsorted(increasing, times), 1, len(increasing) - 1)
    before = after - 1
    return np.where(times - increasing[before] <= increasing[after] - times, before, after)

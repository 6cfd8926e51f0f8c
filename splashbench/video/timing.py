"""When the frames of a video are: an instant of the liquid for each frame, and frames a second."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.replay.paths import MAX_FPS, MAX_FRAMES

#: Frames a second where nothing says otherwise.
DEFAULT_FPS = 30.0
# Fewer are a row of pictures, whose rate containers cannot say.
_MIN_FPS = 0.1
# Of a second: how far beyond the recording an instant may be that still belongs to it.
_SLACK = 1e-6


@dataclass(frozen=True)
class Timing:
    """The liquid's instants of N frames, and how fast they are shown.

    Attributes:
        times: [N] seconds on the scene's clock.
        fps: frames a second.

    Raises ValueError for no instants, for more than `MAX_FRAMES`, and for what is no number; see `require_rate` too.
    """

    times: NDArray[np.float64]
    fps: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", np.array(self.times, dtype=np.float64))
        if self.times.ndim != 1 or not 1 <= len(self.times) <= MAX_FRAMES or not np.isfinite(self.times).all():
            raise ValueError(f"a video has 1 to {MAX_FRAMES} instants, which are numbers")
        require_rate(self.fps)

    def __len__(self) -> int:
        return len(self.times)

    def speed(self, k: int) -> float:
        """How fast the liquid moves at frame `k`, of its real speed; 0 where it stands still."""
        if len(self.times) < 2:
            return 0.0
        later = min(k + 1, len(self.times) - 1)
        return float((self.times[later] - self.times[later - 1]) * self.fps)


def require_rate(fps: float) -> None:
    """Raise SplashbenchError for frames a second that no video has."""
    if not _MIN_FPS <= fps <= MAX_FPS:
        raise SplashbenchError(
            f"a video has {_MIN_FPS:g} to {MAX_FPS:g} frames a second, not {fps:g}; give another --fps"
        )


def slowed(start: float, end: float, fps: float, slow: float) -> Timing:
    """From `start` to `end` seconds, `slow` times slower than real: a frame at each instant that is shown."""
    step = 1 / (fps * slow)
    steps = (end - start) / step
    if not steps < MAX_FRAMES:
        raise SplashbenchError(
            f"{end - start:.4g} s at {fps:g} frames a second and 1/{slow:g} of their speed are more than "
            f"{MAX_FRAMES} frames; give a lower --slow or --fps, or a part (--start, --end)"
        )
    count = int(np.floor(steps + _SLACK)) + 1
    return Timing(np.minimum(start + step * np.arange(count), end), fps)


def spread(start: float, end: float, count: int, fps: float) -> Timing:
    """`count` frames evenly from `start` to `end` seconds, which may be one instant."""
    if not 1 <= count <= MAX_FRAMES:
        raise SplashbenchError(f"the video would have {count} frames; a video has 1 to {MAX_FRAMES}")
    return Timing(np.linspace(start, end, count), fps)


def stepwise(times: NDArray[np.float64], start: float, end: float, fps: float | None, slow: float) -> Timing:
    """A frame for each of the timesteps `times` from `start` to `end`, at `fps` or at 1/`slow` of their speed."""
    chosen = times[(times >= start - _SLACK) & (times <= end + _SLACK)]
    if len(chosen) == 0:
        raise SplashbenchError(f"no timestep lies between {start:g} and {end:g} s; give a longer part")
    if fps is None:
        step = float(np.median(np.diff(times))) if len(times) > 1 else 1 / DEFAULT_FPS
        fps = min(MAX_FPS, 1 / (step * slow))
    return Timing(chosen, fps)


def chosen_span(times: NDArray[np.float64], start: float | None, end: float | None) -> tuple[float, float]:
    """The part of a recording with timesteps `times` from `start` to `end` seconds, each None for the recording's own.

    Raises SplashbenchError where it lies beyond the recording: there is nothing to show.
    """
    first, last = float(times[0]), float(times[-1])
    chosen = (first if start is None else start, last if end is None else end)
    for value, option in zip(chosen, ("--start", "--end")):
        if not first - _SLACK <= value <= last + _SLACK:
            raise SplashbenchError(
                f"{option} {value:g} is beyond the recording, which lasts from {first:.3f} to {last:.3f} s"
            )
    if chosen[1] < chosen[0]:
        raise SplashbenchError(f"--end {chosen[1]:g} is before --start {chosen[0]:g}; exchange them")
    return float(np.clip(chosen[0], first, last)), float(np.clip(chosen[1], first, last))


def require_within(times: NDArray[np.float64], recording: NDArray[np.float64], path: object) -> None:
    """Raise SplashbenchError where a path's own `times` leave the recording, whose end would stand still there."""
    first, last = float(recording[0]), float(recording[-1])
    beyond = np.flatnonzero((times < first - _SLACK) | (times > last + _SLACK))
    if len(beyond):
        k = int(beyond[0])
        raise SplashbenchError(
            f"{path}: frame {k} is at {times[k]:.3f} s, beyond the recording, which lasts from {first:.3f} to "
            f"{last:.3f} s; save the path within it"
        )

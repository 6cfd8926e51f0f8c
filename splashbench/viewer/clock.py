"""The playing clock: which timestep is shown when, at the recording's real speed or slower."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

import numpy as np

#: Speeds to choose from, as shares of the recording's own.
SPEEDS = {"1": 1.0, "1/2": 1 / 2, "1/4": 1 / 4, "1/8": 1 / 8, "1/16": 1 / 16}


class PlayClock:
    """Runs through timesteps. Each is shown until the next one's time; the last one for a mean step.

    Args:
        times: [T] seconds, rising. A single one is never played.
        now: seconds that pass, by default the system's monotonic clock; tests give one of their own.

    Raises ValueError for times that do not rise. May be used from several threads.
    """

    def __init__(self, times: Sequence[float], now: Callable[[], float] = time.monotonic) -> None:
        self._times = np.asarray(times, dtype=np.float64)
        if self._times.ndim != 1 or not len(self._times) or not np.isfinite(self._times).all():
            raise ValueError("a clock needs one time or more, which are numbers")
        if (np.diff(self._times) <= 0).any():
            raise ValueError("the times of the timesteps do not rise")
        self._now = now
        self._lock = threading.RLock()
        self._speed, self._loop, self._playing = 1.0, True, False
        # Where in the recording the clock was (`_at`, seconds) when `_since` was the time.
        self._at, self._since = float(self._times[0]), now()

    @property
    def n_frames(self) -> int:
        """T, the number of timesteps."""
        return len(self._times)

    @property
    def playing(self) -> bool:
        """Whether it runs."""
        return self._playing

    @property
    def speed(self) -> float:
        """Seconds of the recording that pass in a second."""
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        if not speed > 0:
            raise ValueError(f"speed is {speed}, not above 0")
        with self._lock:
            self._hold()
            self._speed = float(speed)

    @property
    def loop(self) -> bool:
        """Whether it starts again at the end."""
        return self._loop

    @loop.setter
    def loop(self, loop: bool) -> None:
        with self._lock:
            self._hold()
            self._loop = bool(loop)

    def play(self) -> None:
        """Run from here, from the first timestep where the last one is shown. One timestep alone does not run."""
        with self._lock:
            if self._playing or self.n_frames == 1:
                return
            if self.tick() == self.n_frames - 1:
                self._at = float(self._times[0])
            self._since, self._playing = self._now(), True

    def pause(self) -> None:
        """Stay at the timestep that is shown."""
        with self._lock:
            self._hold()
            self._playing = False

    def seek(self, index: int) -> None:
        """Go to timestep `index`, the nearest one there is, and go on playing from there where it played."""
        with self._lock:
            self._at = float(self._times[int(np.clip(index, 0, self.n_frames - 1))])
            self._since = self._now()

    def step(self, number: int) -> None:
        """Pause, `number` timesteps on; past an end it goes on at the other."""
        with self._lock:
            index = self.tick()
            self._playing = False
            self.seek((index + number) % self.n_frames)

    def tick(self) -> int:
        """The timestep that is to be shown now. Without `loop` the clock stops at the last one."""
        with self._lock:
            self._hold()
            return self._index()

    def read(self) -> tuple[int, float, bool]:
        """The timestep that is to be shown now, its time in seconds, and whether the clock runs: all of one moment."""
        with self._lock:
            t = self.tick()
            return t, float(self._times[t]), self._playing

    @property
    def seconds(self) -> float:
        """The time of the timestep that is shown, seconds of the recording."""
        return float(self._times[self.tick()])

    def until_next(self) -> float | None:
        """Seconds until another timestep is to be shown; None where it does not play."""
        with self._lock:
            index = self.tick()
            if not self._playing:
                return None
            end = self._end() if index == self.n_frames - 1 else float(self._times[index + 1])
            return max(0.0, (end - self._at) / self._speed)

    def _index(self) -> int:
        return int(np.clip(np.searchsorted(self._times, self._at, side="right") - 1, 0, self.n_frames - 1))

    def _end(self) -> float:
        """When the last timestep's turn is over."""
        span = float(self._times[-1] - self._times[0])
        return float(self._times[-1]) + span / max(self.n_frames - 1, 1)

    def _hold(self) -> None:
        """Bring `_at` up to now, around the end or to a stop there."""
        if not self._playing:
            return
        now = self._now()
        at = self._at + (now - self._since) * self._speed
        start, end = float(self._times[0]), self._end()
        if at >= end:
            if self._loop:
                at = start + (at - start) % (end - start)
            else:
                at, self._playing = float(self._times[-1]), False
        self._at, self._since = at, now

"""The progress of a download for people: megabytes, and an estimate of the time that is left."""

from __future__ import annotations

import time

from splashbench.progress import Bar

_MIN_BAR_BYTES = 1 << 20


class Meter:
    """The progress bar of the file `name` of `size` bytes, of which `have` are there already.

    A small file has none unless it has to wait.
    """

    def __init__(self, name: str, size: int, have: int) -> None:
        self._name, self._size = name, size
        self._first, self._start = have, time.monotonic()
        self._have = have
        self._bar: Bar | None = None

    def show(self, have: int) -> None:
        """Move the bar to `have` bytes."""
        if self._bar is None and self._size >= _MIN_BAR_BYTES:
            self._bar = Bar(self._name)
        if self._bar is not None:
            self._bar.update(have / self._size, self._estimate(have))

    def add(self, count: int) -> None:
        """Move the bar by `count` bytes."""
        self._have += count
        self.show(self._have)

    def wait(self, reason: str, seconds: float) -> None:
        """Say why nothing arrives for so many seconds."""
        self._bar = self._bar or Bar(self._name)
        self._bar.hold(f"again in {seconds:.0f} s: {reason}")

    def _estimate(self, have: int) -> str:
        text = f"{have / 1e6:.0f} of {megabytes(self._size)}"
        speed = (have - self._first) / max(time.monotonic() - self._start, 1e-3)  # bytes per second
        if speed <= 0:
            return text
        left = (self._size - have) / speed
        return f"{text}, {left:.0f} s left" if left < 100 else f"{text}, {left / 60:.0f} min left"

    def close(self) -> None:
        """End the bar's line."""
        if self._bar is not None:
            self._bar.close()


def megabytes(count: int) -> str:
    """A number of bytes for people: "244 MB"."""
    return f"{count / 1e6:.0f} MB" if count >= 1e6 else f"{count / 1e3:.0f} kB"

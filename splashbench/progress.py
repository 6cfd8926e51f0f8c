"""Progress bars for whatever takes over two seconds; they go to standard error, so `--json` output stays clean."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")

# tqdm's own default redraws many times a second, which floods the logs of machines without a terminal.
_LOG_INTERVAL_SECONDS = 10.0


def track(iterable: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
    """Yield from `iterable` while showing a bar labelled `description` on standard error."""
    from tqdm import tqdm

    interval = 0.1 if sys.stderr.isatty() else _LOG_INTERVAL_SECONDS
    yield from tqdm(
        iterable, desc=description, total=total, file=sys.stderr, mininterval=interval, leave=True, ncols=90
    )


class Bar:
    """A bar that follows a fraction in [0, 1] reported from elsewhere (a method in its child process)."""

    def __init__(self, description: str) -> None:
        from tqdm import tqdm

        interval = 0.1 if sys.stderr.isatty() else _LOG_INTERVAL_SECONDS
        self._bar = tqdm(
            total=1.0,
            desc=description,
            file=sys.stderr,
            mininterval=interval,
            ncols=90,
            bar_format="{desc}: {percentage:3.0f}%|{bar}| {elapsed}{postfix}",
        )

    def update(self, fraction: float, message: str = "") -> None:
        """Move to `fraction` (never backwards) and show `message` behind the bar."""
        step = min(1.0, fraction) - self._bar.n
        self._bar.set_postfix_str(message[:40], refresh=False)
        self._bar.update(max(0.0, step))

    def close(self) -> None:
        """Leave the bar as it stands and end its line."""
        self._bar.close()

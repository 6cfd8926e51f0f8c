"""Progress bars for work of more than two seconds, on standard error, so that `--json` output stays clean."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from typing import Any, TypeVar

from splashbench.errors import one_line

T = TypeVar("T")

_LOG_INTERVAL_SECONDS = 10.0


def track(iterable: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
    """Yield from `iterable` and show progress on standard error, labelled `description`.

    `total` is the number of items, where `iterable` has no length. Without a terminal, a line is printed every ten
    seconds instead of a bar: logs are read as lines.
    """
    description = one_line(description)  # cameras are named by strangers' scenes
    if sys.stderr.isatty():
        from tqdm import tqdm

        yield from tqdm(iterable, desc=description, total=total, file=sys.stderr, ncols=90)
        return
    if total is None and isinstance(iterable, Sized):
        total = len(iterable)
    last_line = time.monotonic()
    for done, item in enumerate(iterable):
        if time.monotonic() - last_line >= _LOG_INTERVAL_SECONDS:
            last_line = time.monotonic()
            print(f"{description}: {done}{f' of {total}' if total else ''}", file=sys.stderr, flush=True)
        yield item


class Bar:
    """A bar that follows a fraction in [0, 1], such as a method reports from its child process.

    Without a terminal, a line is printed every ten seconds instead: logs are read as lines. With `keep` false the bar
    disappears when it is closed, for bars between lines of other text.
    """

    def __init__(self, description: str, keep: bool = True) -> None:
        self._description = description = one_line(description)
        self._bar: Any = None
        self._last_line = time.monotonic()
        if sys.stderr.isatty():
            from tqdm import tqdm

            form = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}{postfix}"
            self._bar = tqdm(total=1.0, desc=description, file=sys.stderr, ncols=90, bar_format=form, leave=keep)

    def update(self, fraction: float, message: str = "") -> None:
        """Move the bar to `fraction`, never backwards, and show `message`, which may be a method's, behind it."""
        message = one_line(message)
        if self._bar is not None:
            step = min(1.0, fraction) - self._bar.n
            self._bar.set_postfix_str(message[:40], refresh=False)
            self._bar.update(max(0.0, step))
        elif time.monotonic() - self._last_line >= _LOG_INTERVAL_SECONDS:
            self._last_line = time.monotonic()
            print(f"{self._description}: {fraction:4.0%} {message}".rstrip(), file=sys.stderr, flush=True)

    def hold(self, message: str) -> None:
        """Show at once why the bar stands still."""
        if self._bar is not None:
            self._bar.set_postfix_str(message[:40])
        else:
            print(f"{self._description}: {message}", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Leave the bar as it stands and end its line."""
        if self._bar is not None:
            self._bar.close()

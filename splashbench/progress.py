"""Progress bars for whatever takes over two seconds; they go to standard error, so `--json` output stays clean."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from typing import Any, TypeVar

T = TypeVar("T")

_LOG_INTERVAL_SECONDS = 10.0


def track(iterable: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
    """Yield from `iterable` while showing on standard error how far it is, labelled `description`.

    Without a terminal it prints a line every ten seconds instead of a bar: logs are read as lines.
    """
    if sys.stderr.isatty():
        from tqdm import tqdm

        yield from tqdm(iterable, desc=description, total=total, file=sys.stderr, ncols=90)
        return
    if total is None and isinstance(iterable, Sized):
        total = len(iterable)
    told = time.monotonic()
    for done, item in enumerate(iterable):
        if time.monotonic() - told >= _LOG_INTERVAL_SECONDS:
            told = time.monotonic()
            print(f"{description}: {done}{f' of {total}' if total else ''}", file=sys.stderr, flush=True)
        yield item


class Bar:
    """A bar that follows a fraction in [0, 1] reported from elsewhere (a method in its child process).

    Without a terminal it prints a line every ten seconds instead: logs are read as lines. With `keep` false it leaves
    no line behind on the terminal, for bars between lines of other text.
    """

    def __init__(self, description: str, keep: bool = True) -> None:
        self._description = description
        self._bar: Any = None
        self._told = time.monotonic()
        if sys.stderr.isatty():
            from tqdm import tqdm

            form = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}{postfix}"
            self._bar = tqdm(total=1.0, desc=description, file=sys.stderr, ncols=90, bar_format=form, leave=keep)

    def update(self, fraction: float, message: str = "") -> None:
        """Move to `fraction` (never backwards) and show `message` behind the bar."""
        if self._bar is not None:
            step = min(1.0, fraction) - self._bar.n
            self._bar.set_postfix_str(message[:40], refresh=False)
            self._bar.update(max(0.0, step))
        elif time.monotonic() - self._told >= _LOG_INTERVAL_SECONDS:
            self._told = time.monotonic()
            print(f"{self._description}: {fraction:4.0%} {message}".rstrip(), file=sys.stderr, flush=True)

    def close(self) -> None:
        """Leave the bar as it stands and end its line."""
        if self._bar is not None:
            self._bar.close()

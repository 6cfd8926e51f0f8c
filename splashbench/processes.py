"""Processes that end together: whoever is stopped, killed or ends takes along what it started."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class Terminated(KeyboardInterrupt):
    """The process was asked to end by signal `signum`: cleaned up after like an interruption from the keyboard."""

    def __init__(self, signum: int) -> None:
        super().__init__(signum)
        self.signum = signum


@contextmanager
def terminable() -> Iterator[None]:
    """Turn SIGTERM and SIGHUP into `Terminated` meanwhile: staging folders are removed, child processes ended.

    Signals that are ignored (nohup) or that an embedding program handles stay as they are.
    """

    def stop(signum: int, frame: FrameType | None) -> None:
        raise Terminated(signum)

    mine = []
    if threading.current_thread() is threading.main_thread():
        mine = [number for number in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(number) == signal.SIG_DFL]
    for number in mine:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number in mine:
            signal.signal(number, signal.SIG_DFL)


def end_with_parent(parent: int | None = None) -> None:
    """Let the kernel kill this process when its parent dies without a word (SIGKILL); `parent`: its id, if known."""
    if sys.platform != "linux":
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if parent is not None and os.getppid() != parent:  # it died before we asked
        os.kill(os.getpid(), signal.SIGKILL)

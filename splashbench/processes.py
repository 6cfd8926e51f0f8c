"""Processes that end together: whoever is stopped, killed or ends takes along what it started.

Nothing heavy is imported, since the keeper of a method's process needs it (harness/keeper.py).
"""

from __future__ import annotations

import ctypes
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import subprocess

    import psutil

#: In the environment of everything that a watched process starts, with a value of its own for each.
RUN_MARK = "SPLASHBENCH_RUN"
_PR_SET_PDEATHSIG, _PR_SET_DUMPABLE, _PR_SET_CHILD_SUBREAPER = 1, 4, 36  # linux/prctl.h
# Until processes that were killed are gone.
_KILLED_SECONDS, _POLL_SECONDS = 5.0, 0.02
_LOOK_SECONDS = 0.05


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


def has_ended(process: subprocess.Popen) -> bool:
    """Whether `process` ended, asked so that an exception of a signal's handler does no harm at any point.

    `Popen.poll`, and `Popen.wait` with a timeout, take a lock in one step and see to its release in the next: an
    exception in between, such as `Terminated`, leaves the lock taken, and the next `wait` never returns.
    """
    if process.returncode is not None:
        return True
    if not hasattr(os, "waitid"):
        return process.poll() is not None
    try:
        return os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
    except ChildProcessError:  # somebody else has waited for it
        return True


def ends_within(process: subprocess.Popen, seconds: float) -> bool:
    """Whether `process` ends within `seconds` of looking at it; a machine that stands still in between does not count.

    A clock would count a pause of the whole machine, in which the process could not end either.
    """
    for _ in range(math.ceil(seconds / _LOOK_SECONDS)):
        if has_ended(process):
            return True
        time.sleep(_LOOK_SECONDS)
    return has_ended(process)


def end_with_parent(parent: int | None = None) -> None:
    """Let the kernel kill this process when its parent dies without a word (SIGKILL); `parent`: its id, if known."""
    if sys.platform != "linux":
        return
    _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if parent is not None and os.getppid() != parent:  # it died before we asked
        os.kill(os.getpid(), signal.SIGKILL)


def outlive_parent() -> None:
    """Undo `end_with_parent`."""
    _prctl(_PR_SET_PDEATHSIG, 0)


def adopt_orphans() -> None:
    """Become the parent of whatever a process below this one leaves behind, wherever that went (Linux)."""
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)


def deny_access() -> None:
    """Let no process of this user read this one's memory or take its sockets; root may (Linux)."""
    _prctl(_PR_SET_DUMPABLE, 0)


def limit_memory(max_bytes: int) -> None:
    """Let the kernel hold this process to so many bytes of address space, or to what it may have if that is less, and
    write no core file."""
    import resource

    _, most = resource.getrlimit(resource.RLIMIT_AS)
    limit = max_bytes if most == resource.RLIM_INFINITY else min(max_bytes, most)
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def end_descendants() -> list[str]:
    """Kill all processes below this one, which has adopted orphans; a line for each that was found alive."""
    found: list[str] = []
    deadline = time.monotonic() + _KILLED_SECONDS
    while time.monotonic() < deadline and (left := _children()):
        for process, name in left.items():
            with suppress(OSError):
                os.kill(process, signal.SIGKILL)
                found.append(f"{name} (process {process})")
        _reap()
        time.sleep(_POLL_SECONDS)
    _reap()
    return list(dict.fromkeys(found))


def marked_processes(variable: str, value: str) -> Iterator[psutil.Process]:
    """Processes that have `variable` with `value` in their environment, wherever they went."""
    import psutil

    for process in psutil.process_iter():
        try:
            found = process.environ().get(variable) == value
        except (psutil.Error, OSError):
            continue
        if found:
            yield process


def resident_bytes(process: int) -> dict[int, int]:
    """Resident bytes of `process` and of each below it, by their ids."""
    import psutil

    sizes: dict[int, int] = {}
    with suppress(psutil.Error):
        root = psutil.Process(process)
        for each in (root, *root.children(recursive=True)):
            with suppress(psutil.Error):
                sizes[each.pid] = each.memory_info().rss
    return sizes


def _children() -> dict[int, str]:
    """Processes whose parent this one is, and that have not ended, with their names."""
    own, found = os.getpid(), {}
    for entry in Path("/proc").iterdir() if Path("/proc").is_dir() else ():
        if not entry.name.isdigit():
            continue
        try:
            text = (entry / "stat").read_text(encoding="utf-8", errors="replace")
        except OSError:
            continue
        name, _, fields = text.partition("(")[2].rpartition(")")
        state, parent = fields.split()[:2]
        if int(parent) == own and state != "Z":
            found[int(entry.name)] = name
    return found


def _reap() -> None:
    with suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass


def _prctl(option: int, value: int) -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(option, value, 0, 0, 0)

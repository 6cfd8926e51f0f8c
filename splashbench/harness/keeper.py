"""The keeper: a process between the harness and a method's process, with none of the method's code in it.

It starts the method's process, stamps by its own clock what that tells, sees how it ends, and ends whatever it has left
behind, wherever that went. It reports to the harness through a socket that the method's process does not have. Nothing
heavy is imported, and no thread runs, before the method's process is forked off.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import sys
import time
from types import FrameType
from typing import Any

from splashbench.processes import adopt_orphans, deny_access, end_descendants, end_with_parent

_POLL_SECONDS = 0.02
# On a busy machine the keeper may be given a processor this much after a mark was made.
_LATE_SECONDS = 0.5
#: Of what a method's process tells: bytes of one phase, and marks.
_MAX_BYTES, _MAX_MARKS = 64 << 20, 10_000


def keep(request: str, descriptor: str) -> int:
    """Carry out the file `request` in a process of its own; report through the socket `descriptor`."""
    report = socket.socket(fileno=int(descriptor))
    report.set_inheritable(False)
    ours, theirs = socket.socketpair()
    adopt_orphans()
    keeper = os.getpid()
    process = os.fork()
    if process == 0:
        report.close()
        ours.close()
        return _carry_out(request, theirs, keeper)
    theirs.close()
    deny_access()
    stop = _Stop()
    started = time.monotonic()
    line = _Line(ours)
    status = _wait(process, line, stop)
    ended = time.monotonic()
    line.read_rest()
    strays = end_descendants()
    told: dict[str, Any] = {
        "started": started,
        "ended": ended,
        "marks": line.marks,
        "outcome": line.outcome,
        "strays": strays,
    }
    with contextlib.suppress(OSError):  # a harness that is gone wants no report
        report.sendall(json.dumps(told).encode())
    report.close()
    return _end_like(status)


def _carry_out(request: str, line: socket.socket, keeper: int) -> int:
    """Carry out the request: what the method's process does, which then ends like any other."""
    from splashbench.harness.channel import Channel
    from splashbench.harness.method_process import carry_out

    end_with_parent(keeper)
    return carry_out(request, Channel(line))


class _Stop:
    """Whether the harness asked to end: the method's time is up, or the user interrupted."""

    def __init__(self) -> None:
        self.asked = False
        signal.signal(signal.SIGTERM, self._ask)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.asked = True


class _Line:
    """What the method's process tells, stamped as it comes.

    Attributes:
        marks: (name, seconds of the monotonic clock). outcome: the last one that was told, or None.
    """

    def __init__(self, line: socket.socket) -> None:
        self.marks: list[tuple[str, float]] = []
        self.outcome: dict[str, Any] | None = None
        self._line, self._rest, self._bytes = line, b"", 0
        line.setblocking(False)

    def fileno(self) -> int:
        return self._line.fileno()

    def read(self) -> bool:
        """Take what has come; whether there may be more later."""
        now = time.monotonic()
        try:
            data = self._line.recv(1 << 16)
        except BlockingIOError:
            return True
        except OSError:
            return False
        self._bytes += len(data)
        if not data or self._bytes > _MAX_BYTES:
            return False
        *lines, self._rest = (self._rest + data).split(b"\n")
        for text in lines:
            self._take(text, now)
        return True

    def read_rest(self) -> None:
        """What was told before the process ended."""
        while select.select([self._line], [], [], 0)[0] and self.read():
            pass

    def _stamp(self, told: Any, now: float) -> float:
        """When a mark was made: as it tells, where that is after the one before and not long before it came."""
        least = max(now - _LATE_SECONDS, self.marks[-1][1] if self.marks else 0.0)
        return float(told) if isinstance(told, float) and least <= told <= now else now

    def _take(self, text: bytes, now: float) -> None:
        try:
            message = json.loads(text)
        except (ValueError, RecursionError):
            return
        if not isinstance(message, dict):
            return
        if isinstance(message.get("mark"), str) and len(self.marks) < _MAX_MARKS:
            self.marks.append((message["mark"][:40], self._stamp(message.get("at"), now)))
        if isinstance(message.get("outcome"), dict):
            self.outcome = message["outcome"]


def _wait(process: int, line: _Line, stop: _Stop) -> int:
    """Until `process` ends: stamp what it tells; returns its wait status. It is killed where the harness asks."""
    open_, killed = True, False
    while True:
        if open_:
            readable, _, _ = select.select([line], [], [], _POLL_SECONDS)
            open_ = line.read() if readable else True
        else:
            time.sleep(_POLL_SECONDS)
        if stop.asked and not killed:
            killed = True
            os.kill(process, signal.SIGKILL)
        found, status = os.waitpid(process, os.WNOHANG)
        if found:
            return status


def _end_like(status: int) -> int:
    """The exit code of the method's process; where a signal ended it, end by the same one."""
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        with contextlib.suppress(OSError, ValueError):  # SIGKILL has no handler to take away
            signal.signal(number, signal.SIG_DFL)
        sys.stdout.flush()
        sys.stderr.flush()
        os.kill(os.getpid(), number)
        time.sleep(1)  # not reached, unless the signal is one that ends nothing here
        return 128 + number
    return os.waitstatus_to_exitcode(status)

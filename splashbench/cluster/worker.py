"""The worker: a process that has imported what tasks need, and forks off a process for each.

A fork takes a hundredth of a second, where a new interpreter with its imports takes a second or two. The worker itself
carries out nothing, so that each task starts from the same state. It runs no thread before it forks.

It reads a line of JSON for each task and answers with another. The end of its input means that whoever gave it work is
gone or wants no more: the task that runs is ended then, and the worker too.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

from splashbench.child import main
from splashbench.processes import adopt_orphans, end_descendants, outlive_parent, resident_bytes

_POLL_SECONDS = 0.01
#: Between looks at a task's memory.
_MEMORY_SECONDS = 0.2
#: For a task that is asked to end, before it is killed.
_END_SECONDS = 15.0


def serve(modules: str) -> int:
    """Import `modules`, separated by commas, then carry out tasks until the input ends.

    A task is an object with `task`, `file`, `log`, `environment` and `memory_bytes`, see `work.Work`.
    """
    commands, answers = os.dup(0), os.dup(1)
    with Path(os.devnull).open("rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(2, 1)  # whatever a module prints is no answer
    # The end of the input says that the parent is gone, and leaves time to end what runs in an orderly way.
    outlive_parent()
    adopt_orphans()
    for module in modules.split(","):
        import_module(module)
    lines = _Lines(commands)
    while (line := lines.next()) is not None:
        given = json.loads(line)
        process = _forked(given, (commands, answers))
        status = _wait(process, lines, given["memory_bytes"])
        end_descendants()
        if status is None:
            return 0
        with contextlib.suppress(BrokenPipeError):
            os.write(answers, json.dumps({"exit_code": os.waitstatus_to_exitcode(status)}).encode() + b"\n")
    return 0


class _Lines:
    """The lines of a descriptor."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor, self._data = descriptor, b""

    def next(self) -> bytes | None:
        """The next line; None at the end."""
        while b"\n" not in self._data:
            piece = os.read(self._descriptor, 1 << 16)
            if not piece:
                return None
            self._data += piece
        line, _, self._data = self._data.partition(b"\n")
        return line

    def has_ended(self, seconds: float) -> bool:
        """Whether the input ends within `seconds`; a next task is not given before the last one is answered."""
        readable, _, _ = select.select([self._descriptor], [], [], seconds)
        return bool(readable) and not os.read(self._descriptor, 1)


def _forked(given: dict[str, Any], private: tuple[int, ...]) -> int:
    """Fork off the process of a task; returns its id."""
    parent = os.getpid()
    process = os.fork()
    if process:
        return process
    code = 1
    try:
        os.setsid()
        for descriptor in private:
            os.close(descriptor)
        log = os.open(given["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(log, 1)
        os.dup2(log, 2)
        os.close(log)
        for name, value in given["environment"].items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        code = main(str(parent), given["task"], given["file"])
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)  # what the worker does at its own end is not the task's


def _wait(process: int, lines: _Lines, memory_bytes: int | None) -> int | None:
    """The wait status of a task's process, once it has ended; None where it was ended since the input did."""
    looked = time.monotonic()
    while True:
        found, status = os.waitpid(process, os.WNOHANG)
        if found:
            return status
        if lines.has_ended(_POLL_SECONDS):
            _end(process)
            return None
        if memory_bytes is not None and time.monotonic() - looked > _MEMORY_SECONDS:
            _keep_below(memory_bytes, process)
            looked = time.monotonic()


def _end(process: int) -> None:
    """Let a task end what it started and then itself; kill it where that takes too long."""
    deadline = time.monotonic() + _END_SECONDS
    with contextlib.suppress(OSError):
        os.kill(process, signal.SIGTERM)
        while time.monotonic() < deadline:
            if os.waitpid(process, os.WNOHANG)[0]:
                return
            time.sleep(_POLL_SECONDS)
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)


def _keep_below(memory_bytes: int, process: int) -> None:
    """Kill the largest process of a task that takes more memory than it may, so that its run ends as if the system
    had done it."""
    sizes = resident_bytes(process)
    if sum(sizes.values()) > memory_bytes:
        with contextlib.suppress(OSError):
            os.kill(max(sizes, key=lambda pid: sizes[pid]), signal.SIGKILL)

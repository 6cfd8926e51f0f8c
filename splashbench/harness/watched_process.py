"""Running one child process under observation: wall time, peak memory of its whole tree, progress, a deadline.

However it ends, everything it started ends with it: its process group, and what left the group but inherited its mark.
Where the process is a keeper (keeper.py), whatever that one's process leaves ends too, and the keeper's report is read.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import time
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splashbench.errors import SplashbenchError
from splashbench.files import open_plain
from splashbench.processes import RUN_MARK, ends_within, has_ended, marked_processes, resident_bytes
from splashbench.progress import Bar

_POLL_SECONDS = 0.05
_LOG_TAIL_LINES = 20
_LOG_TAIL_BYTES = 20_000
_SILENT_SECONDS = 1.0
# A log may be of any size; of progress so much is read at a time.
_ANY_SIZE, _MOST_READ = 1 << 62, 1 << 20
# For a keeper to end what its process left, before it is killed itself.
_KEEPER_SECONDS = 8.0


@dataclass
class Watched:
    """How a process ended.

    Attributes:
        exit_code: negative for a signal. timed_out: whether the deadline killed it.
        log_tail: the last lines of its log. strays: processes that had left its group; they were killed.
        report: of a keeper, the fields of a `clock.Report`; None where it left none.
    """

    exit_code: int
    timed_out: bool
    peak_memory_bytes: int
    log_tail: list[str]
    seconds: float
    strays: list[str]
    report: dict[str, Any] | None = None


def watch(
    command: list[str],
    *,
    log: Path,
    progress: Path,
    label: str,
    timeout_seconds: float | None,
    show_log: bool = False,
    keep_bar: bool = True,
    kept: bool = False,
) -> Watched:
    """Run `command` in a process group of its own until it ends or its time is up.

    Args:
        log: the file that standard output and error go to.
        progress: the file whose lines "FRACTION MESSAGE", appended meanwhile, move the bar.
        show_log: show the log's last line while no such line comes.
        keep_bar: leave the bar on the terminal.
        kept: whether `command` is a keeper, which takes the descriptor of a socket as its last argument.

    Memory is the sum of resident sizes over the process tree. It is looked at, and the time measured, every 50 ms.
    """
    environment = dict(os.environ)
    environment[RUN_MARK] = mark = uuid.uuid4().hex
    # Idle OpenMP threads that spin take the renderer's cores: twice the time on two cores.
    environment.setdefault("OMP_WAIT_POLICY", "passive")
    reports, theirs = socket.socketpair()
    with log.open("wb") as stream, theirs:
        process = subprocess.Popen(
            [*command, str(theirs.fileno())] if kept else command,
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env=environment,
            pass_fds=[theirs.fileno()] if kept else (),
        )
    report = _ReportReader(reports)
    start, peak, timed_out = time.monotonic(), 0, False
    bar = Bar(label, keep_bar)
    reader = ProgressReader(progress)
    last_update, fraction = start, 0.0
    try:
        while not has_ended(process):
            peak = max(peak, _tree_memory(process.pid, kept))
            report.read()
            for fraction, message in reader.new():
                bar.update(fraction, message)
                last_update = time.monotonic()
            if show_log and time.monotonic() - last_update > _SILENT_SECONDS:
                bar.update(fraction, " ".join(_tail(log)[-1:]))
                last_update = time.monotonic()
            if timeout_seconds is not None and time.monotonic() - start > timeout_seconds:
                timed_out = True
                break
            time.sleep(_POLL_SECONDS)
        seconds = time.monotonic() - start
        for fraction, message in reader.new():
            bar.update(fraction, message)
    finally:
        # Also when the user interrupts, and again while this lasts: a method may have started processes of its own.
        try:
            if kept:
                _ask_to_end(process)
        finally:
            try:
                _kill_group(process)
            finally:
                strays = _kill_marked(mark, process.pid)
        bar.close()
        told = report.close()
    strays += told["strays"] if told else []
    return Watched(process.wait(), timed_out, peak, _tail(log), seconds, strays, told)


class _ReportReader:
    """Takes what a keeper reports as it comes, so that neither waits for the other."""

    def __init__(self, line: socket.socket) -> None:
        self._line, self._data = line, b""
        line.setblocking(False)

    def read(self) -> None:
        with contextlib.suppress(BlockingIOError, ConnectionError):
            while piece := self._line.recv(1 << 20):
                self._data += piece

    def close(self) -> dict[str, Any] | None:
        """The whole report; None where there is none, since the keeper was killed or there was no keeper."""
        self.read()
        self._line.close()
        try:
            report: dict[str, Any] = json.loads(self._data)
        except ValueError:
            return None
        return report


def _ask_to_end(process: subprocess.Popen) -> None:
    """Let a keeper that runs still end what it keeps, wherever that went, and then itself."""
    if not has_ended(process):
        process.terminate()
        ends_within(process, _KEEPER_SECONDS)


def _tree_memory(pid: int, kept: bool) -> int:
    """Resident bytes of the process and what it started; of a keeper, only of what it keeps."""
    sizes = resident_bytes(pid)
    return sum(sizes.values()) - (sizes.get(pid, 0) if kept else 0)


def _kill_group(process: subprocess.Popen) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _kill_marked(mark: str, group: int) -> list[str]:
    """Kill whoever inherited `mark`; a line for each that had left the process group, as daemons do."""
    import psutil

    strays = []
    for process in marked_processes(RUN_MARK, mark):
        with contextlib.suppress(psutil.Error, OSError):
            if os.getpgid(process.pid) != group:
                strays.append(f"{process.name()} (process {process.pid})")
            process.kill()
    return strays


class ProgressReader:
    """Whole new lines of the progress file since the last look."""

    def __init__(self, path: Path) -> None:
        self._path, self._position = path, 0

    def new(self) -> list[tuple[float, str]]:
        try:
            with open_plain(self._path, _ANY_SIZE) as (stream, _):
                stream.seek(self._position)
                data = stream.read(_MOST_READ)
        except (OSError, SplashbenchError):  # not there yet; or the process has put something else there
            return []
        end = data.rfind(b"\n") + 1
        self._position += end
        lines = []
        for line in data[:end].decode("utf-8", "replace").splitlines():
            number, _, message = line.partition(" ")
            try:
                lines.append((float(number), message))
            except ValueError:
                continue
        return lines


def _tail(log: Path) -> list[str]:
    try:
        with open_plain(log, _ANY_SIZE) as (stream, size):
            stream.seek(max(0, size - _LOG_TAIL_BYTES))
            text = stream.read(_LOG_TAIL_BYTES).decode("utf-8", "replace")
    except (OSError, SplashbenchError):  # the process has removed it, or put something else there
        return []
    return [line.rstrip()[:300] for line in text.splitlines() if line.strip()][-_LOG_TAIL_LINES:]

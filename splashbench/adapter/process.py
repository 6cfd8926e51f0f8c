"""Running one child process under observation: wall time, peak memory of its whole tree, progress, a deadline."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from splashbench.progress import Bar

_POLL_SECONDS = 0.05
_LOG_TAIL_LINES = 20


@dataclass
class Watched:
    """How a process ended: its exit code (negative: the signal), whether the deadline killed it, peak memory."""

    exit_code: int
    timed_out: bool
    peak_memory_bytes: int
    log_tail: list[str]


def run_watched(
    arguments: list[str],
    *,
    log: Path,
    progress: Path,
    label: str,
    timeout_seconds: float | None,
    keep_bar: bool = True,
) -> Watched:
    """Run `python ARGUMENTS` in a process group of its own until it ends or its time is up.

    Standard output and error go to `log`; lines "FRACTION MESSAGE" appended to `progress` move the bar, which
    stays on the terminal with `keep_bar`. Memory is the sum of resident sizes over the process tree, sampled every
    50 ms.
    """
    environment = dict(os.environ)
    # Idle OpenMP threads that spin steal the renderer's cores (research: twice the time on two cores).
    environment.setdefault("OMP_WAIT_POLICY", "passive")
    with log.open("wb") as stream:
        process = subprocess.Popen(
            [sys.executable, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env=environment,
        )
    start, peak, timed_out = time.monotonic(), 0, False
    bar = Bar(label, keep_bar)
    reader = _ProgressReader(progress)
    try:
        while process.poll() is None:
            peak = max(peak, _tree_memory(process.pid))
            for fraction, message in reader.new():
                bar.update(fraction, message)
            if timeout_seconds is not None and time.monotonic() - start > timeout_seconds:
                timed_out = True
                break
            time.sleep(_POLL_SECONDS)
        for fraction, message in reader.new():
            bar.update(fraction, message)
    finally:
        # Also when the user interrupts: a method may have started processes of its own.
        _kill_group(process)
        bar.close()
    return Watched(process.wait(), timed_out, peak, _tail(log))


def _tree_memory(pid: int) -> int:
    import psutil

    total = 0
    try:
        root = psutil.Process(pid)
        for process in [root, *root.children(recursive=True)]:
            try:
                total += process.memory_info().rss
            except psutil.Error:
                continue
    except psutil.Error:
        return 0
    return total


def _kill_group(process: subprocess.Popen) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


class _ProgressReader:
    """Whole new lines of the progress file since the last look."""

    def __init__(self, path: Path) -> None:
        self._path, self._position = path, 0

    def new(self) -> list[tuple[float, str]]:
        if not self._path.is_file():
            return []
        with self._path.open("rb") as stream:
            stream.seek(self._position)
            data = stream.read()
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
    text = log.read_bytes()[-20_000:].decode("utf-8", "replace")
    return [line.rstrip()[:300] for line in text.splitlines() if line.strip()][-_LOG_TAIL_LINES:]

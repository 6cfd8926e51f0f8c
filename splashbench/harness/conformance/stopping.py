"""Stopping a run in the middle of its fit, by its time limit or a signal, and looking at what is left."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splashbench.harness.conformance import held
from splashbench.progress import Bar

#: Every process of a test inherits this variable, with a value of its own: what is left behind is told by it.
MARK = "SPLASHBENCH_CONFORMANCE"
_POLL_SECONDS = 0.05
#: Until a run that was asked to stop has cleaned up, and killed processes are gone.
_PATIENCE_SECONDS = 20.0
_KILLED_SECONDS = 3.0


@dataclass
class Stopped:
    """How a run ended that was stopped.

    Attributes:
        held: whether the fit was under way and held up when it ended.
        exit_code: of the run, negative for a signal; None where it did not end when it was asked to.
        said: its last line on standard error.
        seconds: from the request to the end, or for a time limit from the start.
    """

    held: bool
    exit_code: int | None
    said: str
    seconds: float


def stop_run(
    arguments: list[str],
    *,
    method: str,
    report: int,
    work: Path,
    signum: signal.Signals | None,
    timeout_seconds: float,
    label: str,
) -> Stopped:
    """`splashbench run Held ARGUMENTS`, held up at its progress report number `report`, then sent `signum`.

    Without a signal it is left to the limit among its arguments. `timeout_seconds`: for getting to the report.
    """
    work.mkdir(parents=True, exist_ok=True)
    flag, log = work / "held", work / "log"
    environment = os.environ | {held.METHOD: method, held.REPORT: str(report), held.FLAG: str(flag)}
    command = [sys.executable, "-m", "splashbench", "run", f"{held.__file__}:Held", *arguments]
    with log.open("wb") as stream:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )
    bar, start = Bar(label, keep=False), time.monotonic()
    try:
        while process.poll() is None and not flag.exists() and time.monotonic() - start < timeout_seconds:
            time.sleep(_POLL_SECONDS)
            bar.update((time.monotonic() - start) / timeout_seconds, "until the middle of the fit")
        was_held = flag.exists()
        if signum is not None and process.poll() is None:
            start = time.monotonic()
            process.send_signal(signum)
        # With a limit of its own, the rest of that limit is still to come.
        patience = _PATIENCE_SECONDS if signum is not None else timeout_seconds + _PATIENCE_SECONDS
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(patience)
        lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
        said = next((line for line in reversed(lines) if line.strip()), "")
        return Stopped(was_held or flag.exists(), process.poll(), said[:300], time.monotonic() - start)
    finally:
        bar.close()
        if process.poll() is None:  # it does not stop, or the user interrupts the test
            process.send_signal(signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_KILLED_SECONDS)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def processes_left(mark: str) -> list[str]:
    """Kill the processes that carry `mark` and live on after those of the harness; a line for each."""
    import psutil

    def alive() -> list[Any]:
        return [process for process in psutil.process_iter() if _carries(process, mark)]

    until = time.monotonic() + _KILLED_SECONDS  # for those that the harness has killed already
    while (left := alive()) and time.monotonic() < until:
        time.sleep(_POLL_SECONDS)
    lines = []
    for process in left:
        with contextlib.suppress(psutil.Error):
            lines.append(f"{process.name()} (process {process.pid})")
            process.kill()
    return lines


def _carries(process: Any, mark: str) -> bool:
    import psutil

    try:
        return (
            process.pid != os.getpid()
            and process.status() != psutil.STATUS_ZOMBIE
            and process.environ().get(MARK) == mark
        )
    except (psutil.Error, OSError):
        return False


def ignores_interrupts() -> bool:
    """Whether this process, and so each that it starts, ignores Ctrl-C, as in the background of a script."""
    return signal.getsignal(signal.SIGINT) == signal.SIG_IGN


def as_pairs(overrides: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Settings as `--set` takes them: `{"a": {"b": 1}}` -> `["a.b=1"]`."""
    pairs = []
    for key, value in overrides.items():
        if isinstance(value, Mapping):
            pairs += as_pairs(value, f"{prefix}{key}.")
        else:
            pairs.append(f"{prefix}{key}={json.dumps(value)}")
    return pairs

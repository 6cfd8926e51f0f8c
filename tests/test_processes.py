"""Waiting for child processes, whatever signals come meanwhile."""

import itertools
import os
import random
import signal
import subprocess
import sys
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from splashbench import processes
from splashbench.processes import Terminated, ends_within, has_ended


def _stop(signum: int, frame: object) -> None:
    raise Terminated(signum)


def _interrupted(process: subprocess.Popen, look: Callable[[subprocess.Popen], object], times: int) -> int:
    """How often the lock of `process` stayed taken when `look`, called over and over, was interrupted `times` times."""
    locked, chance = 0, random.Random(0)
    before = signal.signal(signal.SIGPROF, _stop)
    try:
        for _ in range(times):
            try:
                signal.setitimer(signal.ITIMER_PROF, chance.uniform(1e-4, 5e-3))
                while True:
                    look(process)
            except Terminated:
                pass
            if process._waitpid_lock.locked():
                process._waitpid_lock.release()
                locked += 1
    finally:
        signal.signal(signal.SIGPROF, before)
    return locked


def test_an_interruption_locks_nobody_out() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        assert _interrupted(process, has_ended, 300) == 0
        process.communicate(b"\n")
    assert has_ended(process)


def test_whether_a_process_has_ended() -> None:
    with subprocess.Popen([sys.executable, "-c", "input(); raise SystemExit(3)"], stdin=subprocess.PIPE) as process:
        assert not has_ended(process)
        assert not ends_within(process, 0)
        process.stdin.write(b"\n")
        process.stdin.close()
        assert ends_within(process, 60)
        assert has_ended(process)
        assert process.wait() == 3  # looking takes nothing away
    assert has_ended(process)


def test_a_process_that_somebody_else_has_waited_for() -> None:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process._waitpid_lock.acquire()
    os.waitpid(process.pid, 0)
    process._waitpid_lock.release()
    assert has_ended(process)
    process.wait()


def test_a_machine_that_stands_still_uses_up_no_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that ends at the 50th look, with a minute lost at each of them."""
    looks, clock = iter([*[False] * 49, True]), itertools.count(0, 60)
    monkeypatch.setattr(processes, "has_ended", lambda process: next(looks))
    monkeypatch.setattr(processes.time, "sleep", lambda seconds: None)
    monkeypatch.setattr(processes.time, "monotonic", lambda: next(clock))
    assert ends_within(SimpleNamespace(), 20)
    monkeypatch.setattr(processes, "has_ended", lambda process: False)
    assert not ends_within(SimpleNamespace(), 20)

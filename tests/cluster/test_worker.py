"""Workers: every task has a process of its own and ends with all it has started, whatever it does."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from splashbench.cluster.local import LocalWorkers
from splashbench.cluster.work import Ended, Needs, Work
from splashbench.cluster.worker_process import WorkerProcess

HERE = Path(__file__).parent


@pytest.fixture
def workers(monkeypatch: pytest.MonkeyPatch) -> Iterator[LocalWorkers]:
    monkeypatch.syspath_prepend(str(HERE))
    with LocalWorkers(2, ["tasks"]) as workers:
        yield workers


def _work(task: str, folder: Path, **needs: int) -> Work:
    return Work(task, f"tasks:{task}", folder / task, folder / f"{task}.log", Needs(**needs))


def _ended(workers: LocalWorkers) -> Ended:
    found: list[Ended] = []
    _wait_for(lambda: bool(found.extend(workers.wait()) or found))
    return found[0]


def _wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _running(text: str) -> list[int]:
    """Processes with `text` in their command line."""
    found = []
    for process in psutil.process_iter():
        try:
            if any(text in word for word in process.cmdline()) and process.pid != os.getpid():
                found.append(process.pid)
        except psutil.Error:
            continue
    return found


def test_a_task_has_a_process_a_log_and_an_exit_code(workers: LocalWorkers, tmp_path: Path) -> None:
    assert workers.room(Needs()) == 2
    workers.start(_work("write", tmp_path, cores=1))
    assert workers.room(Needs()) == 1
    assert _ended(workers) == Ended("write", 3)
    assert workers.room(Needs()) == 2
    assert (tmp_path / "write.log").read_text() == "written\n"
    process, parent, _, threads = (tmp_path / "write.done").read_text().split()
    assert process != parent
    assert threads == "1"


def test_a_task_that_fails_leaves_its_traceback(workers: LocalWorkers, tmp_path: Path) -> None:
    workers.start(_work("fail", tmp_path))
    assert _ended(workers) == Ended("fail", 1)
    assert (tmp_path / "fail.log").read_text().splitlines()[-1] == "RuntimeError: the matrix is singular"


def test_the_next_task_starts_from_the_same_imports_and_sees_nothing_of_the_last_one(
    workers: LocalWorkers, tmp_path: Path
) -> None:
    said = []
    for task in ("write", "leave_a_mark", "die", "write"):
        workers.start(_work(task, tmp_path))
        assert _ended(workers).lost == ""
        if task == "write":
            said.append((tmp_path / "write.done").read_text().split()[1:])
    # The same worker, which has imported once; and its environment.
    assert said[0] == said[1]


def test_a_signal_is_a_negative_exit_code(workers: LocalWorkers, tmp_path: Path) -> None:
    workers.start(_work("die", tmp_path))
    assert _ended(workers) == Ended("die", -signal.SIGKILL)


def test_what_a_task_leaves_behind_ends(workers: LocalWorkers, tmp_path: Path) -> None:
    workers.start(_work("leave", tmp_path))
    assert _ended(workers) == Ended("leave", 0)
    assert _running(str(tmp_path / "leave")) == []


def test_a_task_that_takes_too_much_memory_is_killed(workers: LocalWorkers, tmp_path: Path) -> None:
    workers.start(_work("eat", tmp_path, memory_bytes=400_000_000))
    assert _ended(workers) == Ended("eat", -signal.SIGKILL)


def test_what_runs_when_workers_are_left_is_stopped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(str(HERE))
    with LocalWorkers(1, ["tasks"]) as workers:
        workers.start(_work("hang", tmp_path))
        _wait_for(lambda: (tmp_path / "hang.done").exists())
        _wait_for(lambda: _running(str(tmp_path / "hang")) != [])
    assert _running(str(tmp_path / "hang")) == []


def test_a_worker_that_is_killed_is_lost_and_leaves_nothing(workers: LocalWorkers, tmp_path: Path) -> None:
    workers.start(_work("hang", tmp_path))
    _wait_for(lambda: (tmp_path / "hang.done").exists())
    (worker,) = [process for process in psutil.Process().children() if process.children()]
    worker.kill()
    ended = _ended(workers)
    assert ended.lost == "its worker was killed by signal 9"
    workers.start(_work("write", tmp_path))
    assert _ended(workers) == Ended("write", 3)


def test_a_worker_whose_parent_is_killed_ends_what_it_carries_out(tmp_path: Path) -> None:
    hang, log = str(tmp_path / "hang"), str(tmp_path / "log")
    code = (
        "import sys; from pathlib import Path; from splashbench.cluster.local import LocalWorkers;"
        "from splashbench.cluster.work import Work\n"
        "with LocalWorkers(1, ['tasks']) as workers:\n"
        f"    workers.start(Work('hang', 'tasks:hang', Path({hang!r}), Path({log!r})))\n"
        "    while True: workers.wait()\n"
    )
    folders = os.pathsep.join([str(HERE), *sys.path])
    process = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": folders})
    _wait_for(lambda: (tmp_path / "hang.done").exists())
    process.kill()
    process.wait()
    _wait_for(lambda: _running(hang) == [])


def test_a_module_that_cannot_be_imported_is_a_lost_worker(tmp_path: Path) -> None:
    worker = WorkerProcess(["no_such_module"])
    worker.start(_work("write", tmp_path))
    assert worker.answer() is None
    assert "No module named 'no_such_module'" in worker.why_lost()

"""A process under observation: its exit, its progress, and what it leaves."""

import sys
from pathlib import Path

from splashbench.harness.watched_process import ProgressReader, Watched, watch


def _watched(tmp_path: Path, code: str, timeout_seconds: float | None = None) -> Watched:
    return watch(
        [sys.executable, "-c", code],
        log=tmp_path / "log",
        progress=tmp_path / "progress",
        label="test",
        timeout_seconds=timeout_seconds,
    )


def test_progress_is_read_in_whole_lines_once(tmp_path: Path) -> None:
    path = tmp_path / "progress"
    reader = ProgressReader(path)
    assert reader.new() == []
    path.write_text("0.25 first\nno number\n0.5 sec")
    assert reader.new() == [(0.25, "first")]
    with path.open("a") as stream:
        stream.write("ond half\n")
    assert reader.new() == [(0.5, "second half")]
    assert reader.new() == []


def test_the_end_of_a_process_is_its_exit_code_and_last_lines(tmp_path: Path) -> None:
    watched = _watched(tmp_path, "print(*range(30), sep='\\n\\n'); raise SystemExit(3)")
    assert (watched.exit_code, watched.timed_out, watched.strays) == (3, False, [])
    assert watched.log_tail == [str(i) for i in range(10, 30)]


def test_a_process_that_takes_too_long_is_killed(tmp_path: Path) -> None:
    watched = _watched(tmp_path, "import time; time.sleep(60)", timeout_seconds=0.5)
    assert watched.timed_out
    assert watched.exit_code == -9
    assert 0.5 < watched.seconds < 30

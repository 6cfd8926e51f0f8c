"""A full disk, signals, closed streams: one line, no process and no half-written file left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from splashbench.cli.main import main
from splashbench.submission import Submission

METHODS = Path(__file__).parents[1] / "harness" / "example_methods.py"
GOOD = f"import sys\nsys.path.insert(0, {str(METHODS.parent)!r})\nfrom example_methods import Good\n"
# As large as a disk that is nearly full: every file beyond it fails with EFBIG (Python ignores SIGXFSZ).
DISK_OF = (
    # Python would cache half a module, and load it from then on.
    "import resource, sys; sys.dont_write_bytecode = True; resource.setrlimit(resource.RLIMIT_FSIZE, ({0}, {0})); "
    "from splashbench.cli.main import main; sys.exit(main(sys.argv[1:]))"
)


def command(*words: object, code: str | None = None) -> list[str]:
    start = [sys.executable, "-m", "splashbench"] if code is None else [sys.executable, "-c", code]
    return [*start, *map(str, words)]


@pytest.mark.parametrize("name", ["balls", "oracle", "method", "score", "leaderboard", "prepare"])
def test_a_full_disk_is_one_line_and_leaves_nothing(
    name: str, balls_directory: Path, truth: Path, results: Path, session: Path, tmp_path: Path
) -> None:
    out = tmp_path / "place" / "out"
    out.parent.mkdir()
    words: dict[str, list[object]] = {
        "balls": ["synth", "scene", "balls", out],
        "oracle": ["run", "oracle", balls_directory, out],
        "method": ["run", "hull_points", balls_directory, out, "--timing-frames", 0],
        "score": ["score", truth, "--scene", balls_directory, "--out", out],
        "leaderboard": ["leaderboard", results, out],
        "prepare": ["prepare", session, out],
    }
    code = DISK_OF.format(3000)
    if name == "prepare":  # the clips are no rig: what its stages write stands in for them
        code = (
            "from splashbench.prepare import pipeline; from splashbench.files import write_text; "
            "pipeline._run_stages = lambda *given: write_text(given[-1] / 'train_meta.json', 'x' * 9999); " + code
        )
    done = subprocess.run(command(*words[name], code=code), capture_output=True, text=True, timeout=60)
    lines = done.stderr.splitlines()
    assert done.returncode == 1
    assert [line for line in lines if "error" in line] == lines[-1:]
    assert f"{out}" in lines[-1]
    assert "could not be written: the disk is full; free some space" in lines[-1]
    assert list(out.parent.iterdir()) == []


SLOW = (
    GOOD + "import os, time\nclass M(Good):\n    def fit(self, scene, config, run):\n"
    "        with open(os.environ['STARTED'] + '.part', 'w') as stream:\n            stream.write(str(os.getpid()))\n"
    "        os.rename(os.environ['STARTED'] + '.part', os.environ['STARTED'])\n        time.sleep(60)\n"
)


def is_alive(pid: int) -> bool:
    """Whether process `pid` still runs (one that is dead but not waited for does not)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGKILL])
def test_a_stopped_run_takes_its_method_along_and_can_be_run_again(
    number: signal.Signals, balls_directory: Path, tmp_path: Path
) -> None:
    (tmp_path / "m.py").write_text(SLOW)
    started, place = tmp_path / "started", tmp_path / "place"
    place.mkdir()
    process = subprocess.Popen(
        command("run", f"{tmp_path / 'm.py'}:M", balls_directory, place / "out"),
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"STARTED": str(started), "TMPDIR": str(tmp_path)},
        # A test run that was started in the background, or by nohup, ignores these, and so would this.
        preexec_fn=lambda: [signal.signal(each, signal.SIG_DFL) for each in (signal.SIGINT, signal.SIGHUP)],
    )
    for _ in range(300):
        if started.exists():
            break
        time.sleep(0.1)
    pid = int(started.read_text())
    assert is_alive(pid)
    process.send_signal(number)
    _, said = process.communicate(timeout=20)
    for _ in range(50):
        if not is_alive(pid):
            break
        time.sleep(0.1)
    assert not is_alive(pid)
    if number == signal.SIGKILL:
        assert [path.name.startswith(".tmp-") for path in place.iterdir()] == [True]
    else:
        assert process.returncode == 128 + number
        assert said.strip() == "interrupted; nothing half-written was left"
        assert list(place.iterdir()) == []
    assert main(["run", "oracle", str(balls_directory), str(place / "out")]) == 0


def test_two_runs_into_one_place_leave_one_whole_submission(balls_directory: Path, tmp_path: Path) -> None:
    words = command("run", f"{METHODS}:Good", balls_directory, tmp_path / "out", "--timing-frames", 0)
    both = [subprocess.Popen(words, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    said = {process.communicate(timeout=60)[1].split(":")[0]: process.returncode for process in both}
    assert said == {"good": 0, "error": 1}
    assert Submission.open(tmp_path / "out").status == "ok"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize(
    ("redirection", "status", "said"),
    [
        (">&-", 0, ""),
        (">&- 2>&-", 0, ""),
        ("> /dev/full", 1, "error: standard output"),
        ("| :", 141, ""),
    ],
)
def test_a_closed_or_full_standard_output_is_no_traceback(
    balls_directory: Path, redirection: str, status: int, said: str
) -> None:
    if redirection == "> /dev/full" and not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    line = f"set -o pipefail; '{sys.executable}' -m splashbench scene info '{balls_directory}' {redirection}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, timeout=60)
    assert done.returncode == status
    assert done.stderr.startswith(said)
    assert len(done.stderr.splitlines()) == bool(said)

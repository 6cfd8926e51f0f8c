"""The one entry of child processes: exit codes, a full disk, and an end with the parent."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from splashbench.child import DISK_FULL_EXIT, child_command, raise_if_disk_was_full
from splashbench.errors import DiskFullError
from splashbench.harness import method_process

TASKS = """
import sys
from splashbench.errors import DiskFullError

def arguments(*words):
    print(*words)
    return 3

def full(path):
    print("before", file=sys.stderr)
    raise DiskFullError(f"{path} could not be written")
"""


def _child(tmp_path: Path, parent: int, *words: str) -> subprocess.CompletedProcess[str]:
    (tmp_path / "tasks.py").write_text(TASKS)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(tmp_path))
        start = child_command(method_process.carry_out)[:-2]
    return subprocess.run([*start, str(parent), *words], capture_output=True, text=True)


def test_a_task_gets_its_arguments_as_text_and_gives_the_exit_code(tmp_path: Path) -> None:
    done = _child(tmp_path, os.getpid(), "tasks:arguments", "a b", "1")
    assert (done.stdout, done.returncode) == ("a b 1\n", 3)


def test_a_full_disk_is_an_exit_code_and_a_line_that_the_parent_raises_again(tmp_path: Path) -> None:
    done = _child(tmp_path, os.getpid(), "tasks:full", "model.npz")
    assert done.returncode == DISK_FULL_EXIT
    with pytest.raises(DiskFullError, match=r"^model.npz could not be written$"):
        raise_if_disk_was_full(done.returncode, done.stderr.splitlines())
    raise_if_disk_was_full(1, ["another fault"])
    raise_if_disk_was_full(DISK_FULL_EXIT, ["curl: (28) Operation timed out"])
    with pytest.raises(DiskFullError, match="free some space"):
        raise_if_disk_was_full(DISK_FULL_EXIT, [])


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's signal at a parent's death is Linux's")
def test_a_child_whose_parent_is_gone_does_nothing(tmp_path: Path) -> None:
    done = _child(tmp_path, os.getppid(), "tasks:arguments", "anything")
    assert (done.stdout, done.returncode) == ("", -9)


def test_a_command_names_task_and_parent() -> None:
    words = child_command(method_process.carry_out, Path("request.json"))
    assert words[-3:] == [str(os.getpid()), "splashbench.harness.method_process:carry_out", "request.json"]


def test_code_in_the_folder_one_stands_in_is_not_run(tmp_path: Path) -> None:
    folder = tmp_path / "downloaded"
    folder.mkdir()
    for module in ("json", "numpy", "pydantic", "splashbench"):
        (folder / f"{module}.py").write_text("open('ran', 'w').close()\n")
    start = child_command(method_process.carry_out)[:-2]
    done = subprocess.run(
        [*start, str(os.getpid()), "splashbench.harness.method_process:carry_out", "nothing.json"],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert not (folder / "ran").exists()
    assert done.returncode != 0
    assert "nothing.json" in done.stderr


def test_a_run_in_a_strangers_folder_runs_none_of_its_code(balls_directory: Path, tmp_path: Path) -> None:
    folder = tmp_path / "downloaded"
    folder.mkdir()
    (folder / "json.py").write_text("open('ran', 'w').close()\nraise SystemExit(7)\n")
    tool = Path(sys.executable).with_name("splashbench")
    words = [str(tool), "run", "nearest_camera", str(balls_directory), str(tmp_path / "out")]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "ok" in done.stderr + done.stdout
    assert not (folder / "ran").exists()

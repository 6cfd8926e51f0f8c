"""`splashbench methods test` for people, for programs, and for whoever loses patience."""

import json
import os
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import pytest

from splashbench.cli.main import main

METHODS = Path(__file__).parents[1] / "harness" / "conformance" / "methods_for_conformance.py"


def test_each_check_is_a_line_and_a_fault_comes_with_its_remedy(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["methods", "test", f"{METHODS}:Rounds", "--only", "files", "load", "again"]
    assert main([*words, "--json"]) == 1
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert [line.split()[:2] for line in lines[:3]] == [["ok", "files"], ["FAILED", "load"], ["ok", "again"]]
    assert "differs from the model in memory, as" in lines[1]
    assert "Remedy: save everything that render() needs, in full precision" in lines[1]
    assert lines[-1].startswith("error: sky: 1 of 3 checks failed")
    told = json.loads(captured.out)
    assert (told["method"], told["preset"], told["passed"]) == ("sky", "quick", False)
    assert [(check["name"], check["verdict"]) for check in told["checks"]] == [
        ("files", "ok"),
        ("load", "failed"),
        ("again", "ok"),
    ]
    assert told["checks"][0]["remedy"] == ""
    assert told["checks"][1]["remedy"]


def test_a_sound_method_is_exit_0_and_standard_output_stays_empty(capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        main(["methods", "test", f"{METHODS}:Sky", "--only", "metadata", "--preset", "best", "--set", "steps=2"]) == 0
    )
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "sky: keeps the contract" in captured.err


@pytest.mark.parametrize("words", [["--only", "all"], ["--scene", "nowhere"], ["--set", "step=1"], ["--device", "tpu"]])
def test_bad_options_are_one_line(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["methods", "test", f"{METHODS}:Sky", *words]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_stopped_in_a_fit_it_leaves_no_process_and_no_folder(tmp_path: Path) -> None:
    started, temporary = tmp_path / "started", tmp_path / "temporary"
    temporary.mkdir()
    mark = uuid.uuid4().hex
    words = ["methods", "test", f"{METHODS}:Slow", "--set", f"place={started}"]
    process = subprocess.Popen(
        [sys.executable, "-m", "splashbench", *words],
        env=os.environ | {"TMPDIR": str(temporary), "SPLASHBENCH_TEST_MARK": mark},
        stderr=subprocess.PIPE,
        text=True,
    )
    until = time.monotonic() + 120
    while not started.exists() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 143
    assert errors.splitlines()[-1] == "interrupted; nothing half-written was left"
    assert list(temporary.iterdir()) == []
    left = [entry.name for entry in Path("/proc").iterdir() if entry.name.isdigit() and mark in _environment(entry)]
    assert left == []


def _environment(process: Path) -> str:
    try:
        return (process / "environ").read_text(errors="replace")
    except OSError:
        return ""

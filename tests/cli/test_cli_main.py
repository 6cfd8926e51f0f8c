"""The command line as a whole: one line and exit status 1 for bad input, JSON on standard output, a script."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from splashbench.cli.main import main


@pytest.mark.parametrize(
    "words",
    [
        ["scene", "info", "nowhere"],
        ["scene", "check", "nowhere"],
        ["check", "nowhere"],
        ["run", "nothing", "nowhere", "out"],
        ["run", "no_such_method", "nowhere", "out"],
        ["prepare", "nowhere", "out"],
        ["score", "nowhere", "--scene", "nowhere", "--out", "out"],
        ["leaderboard", "nowhere", "out"],
        ["methods", "show", "no_such_method"],
    ],
    ids=" ".join,
)
def test_bad_input_is_one_line_and_exit_1(
    words: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    assert "nowhere" in lines[0] or "no_such_method" in lines[0]
    assert list(tmp_path.iterdir()) == []


def test_json_is_one_object_on_standard_output(balls_directory: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scene", "info", str(balls_directory), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["name"] == "balls"
    assert main(["methods", "list", "--json"]) == 0
    ids = {row["id"] for row in json.loads(capsys.readouterr().out)["methods"]}
    assert {"splashsplat", "scaffold_gs", "nothing", "nearest_camera", "oracle"} <= ids


def test_the_module_runs_as_a_script() -> None:
    result = subprocess.run(
        [sys.executable, "-m", "splashbench", "--version"], capture_output=True, text=True, check=True
    )
    assert result.stdout.startswith("splashbench ")

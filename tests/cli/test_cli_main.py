"""The command line: help with examples everywhere, one line and exit 1 for bad input, exit 2 for wrong usage."""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import pytest

from splashbench.cli.main import build_parser, main


def _commands() -> list[list[str]]:
    found = []

    def walk(parser: argparse.ArgumentParser, words: list[str]) -> None:
        children = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
        found.append(words)
        for action in children:
            for name, child in action.choices.items():
                walk(child, [*words, name])

    walk(build_parser(), [])
    return found


@pytest.mark.parametrize("words", _commands(), ids=lambda words: " ".join(words) or "splashbench")
def test_every_command_explains_itself(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([*words, "--help"])
    assert stop.value.code == 0
    assert "usage: splashbench" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words", [words for words in _commands() if len(words) == 1], ids=lambda words: " ".join(words)
)
def test_every_command_shows_an_example(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([*words, "--help"])
    assert f"splashbench {words[0]} " in capsys.readouterr().out.split("example")[-1]


def test_wrong_usage_is_exit_2(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["run", "splashsplat"])
    assert stop.value.code == 2


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

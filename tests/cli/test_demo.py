"""`splashbench demo`: what it skips, what it removes, and when it has passed; the steps themselves are commands."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from splashbench.cli import demo
from splashbench.errors import SplashbenchError


class _Parser:
    """Stands in for the command line: notes each command, makes the file it names, and ends with `status`."""

    def __init__(self) -> None:
        self.commands: list[list[str]] = []
        self.status = 0

    def parse_args(self, words: list[str]) -> argparse.Namespace:
        self.commands.append(words)
        Path(words[-1]).write_text("output")
        return argparse.Namespace(handler=lambda _: self.status)


@pytest.fixture
def parser(monkeypatch: pytest.MonkeyPatch) -> _Parser:
    stand_in = _Parser()
    monkeypatch.setattr("splashbench.cli.main.build_parser", lambda: stand_in)
    return stand_in


def test_what_exists_is_skipped_until_a_step_runs(
    tmp_path: Path, parser: _Parser, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second, third, results = outputs = [tmp_path / name for name in ("1", "2", "3", "results")]
    for path in (first, third):
        path.write_text("before")
    results.mkdir()
    steps = demo._Steps(outputs)
    steps.run("film", first, ["film", str(first)])
    steps.run("prepare", second, ["prepare", str(second)])
    steps.run("score", third, ["score", str(third)])
    assert [words[0] for words in parser.commands] == ["prepare", "score"]
    assert [path.read_text() for path in (first, second, third)] == ["before", "output", "output"]
    assert not results.exists()
    assert f"[1] film: skipped, {first} exists" in capsys.readouterr().err


def test_a_step_that_fails_ends_the_demo_and_leaves_nothing_that_was_made_from_its_output(
    tmp_path: Path, parser: _Parser
) -> None:
    parser.status = 1
    (tmp_path / "2").write_text("made from another 1")
    with pytest.raises(SplashbenchError, match=r"the demo stopped at: splashbench film .*; see the lines above"):
        demo._Steps([tmp_path / "1", tmp_path / "2"]).run("film", tmp_path / "1", ["film", str(tmp_path / "1")])
    assert not (tmp_path / "2").exists()


@pytest.mark.parametrize(
    ("value", "at_most", "passed"),
    [
        *[(0.9, True, True), (1.0, True, True), (1.1, True, False)],
        *[(0.9, False, False), (1.0, False, True), (1.1, False, True)],
        *[(None, True, False), (None, False, False)],
    ],
)
def test_a_gate_passes_on_its_side_of_the_limit(value: float | None, at_most: bool, passed: bool) -> None:
    gate = demo._Gate("error", value, 1.0, at_most)
    assert gate.passed is passed
    assert gate.row()[-1] == ("pass" if passed else "FAIL")


def test_a_folder_becomes_the_demos_only_where_it_is_empty(tmp_path: Path) -> None:
    demo._claim(tmp_path / "out", 0, None)
    demo._claim(tmp_path / "out", 0, None)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "scene").write_bytes(b"dear")
    with pytest.raises(SplashbenchError, match="holds files that are not the demo's"):
        demo._claim(tmp_path / "photos", 0, demo._Steps([tmp_path / "photos" / "scene"]))
    assert (tmp_path / "photos" / "scene").read_bytes() == b"dear"


def test_outputs_of_another_seed_or_version_are_not_shown_as_those_of_this_one(tmp_path: Path) -> None:
    out = tmp_path / "out"
    demo._claim(out, 0, None)
    (out / "scene").mkdir()
    with pytest.raises(SplashbenchError, match=r"holds the demo of seed 0, .*, and this is seed 1, .* add --fresh"):
        demo._claim(out, 1, None)
    demo._claim(out, 1, demo._Steps([out / "scene"]))
    assert not (out / "scene").exists()
    demo._claim(out, 1, None)
    (out / demo._MARK).write_text("Made by `splashbench demo`, which may replace everything here.\n")
    with pytest.raises(SplashbenchError, match="holds the demo of an earlier version"):
        demo._claim(out, 1, None)


def test_fresh_that_was_stopped_leaves_nothing_that_is_shown_as_this_demos(tmp_path: Path) -> None:
    out = tmp_path / "out"
    demo._claim(out, 0, None)

    class Stopped(demo._Steps):
        def forget(self, first: int) -> None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        demo._claim(out, 1, Stopped([]))
    for seed in (0, 1):
        with pytest.raises(SplashbenchError, match=r"a run that was stopped while it removed outputs, .* add --fresh"):
            demo._claim(out, seed, None)
    demo._claim(out, 1, demo._Steps([]))
    demo._claim(out, 1, None)


def test_the_demo_ends_with_a_video_and_all_its_commands_exist(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from splashbench.cli.main import build_parser

    commands: list[argparse.Namespace] = []
    parser = build_parser()

    class Noting:
        def parse_args(self, words: list[str]) -> argparse.Namespace:
            commands.append(parser.parse_args(words))
            return argparse.Namespace(handler=lambda _: 0)

    monkeypatch.setattr("splashbench.cli.main.build_parser", Noting)
    monkeypatch.setattr(demo, "_gates", lambda *_: [demo._Gate("error", 0.5, 1.0, True)])
    out = tmp_path / "out"
    assert demo.run(parser.parse_args(["demo", str(out)])) == 0
    last = commands[-1]
    assert (last.command, last.beside, last.slow) == ("video", ["truth"], 2)
    assert (last.submission, last.out) == (out / "submissions" / "splashsplat", out / "splashsplat.mp4")
    assert f"{out / 'splashsplat.mp4'}    the reconstruction beside the truth" in (out / "README.txt").read_text()

"""Damaged, hostile and impossible sessions: one line that names the file, and no scene."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from splashbench.cli.main import main

Fails = Callable[..., str]


def silent_clip(path: Path) -> None:
    import av

    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=20)
        stream.width, stream.height, stream.pix_fmt = 64, 36, "yuv420p"
        for _ in range(20):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((36, 64, 3), np.uint8), format="rgb24")))
        container.mux(stream.encode(None))


def rewrite(session: Path, old: str, new: str) -> None:
    text = (session / "session.toml").read_text()
    assert old in text
    (session / "session.toml").write_text(text.replace(old, new, 1))


POUR_2 = '2 = [\n    "2.MP4",\n]'


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda s: silent_clip(s / "2.MP4"), "2.MP4 has no audio track"),
        (lambda s: (s / "2.MP4").write_bytes((s / "2.MP4").read_bytes()[:9000]), "2.MP4 is damaged, cut short"),
        (lambda s: (s / "2.MP4").write_bytes(b""), "2.MP4 is damaged, cut short"),
        (lambda s: (s / "2.MP4").write_text("#EXTM3U\nfile:///etc/passwd\n"), "2.MP4 is damaged, cut short"),
        (lambda s: (s / "2.MP4").unlink(), "2.MP4 (the pour recording of camera 2) does not exist"),
        (lambda s: ((s / "2.MP4").unlink(), (s / "2.MP4").mkdir()), "2.MP4 (the pour recording of camera 2)"),
        (lambda s: ((s / "2.MP4").unlink(), (s / "2.MP4").symlink_to(sys.executable)), "lies outside the session"),
        (lambda s: rewrite(s, '"2.MP4"', '"../../../x.MP4"'), "lies outside the session"),
        (lambda s: rewrite(s, '"2.MP4"', '"/etc/passwd"'), "lies outside the session"),
        (lambda s: rewrite(s, '"2.MP4"', '"1.MP4"'), "1.MP4 is listed twice in [recordings.pour]"),
        (lambda s: rewrite(s, '"2.MP4"', '"\\u0000"'), "unusable name"),
        (lambda s: rewrite(s, POUR_2, ""), "camera 2 has no entry in [recordings.pour]"),
        (lambda s: rewrite(s, "square_metres = 0.03", "square_metres = nan"), "board.square_metres"),
        (lambda s: rewrite(s, "squares_x = 8", "squares_x = -8"), "board.squares_x"),
        (lambda s: (s / "session.toml").write_bytes(b'name = "\xff"'), "session.toml cannot be read as TOML"),
        (lambda s: (s / "session.toml").write_text("a = " + "[" * 100_000), "session.toml cannot be read as TOML"),
        (lambda s: ((s / "session.toml").unlink(), (s / "session.toml").mkdir()), "session.toml is a folder"),
        (lambda s: (s / "session.toml").unlink(), "--init` writes it by looking at the recordings"),
    ],
)
def test_an_unusable_session_is_one_line_and_no_scene(
    session: Path, tmp_path: Path, fails: Fails, damage: Callable[[Path], object], message: str
) -> None:
    damage(session)
    line = fails("prepare", session, tmp_path / "scenes" / "scene")
    assert message in line
    assert not (tmp_path / "scenes").exists() or list((tmp_path / "scenes").iterdir()) == []


@pytest.mark.parametrize("options", [["--interval", "0", "inf"], ["--interval", "2", "1"], ["--masks", "nowhere"]])
def test_bad_options_of_prepare_are_told_before_the_work(
    session: Path, tmp_path: Path, fails: Fails, options: list[str]
) -> None:
    assert options[-1] in fails("prepare", session, tmp_path / "scene", *options)
    assert not (tmp_path / "scene").exists()


def test_a_truth_of_the_wrong_shape_is_named(session: Path, balls_directory: Path, fails: Fails) -> None:
    (session / "truth").mkdir()
    for text in ("", "[]", "{}", '{"schema_version": 1}', "\0"):
        (session / "truth" / "truth.json").write_text(text)
        assert "truth.json" in fails("synth", "verify", session, balls_directory)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--square-metres", "0.03", "SCENE"], "--square-metres goes with --init"),
        (["SCENE", "--init"], "--init writes session.toml and makes no scene; leave SCENE out"),
        ([], "the following arguments are required: SCENE"),
    ],
)
def test_options_of_prepare_that_do_not_go_together_are_wrong_usage(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["prepare", "SESSION", *words])
    assert stop.value.code == 2
    assert message in capsys.readouterr().err

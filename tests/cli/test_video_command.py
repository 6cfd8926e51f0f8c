"""`splashbench video`: what it writes and prints, what it refuses in one line, and how it ends when it is stopped."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import av
import pytest

from splashbench.cli.main import main
from splashbench.cli.video import LAYERS
from splashbench.harness.runner import run_method
from splashbench.scene import Scene
from splashbench.submission import Submission
from splashbench.video import layers

Fails = Callable[..., str]


@pytest.fixture(scope="module")
def points(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """hull_points' submission of the balls, with its model; not to be changed."""
    directory = tmp_path_factory.mktemp("videos") / "points"
    run_method("hull_points", balls_directory, directory, overrides={"points": 300, "cells": 32}, timing_frames=0)
    return directory


def facts(path: Path) -> tuple[int, float, tuple[int, int]]:
    """Frames, frames a second, and (width, height) of a video."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        return sum(1 for _ in container.decode(stream)), float(stream.average_rate), (stream.width, stream.height)


def test_the_command_line_knows_the_layers() -> None:
    assert layers.LAYERS == LAYERS


def test_a_video_is_written_and_told(points: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "points.mp4"
    assert main(["video", str(points), str(out), "--slow", "2", "--no-caption", "--json"]) == 0
    captured = capsys.readouterr()
    told = json.loads(captured.out)
    assert facts(out) == (told["frames"], 30, (96, 64))
    assert (told["frames"], told["fps"], told["panels"]) == (len(told["times"]), 30, ["hull_points"])
    assert f"wrote {out}: {told['frames']} frames of 96x64" in captured.err


def test_a_scene_is_needed_for_photographs_alone(
    points: Path, truth: Path, balls_directory: Path, tmp_path: Path
) -> None:
    scene = ["--scene", str(balls_directory)]
    assert main(["video", str(points), str(tmp_path / "a.mp4"), *scene, "--beside", "truth", str(truth)]) == 0
    frames, fps, (width, height) = facts(tmp_path / "a.mp4")
    # The oracle keeps no model: a frame for each timestep, in real time.
    assert (frames, width) == (8, 3 * 96)
    assert fps == pytest.approx(20, abs=5)
    assert height > 64
    assert main(["video", str(points), str(tmp_path / "b.gif"), *scene, "--wipe", "truth", "--divider", "0.5"]) == 0
    assert main(["video", str(points), str(tmp_path / "c"), *scene, "--layer", "error", "--range", "0", "1"]) == 0
    told = json.loads((tmp_path / "c" / "frames.json").read_text())
    assert main(["video", str(points), str(tmp_path / "c"), "--orbit", "--orbit-height", "20", "--replace"]) == 0
    orbit = json.loads((tmp_path / "c" / "frames.json").read_text())
    assert (told["panels"], orbit["panels"]) == (["hull_points, error"], ["hull_points"])
    assert len(list((tmp_path / "c").glob("*.png"))) == orbit["frames"]


def test_a_scene_is_opened_once_for_all_that_are_compared(
    points: Path, truth: Path, balls_directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Path] = []
    real = Scene.open
    monkeypatch.setattr(Scene, "open", lambda path, *more, **named: opened.append(path) or real(path, *more, **named))
    words = ["--scene", str(balls_directory), "--beside", str(truth), str(points), "--end", "0.1"]
    assert main(["video", str(points), str(tmp_path / "a.mp4"), *words]) == 0
    assert opened == [balls_directory]


def test_a_fitted_submission_is_as_it_was(points: Path, tmp_path: Path) -> None:
    assert main(["video", str(points), str(tmp_path / "a.mp4")]) == 0
    assert Submission.open(points).status == "ok"


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (["out.avi"], "ends in .avi"),
        (["SUBMISSION/out.mp4"], "whose files are sealed; give a place outside it"),
        (["SUBMISSION"], "whose files are sealed"),
        (["FILE"], "FILE is a file"),
        (["FILE/out.mp4"], "FILE is a file"),
        (["FOLDER.mp4"], "is a folder; give the name of a file"),
        (["out.mp4", "--view", "9"], "there is no camera '9'"),
        (["out.mp4", "--beside", "truth"], "give --scene"),
        (["out.mp4", "--layer", "error"], "give --scene"),
        (["out.mp4", "--layer", "depth"], "hands in none"),
        (["out.mp4", "--beside", "nowhere"], "nowhere is no submission"),
        (["out.mp4", "--beside", *["truth"] * 6], "--beside takes 5 at most"),
        (["out.mp4", "--path", "nowhere.json"], "nowhere.json does not exist"),
        (["out.mp4", "--orbit-height", "10"], "--orbit-height has no effect without --orbit"),
        (["out.mp4", "--orbit-degrees", "10"], "--orbit-degrees has no effect"),
        (["out.mp4", "--divider", "0.5"], "--divider has no effect without --wipe"),
        (["out.mp4", "--flat", "ff0000"], "--flat has no effect without --layer liquid"),
        (["out.mp4", "--range", "0", "1"], "--range has no effect"),
        (["out.mp4", "--layer", "opacity", "--range", "1", "0"], "give the lower end first"),
        (["out.mp4", "--fps", "0.001"], "give another --fps"),
        (["out.mp4", "--slow", "1e9"], "more than 100000 frames"),
        (["out.mp4", "--start", "5"], "beyond the recording"),
        (["out.mp4", "--resize", "0.00001"], "1x1"),
        (["out.mp4", "--resize", "99"], "more than 8192"),
        (["out.gif", "--fps", "60"], "a GIF cannot have 60 frames a second"),
    ],
)
def test_what_cannot_be_is_one_line_and_writes_nothing(
    words: list[str], fault: str, points: Path, tmp_path: Path, fails: Fails, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("FILE").write_text("mine")
    Path("FOLDER.mp4").mkdir()
    if fault == "1x1":  # the smallest picture there is, and no fault
        assert main(["video", str(points), *words, "--no-caption"]) == 0
        assert facts(Path("out.mp4"))[2] == (2, 2)
        return
    assert fault in fails("video", points, *(word.replace("SUBMISSION", str(points)) for word in words))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["FILE", "FOLDER.mp4"]


@pytest.mark.parametrize(
    "words",
    [
        *(["--fps", value] for value in ("nan", "inf", "0", "-1", "1e9", "many")),
        *(["--slow", value] for value in ("nan", "0", "-1")),
        *(["--start", value] for value in ("nan", "inf", "early")),
        *(["--resize", value] for value in ("nan", "0", "1000")),
        *(["--orbit", "--orbit-degrees", value] for value in ("nan", "0", "361")),
        *(["--orbit", "--orbit-height", value] for value in ("nan", "90")),
        ["--layer", "sparkle"],
        ["--layer", "opacity", "--range", "0", "nan"],
        ["--layer", "liquid", "--flat", "blue"],
        ["--wipe", "truth", "--divider", "2"],
        ["--wipe", "truth", "--beside", "truth"],
        ["--view", "6", "--orbit"],
        ["--slow", "2", "--seconds", "2"],
    ],
)
def test_wrong_usage_is_told_by_the_parser(
    words: list[str], points: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["video", str(points), str(tmp_path / "out.mp4"), *words])
    assert stop.value.code == 2
    assert "error: argument" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_views_that_no_model_can_render_are_one_line(truth: Path, tmp_path: Path, fails: Fails) -> None:
    assert "keeps no model" in fails("video", truth, tmp_path / "a.mp4", "--orbit")
    assert "keeps no model" in fails("video", truth, tmp_path / "a.mp4", "--view", "1")
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_may_not_be_written_is_told_before_the_work(
    points: Path, tmp_path: Path, fails: Fails, monkeypatch: pytest.MonkeyPatch
) -> None:
    (locked := tmp_path / "locked").mkdir()
    # Root, as which tests often run, may write everywhere.
    monkeypatch.setattr("splashbench.files.places.os.access", lambda path, mode: Path(path) != locked)
    monkeypatch.setattr("splashbench.replay.load", lambda *_, **__: pytest.fail("there was work"))
    for name in ("a.mp4", "a.gif", "a"):
        assert f"{locked} may not be written" in fails("video", points, locked / name)


@pytest.mark.parametrize("name", ["out.mp4", "out.gif", "out"])
def test_a_full_disk_leaves_no_video(name: str, points: Path, tmp_path: Path) -> None:
    place = tmp_path / "place"
    place.mkdir()
    # As large as a disk that is nearly full. Python would cache half a module, and load it from then on.
    code = (
        "import resource, sys; sys.dont_write_bytecode = True; "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000)); "
        "from splashbench.cli.main import main; sys.exit(main(sys.argv[1:]))"
    )
    words = [sys.executable, "-c", code, "video", str(points), str(place / name), "--resize", "3"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1, done.stderr
    assert "could not be written: the disk is full; free some space" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
    assert list(place.iterdir()) == []


@pytest.mark.skipif(sys.platform != "linux", reason="sends signals")
@pytest.mark.parametrize("name", ["out.mp4", "out"])
def test_a_video_that_is_stopped_leaves_nothing(name: str, points: Path, tmp_path: Path) -> None:
    place = tmp_path / "place"
    place.mkdir()
    words = [sys.executable, "-m", "splashbench", "video", str(points), str(place / name), "--slow", "3000"]
    process = subprocess.Popen(
        words,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ,
        # A test run that was started in the background ignores it, and so would this.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    for _ in range(300):
        if any(place.iterdir()):
            break
        time.sleep(0.1)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert said.strip().endswith("interrupted; nothing half-written was left")
    assert "Traceback" not in said
    assert list(place.iterdir()) == []


def test_a_folder_that_is_no_earlier_video_stays(
    points: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "mine"
    place.mkdir()
    (place / "frames.json").write_text("[1]")
    (place / "thesis.txt").write_text("years")
    assert main(["video", str(points), str(place), "--timesteps", "--replace"]) == 1
    assert "frames.json is of something else" in capsys.readouterr().err
    assert (place / "thesis.txt").read_text() == "years"
    (tmp_path / "link.mp4").symlink_to("nowhere")
    assert main(["video", str(points), str(tmp_path / "link.mp4")]) == 1
    os.mkfifo(tmp_path / "pipe.mp4")
    assert main(["video", str(points), str(tmp_path / "pipe.mp4"), "--replace"]) == 1


@pytest.mark.parametrize("slow", ["1e308", "1e-320", "0", "nan"])
def test_an_absurd_speed_is_wrong_usage(slow: str, points: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        main(["video", str(points), str(tmp_path / "a.mp4"), "--slow", slow])

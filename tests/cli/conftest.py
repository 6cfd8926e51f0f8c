"""Fixtures of the command line's tests: a command that must fail, a submission, its result, a recorded session."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from splashbench import toml
from splashbench.cli.main import main
from splashbench.harness.runner import run_method
from splashbench.synth.recording.video import write_recording

Fails = Callable[..., str]


@pytest.fixture
def fails(capsys: pytest.CaptureFixture[str]) -> Fails:
    """Run a command that must fail; returns its one error line, after checking that it is one, and the last."""

    def run(*words: object) -> str:
        capsys.readouterr()
        assert main([str(word) for word in words]) == 1
        captured = capsys.readouterr()
        lines = captured.err.splitlines()
        assert [line for line in lines if line.startswith("error: ")] == lines[-1:]
        assert "Traceback" not in captured.err
        assert lines[-1].isprintable()
        return lines[-1]

    return run


@pytest.fixture(scope="session")
def truth(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The oracle's submission of the balls; not to be changed."""
    directory = tmp_path_factory.mktemp("submissions") / "oracle"
    run_method("oracle", balls_directory, directory)
    return directory


@pytest.fixture
def submission(truth: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(truth, tmp_path / "oracle"))


@pytest.fixture(scope="session")
def results(truth: Path, balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the oracle's result."""
    directory = tmp_path_factory.mktemp("scored") / "results"
    assert main(["score", str(truth), "--scene", str(balls_directory), "--out", str(directory)]) == 0
    return directory


def clip(path: Path) -> None:
    rng = np.random.default_rng(7)
    frames = (rng.integers(0, 255, (36, 64, 3), dtype=np.uint8) for _ in range(20))
    write_recording(path, frames, 20, (0.1 * rng.standard_normal(48_000)).astype(np.float32))


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session whose files can be read; noise has been filmed."""
    directory = tmp_path_factory.mktemp("recorded") / "session"
    for camera in ("1", "2", "3"):
        clip(directory / f"{camera}.MP4")
    chapters = {camera: [f"{camera}.MP4"] for camera in ("1", "2", "3")}
    description = {
        "schema_version": 1,
        "name": "noise",
        "cameras": ["1", "2", "3"],
        "train": ["1", "2"],
        "test": ["3"],
        "board": {"squares_x": 8, "squares_y": 5, "square_metres": 0.03, "marker_metres": 0.02}
        | {"dictionary": "DICT_4X4_50"},
        "recordings": dict.fromkeys(("pour", "static", "intrinsics"), chapters),
    }
    (directory / "session.toml").write_text(toml.dumps(description))
    return directory


@pytest.fixture
def session(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "recordings" / "session"))

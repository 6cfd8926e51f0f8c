"""The time that a run may take is told from earlier ones like it, or not at all."""

from pathlib import Path

import pytest

from splashbench.harness import estimates
from splashbench.harness.runner import run_method
from splashbench.synth.balls import write_balls_scene

METHODS = Path(__file__).with_name("example_methods.py")


def _lines(scene: Path, out: Path, **options) -> list[str]:
    lines: list[str] = []
    run_method(f"{METHODS}:Good", scene, out, timing_frames=0, tell=lines.append, **options)
    return [line for line in lines if "left from" not in line]  # of tests that were killed


def test_an_estimate_is_what_earlier_fits_took(
    balls_directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLASHBENCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(estimates, "TOLD_SECONDS", 0.0)
    assert _lines(balls_directory, tmp_path / "1") == []
    (line,) = _lines(balls_directory, tmp_path / "2")
    assert line == "about 0 s to fit, as one fit with these settings of this scene took on this machine"
    (line,) = _lines(balls_directory, tmp_path / "3", seed=7)
    assert "2 fits with these settings" in line
    # Other settings, and a scene of another size, tell nothing of each other.
    assert _lines(balls_directory, tmp_path / "4", preset="blue") == []
    larger = write_balls_scene(tmp_path / "larger", size=(192, 128)).directory
    assert _lines(larger, tmp_path / "5") == []


def test_a_cache_that_cannot_be_written_costs_no_run(
    balls_directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("SPLASHBENCH_CACHE", str(tmp_path / "file" / "cache"))
    assert _lines(balls_directory, tmp_path / "out") == []


def test_a_fit_of_a_moment_needs_no_estimate(
    balls_directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLASHBENCH_CACHE", str(tmp_path / "cache"))
    for number in range(2):
        assert _lines(balls_directory, tmp_path / str(number)) == []

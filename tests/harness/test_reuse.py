"""Times of runs that share a part: what an ordinary run would not spend does not count."""

import time
from pathlib import Path

from splashbench.harness.contract import Run
from splashbench.scene import Scene

SAVING, LOADING = 0.3, 0.2


def _run_with_part(cache: Path, scene: Scene) -> tuple[Run, float]:
    """A run that fits or loads a part, and the seconds that it took."""

    def save(part: str, directory: Path) -> None:
        time.sleep(SAVING)
        (directory / "part.txt").write_text(part)

    def load(directory: Path) -> str:
        time.sleep(LOADING)
        return (directory / "part.txt").read_text()

    run, start = Run(cache=cache), time.perf_counter()
    assert run.reuse("part", scene.training(), {"setting": 1}, lambda: "fitted", save, load) == "fitted"
    return run, time.perf_counter() - start


def test_waiting_reading_and_writing_are_no_part_of_a_fit(balls: Scene, tmp_path: Path) -> None:
    run, seconds = _run_with_part(tmp_path / "cache", balls)
    assert run.reused == {}
    assert seconds - run.fit_seconds(seconds) >= SAVING
    run, seconds = _run_with_part(tmp_path / "cache", balls)
    assert list(run.reused) == ["part"]
    assert seconds + run.reused["part"] - run.fit_seconds(seconds) >= LOADING


def test_without_a_folder_to_share_everything_is_fitted(balls: Scene) -> None:
    run = Run()
    assert run.reuse("part", balls.training(), {}, lambda: 3, _never, _never) == 3
    assert run.fit_seconds(2.0) == 2.0


def _never(*_: object) -> int:
    raise AssertionError

"""Parts that runs share: fitted once, told in the record, and never missing from the fit time."""

import time
from pathlib import Path

import numpy as np
import pytest

from splashbench.harness.contract import Run
from splashbench.harness.reuse import training_digest
from splashbench.scene import Scene
from splashbench_methods.scaffold_gs import BackgroundSettings, fit_background, shared_background


def _part(run: Run, balls: Scene, value: str = "a", seconds: float = 0.0, **key: object) -> str:
    def fit() -> str:
        time.sleep(seconds)
        return value

    def save(text: str, directory: Path) -> None:
        (directory / "part.txt").write_text(text)

    return run.reuse("part", balls.training(), key, fit, save, lambda directory: (directory / "part.txt").read_text())


def test_an_ordinary_run_fits_everything(balls: Scene) -> None:
    run = Run()
    assert _part(run, balls, "a") == "a"
    assert _part(run, balls, "b") == "b"
    assert run.reused == {}
    assert run.fit_seconds(3.0) == 3.0


def test_a_part_is_fitted_once_and_its_time_counts_each_time(balls: Scene, tmp_path: Path) -> None:
    first, second = Run(cache=tmp_path), Run(cache=tmp_path)
    assert _part(first, balls, "a", seconds=0.4) == "a"
    assert _part(second, balls, "b", seconds=0.4) == "a"
    assert first.reused == {}
    assert second.reused["part"] == pytest.approx(0.4, abs=0.1)
    # The second run took no time; what it would have taken alone is the first one's.
    assert second.fit_seconds(0.0) == second.reused["part"]


def test_another_key_seed_device_or_scene_is_another_part(balls: Scene, balls_copy: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    assert _part(Run(cache=cache), balls, "a", anchors=1) == "a"
    assert _part(Run(cache=cache), balls, "b", anchors=2) == "b"
    assert _part(Run(cache=cache, seed=1), balls, "c", anchors=1) == "c"
    assert _part(Run(cache=cache, device="cuda"), balls, "d", anchors=1) == "d"
    mask = balls.mask_path("1", 0).relative_to(balls.directory)
    (balls_copy / mask).write_bytes((balls_copy / "seg/1/000007.png").read_bytes())
    changed = Scene.open(balls_copy)
    assert training_digest(changed.training()) != training_digest(balls.training())
    assert _part(Run(cache=cache), changed, "e", anchors=1) == "e"
    assert _part(Run(cache=cache), balls, "f", anchors=1) == "a"


def test_a_part_that_no_seed_changes_is_shared_by_all_seeds(balls: Scene, tmp_path: Path) -> None:
    def part(run: Run, value: str) -> str:
        def save(text: str, directory: Path) -> None:
            (directory / "part.txt").write_text(text)

        def load(directory: Path) -> str:
            return (directory / "part.txt").read_text()

        return run.reuse("part", balls.training(), {}, lambda: value, save, load, seeded=False)

    assert part(Run(cache=tmp_path, seed=0), "a") == "a"
    assert part(Run(cache=tmp_path, seed=1), "b") == "a"
    assert part(Run(cache=tmp_path, seed=1, device="cuda"), "c") == "c"


def test_a_shared_background_renders_to_the_same_bytes(balls: Scene, tmp_path: Path) -> None:
    settings = BackgroundSettings(iterations=3, max_anchors=200, longest_side=48)
    alone = fit_background(balls.training(), settings, Run(seed=1))
    fitted = shared_background(balls.training(), settings, Run(seed=1, cache=tmp_path))
    run = Run(seed=1, cache=tmp_path)
    loaded = shared_background(balls.training(), settings, run)
    assert list(run.reused) == ["background"]
    camera = balls.cameras["6"]
    np.testing.assert_array_equal(fitted.render(camera), alone.render(camera))
    np.testing.assert_array_equal(loaded.render(camera), alone.render(camera))

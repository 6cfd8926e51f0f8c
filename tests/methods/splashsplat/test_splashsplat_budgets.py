"""Budgets of seconds and bytes: kept, spent on finer grids where there is more, and recorded with their evidence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splashbench.files import tree_bytes
from splashbench.harness.contract import Run
from splashbench.scene import Scene
from splashbench.submission import Budget
from splashbench_methods.splashsplat import SplashSplat
from splashbench_methods.splashsplat.affordable import background_update, with_cells, within_seconds
from splashbench_methods.splashsplat.appearance.schedule import LOWEST, Clock, TimedSchedule
from splashbench_methods.splashsplat.method import FittedSplashSplat
from splashbench_methods.splashsplat.settings import SplashSplatConfig

SMALL = {"hull_cells": 64, "transport_cells": 32, "control_cells": 8, "iterations": 60, "voxel_pixels": 0}


def fit(scene: Scene, budget: Budget, **settings: object) -> tuple[FittedSplashSplat, Run]:
    run = Run(budget=budget)
    config = SplashSplat.Config.preset("quick", SMALL | settings)
    return SplashSplat().fit(scene.training(), config, run), run


def stored_bytes(fitted: FittedSplashSplat, directory: Path) -> int:
    directory.mkdir()
    fitted.save(directory)
    return tree_bytes(directory)


def test_bytes_are_kept_by_coarser_grids_fewer_carriers_and_longer_steps(balls: Scene, tmp_path: Path) -> None:
    free, _ = fit(balls, Budget())
    full = stored_bytes(free, tmp_path / "free")
    sizes = []
    for number, share in enumerate((0.6, 0.3)):
        limit = round(share * full)
        fitted, run = fit(balls, Budget(storage_bytes=limit))
        sizes.append(stored_bytes(fitted, tmp_path / str(number)))
        assert sizes[-1] <= 1.05 * limit
        spent = [decision for decision in run.decisions if decision.basis == "budget"]
        assert spent
        assert all(any(rung.bought for rung in decision.rungs) for decision in spent)
        camera, time = balls.cameras["6"], float(balls.times[2])
        loaded = SplashSplat().load(tmp_path / str(number), balls.training())
        np.testing.assert_array_equal(loaded.render(camera, time).rgb, fitted.render(camera, time).rgb)
    assert sizes[1] < sizes[0]


def test_a_budget_that_nothing_exceeds_changes_nothing(balls: Scene) -> None:
    free, _ = fit(balls, Budget())
    roomy, run = fit(balls, Budget(storage_bytes=10**9))
    assert [decision.basis for decision in run.decisions] == ["tolerance"]
    for name, arrays in free.liquid.arrays.items():
        for key, array in arrays.items():
            np.testing.assert_array_equal(roomy.liquid.arrays[name][key], array)


def test_less_than_nothing_fits_into_is_still_a_model(balls: Scene, tmp_path: Path) -> None:
    fitted, _ = fit(balls, Budget(storage_bytes=1))
    fitted.save(tmp_path)
    camera, time = balls.cameras["6"], float(balls.times[2])
    assert np.isfinite(SplashSplat().load(tmp_path, balls.training()).render(camera, time).rgb).all()


def test_seconds_choose_the_grids_by_how_long_the_draft_took(balls: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    cells = []
    for seconds in (1.0, 600.0):
        fitted, run = fit(balls, Budget(seconds=seconds), iterations=20, hull_cells=160, transport_cells=80)
        decision = next(found for found in run.decisions if found.name == "grids for the seconds")
        assert sum(rung.bought for rung in decision.rungs) == 1
        cells.append(max(fitted.liquid.grid.shape))
        if seconds == 1.0:
            assert decision.chosen.endswith("as the draft")
        assert any(found.name == "self-calibration" for found in run.decisions) is (seconds == 1.0)
    assert cells[1] > cells[0]


def test_the_draft_has_as_many_iterations_as_time_allows(balls: Scene) -> None:
    config = SplashSplatConfig.preset("quick", SMALL | {"iterations": 5000})
    assert isinstance(config, SplashSplatConfig)
    found = within_seconds(balls.training(), config, Run(budget=Budget(seconds=0.5)))
    assert found.traced is not None
    assert found.traced.config.iterations == found.config.iterations == 5000


def test_a_schedule_by_the_clock_ends_in_time_or_at_its_limit() -> None:
    now = [10.0]
    schedule = TimedSchedule(1000, Clock(lambda: now[0], 20.0))
    assert schedule.factor(0) == pytest.approx(1)
    now[0] = 15.0
    assert schedule.factor(3) == pytest.approx(LOWEST + (1 - LOWEST) / 2)
    assert schedule.done(900) == pytest.approx(0.9)
    assert schedule.factor(1000) is None
    now[0] = 20.0
    assert schedule.factor(4) is None
    assert not schedule.due(100)
    late = TimedSchedule(1000, Clock(lambda: 30.0, 20.0))
    assert late.factor(0) == pytest.approx(1)  # no clock runs backwards, but one may have run out before


def test_coarser_grids_keep_their_proportions() -> None:
    config = SplashSplatConfig.preset("best")
    assert isinstance(config, SplashSplatConfig)
    half = with_cells(config, 150)
    assert (half.hull_cells, half.transport_cells, half.control_cells) == (150, 75, 19)
    assert with_cells(config, 400) == config
    small = background_update(config, Run(budget=Budget(storage_bytes=200_000)))
    assert small["max_anchors"] < 1500
    assert background_update(config, Run()) == {}

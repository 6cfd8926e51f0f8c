"""Budgets of seconds, bytes and memory: kept, spent on finer grids where there is more, told with their evidence."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.files import tree_bytes
from splashbench.harness.contract import Run
from splashbench.scene import Scene
from splashbench.submission import Budget
from splashbench_methods.splashsplat import SplashSplat, affordable_memory
from splashbench_methods.splashsplat.affordable import background_update, with_cells, within_seconds
from splashbench_methods.splashsplat.affordable_memory import within_memory
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


@pytest.mark.slow
def test_a_budget_that_nothing_exceeds_changes_nothing(balls: Scene) -> None:
    free, _ = fit(balls, Budget())
    roomy, run = fit(balls, Budget(storage_bytes=10**9))
    assert [decision.basis for decision in run.decisions if decision.basis != "scene"] == ["tolerance"]
    for name, arrays in free.liquid.arrays.items():
        for key, array in arrays.items():
            np.testing.assert_array_equal(roomy.liquid.arrays[name][key], array)


def test_less_than_nothing_fits_into_is_still_a_model(balls: Scene, tmp_path: Path) -> None:
    fitted, _ = fit(balls, Budget(storage_bytes=1))
    fitted.save(tmp_path)
    camera, time = balls.cameras["6"], float(balls.times[2])
    assert np.isfinite(SplashSplat().load(tmp_path, balls.training()).render(camera, time).rgb).all()


@pytest.mark.slow
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


class Traces:
    """Stands for traces of a scene that needs `full` cells, with carriers by a power of its own, and counts them."""

    def __init__(self, full: int, growth: float, carriers: int = 800_000) -> None:
        self.full, self.growth, self.carriers = full, growth, carriers
        self.asked: list[int] = []

    def __call__(self, config: SplashSplatConfig) -> Any:
        cells = min(config.hull_cells, self.full)
        self.asked.append(cells)
        count = round(self.carriers * (cells / 300) ** self.growth)
        return SimpleNamespace(
            observations=SimpleNamespace(hull_grid=SimpleNamespace(shape=(cells + 1, 10, 10))),
            track=SimpleNamespace(
                carriers=SimpleNamespace(count=count), phi=SimpleNamespace(nbytes=round(107e6 * (cells / 300) ** 3))
            ),
        )


def peak_of(traced: Any, scene: Scene) -> float:
    fixed = affordable_memory._fixed_bytes(scene.training(), 370_000_000)
    return affordable_memory._size_of(traced, fixed).peak


@pytest.mark.parametrize("growth", [1.9, 2.4, 2.9])
@pytest.mark.parametrize("megabytes", [640, 700, 850, 1000, 1300, 3000])
def test_memory_chooses_the_finest_grids_that_it_leaves_room_for(balls: Scene, growth: float, megabytes: int) -> None:
    config = SplashSplatConfig.preset("best")
    trace, run = Traces(300, growth), Run(budget=Budget(memory_bytes=megabytes * 10**6))
    traced: Any = within_memory(balls.training(), config, run, 370_000_000, trace)
    assert len(trace.asked) <= 4
    assert peak_of(traced, balls) <= 1.02 * megabytes * 1e6
    finest = trace.asked[-1] == 300
    assert finest or peak_of(traced, balls) > 0.85 * megabytes * 1e6
    assert finest == (peak_of(Traces(300, growth)(config), balls) <= 0.98 * megabytes * 1e6)
    (decision,) = run.decisions
    assert decision.name == "grids for the memory"
    assert [rung.bought for rung in decision.rungs] == [False] * (len(trace.asked) - 1) + [True]
    assert decision.chosen.startswith(f"{trace.asked[-1]} cells, ")


def test_a_scene_that_needs_few_cells_is_traced_once(balls: Scene) -> None:
    trace, run = Traces(100, 2.4), Run(budget=Budget(memory_bytes=10**12))
    within_memory(balls.training(), SplashSplatConfig.preset("best"), run, 370_000_000, trace)
    assert trace.asked == [100]


def test_memory_that_nothing_fits_into_has_the_coarsest_grids(balls: Scene) -> None:
    trace, run = Traces(300, 2.4), Run(budget=Budget(memory_bytes=1))
    traced: Any = within_memory(balls.training(), SplashSplatConfig.preset("best"), run, 370_000_000, trace)
    assert trace.asked[-1] == 24
    assert peak_of(traced, balls) > 1
    assert "0 MB are to be kept, of which 586 are there on any grid" in run.decisions[0].because


def test_carriers_of_no_liquid_are_no_trouble(balls: Scene) -> None:
    trace, run = Traces(300, 2.4, carriers=0), Run(budget=Budget(memory_bytes=700 * 10**6))
    within_memory(balls.training(), SplashSplatConfig.preset("best"), run, 370_000_000, trace)
    assert trace.asked[-1] > 128


@pytest.mark.slow
def test_a_fit_within_memory_has_the_grids_that_it_leaves_room_for(balls: Scene) -> None:
    free, _ = fit(balls, Budget())
    roomy, run = fit(balls, Budget(memory_bytes=10**12))
    decided = [decision.name for decision in run.decisions if decision.basis != "scene"]
    assert decided == ["grids for the memory", "steps of stored values"]
    for name, arrays in free.liquid.arrays.items():
        for key, array in arrays.items():
            np.testing.assert_array_equal(roomy.liquid.arrays[name][key], array)
    tight, run = fit(balls, Budget(memory_bytes=1))
    grids = next(decision for decision in run.decisions if decision.name == "grids for the memory")
    assert grids.chosen.startswith("24 cells, ")
    assert tight.liquid.track.carriers.count < free.liquid.track.carriers.count / 2


def test_all_budgets_together_take_the_coarsest_of_their_grids(balls: Scene, tmp_path: Path) -> None:
    limit = 120_000
    fitted, run = fit(balls, Budget(seconds=60, storage_bytes=limit, memory_bytes=10**12))
    assert {"grids for the memory", "grids for the seconds"} <= {decision.name for decision in run.decisions}
    assert stored_bytes(fitted, tmp_path / "fitted") <= 1.05 * limit


@pytest.mark.parametrize("settings", [{}, {"storage_tolerance": 0.0}])
def test_bytes_are_kept_where_seconds_leave_the_draft_alone(balls: Scene, tmp_path: Path, settings: dict) -> None:
    """How much values matter is measured in the last part of a fit, which may not come."""
    limit = 80_000
    fitted, run = fit(balls, Budget(seconds=1, storage_bytes=limit), **settings)
    assert "grids for the seconds" in {decision.name for decision in run.decisions}
    assert stored_bytes(fitted, tmp_path / "fitted") <= 1.05 * limit


def test_a_budget_of_memory_is_the_processors(balls: Scene) -> None:
    run = Run(device="cuda", budget=Budget(memory_bytes=10**12))
    with pytest.raises(SplashbenchError, match="a budget of memory on the processor alone; give --device cpu"):
        SplashSplat().fit(balls.training(), SplashSplat.Config.preset("quick", SMALL), run)


def test_in_a_hurry_there_is_one_trace_at_full_length(balls: Scene) -> None:
    config, budget = SplashSplatConfig.preset("best"), Budget(memory_bytes=1200 * 10**6, seconds=60)
    patient, hurried = Traces(300, 1.8), Traces(300, 1.8)
    within_memory(balls.training(), config, Run(budget=Budget(memory_bytes=1200 * 10**6)), 370_000_000, patient)
    within_memory(balls.training(), config, Run(budget=budget), 370_000_000, hurried)
    assert hurried.asked == patient.asked[:2]
    assert len(patient.asked) > 2

"""What a benchmark would run and how long: photographs at their size for all, scenes that are found, the estimate."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from splashbench.benchmark import estimate as module
from splashbench.benchmark.budgets import (
    DEFAULT_METHODS,
    NATIVE_SIDE,
    _paper_of,
    make_benchmark_plan,
    make_entrants,
)
from splashbench.benchmark.estimate import Estimate, Machine, MethodEstimate, estimate, load_rates, measure_machine
from splashbench.benchmark.scenes import find_scenes
from splashbench.download.scenes import _remember
from splashbench.errors import SplashbenchError
from splashbench.manifest import load_scenes
from splashbench.study.job import Store

SAME = Machine(2, 1.0)


def plan_of(real: Path, methods: tuple[str, ...] = DEFAULT_METHODS, budget: Any = "quick") -> Any:
    return make_benchmark_plan(make_entrants(methods, budget), [str(path) for path in find_scenes([str(real)])], budget)


def test_every_method_sees_photographs_at_their_size() -> None:
    for budget in ("quick", "full"):
        for entrant in make_entrants(DEFAULT_METHODS, budget):  # type: ignore[arg-type]
            if entrant.id in ("scaffold_4d", "spacetime_gaussians", "deformable_3dgs"):
                assert entrant.settings == {"longest_side": NATIVE_SIDE}
                assert entrant.preset == ("quick" if budget == "quick" else "paper")
    (chosen,) = make_entrants(["scaffold_4d:quick:longest_side=400"], "quick")
    assert not chosen.native
    assert chosen.settings == {"longest_side": 400}
    assert [each.preset for each in make_entrants(["splashsplat"], "full")] == ["best"]
    with pytest.raises(SplashbenchError, match="no preset 'fast'"):
        make_entrants(["scaffold_4d:fast"], "quick")


def test_the_reference_sees_them_too(real: Path) -> None:
    plan = plan_of(real)
    assert [run.overrides["longest_side"] for run in plan.references] == [NATIVE_SIDE] * 2
    assert plan.spec.paper is not None
    assert [each.paper for each in plan.spec.variants][:4] == list(DEFAULT_METHODS[:4])


def test_the_estimate_grows_with_pixels_and_machine(real: Path, tmp_path: Path) -> None:
    rates, store = load_rates(), Store(tmp_path / "none")
    found = estimate(plan_of(real), store, rates, SAME, with_lpips=True)
    slower = estimate(plan_of(real), store, rates, Machine(2, 3.0), with_lpips=True)
    full = estimate(plan_of(real / "real_scene"), store, rates, SAME, with_lpips=True)
    published = estimate(plan_of(real, budget="full"), store, rates, SAME, with_lpips=True)
    assert slower.seconds == pytest.approx(3 * found.seconds)
    assert full.seconds > found.seconds
    assert published.seconds > 5 * found.seconds
    assert found.left == 14
    recorded = rates.fits["scaffold_4d"]["quick"]
    assert module._line(recorded.points, 0.24) == dict(recorded.points)[0.24]
    (x0, y0), (x1, y1) = recorded.points[-2:]
    assert module._line(recorded.points, 2 * x1) == pytest.approx(y1 + (y1 - y0) / (x1 - x0) * x1)


@pytest.mark.parametrize(
    ("cores", "jobs", "each", "share"),
    [
        (2, 1, None, 1.0),
        (2, 2, None, 1.0),  # two cores are shared: nothing is gained
        (2, 8, None, 1.0),
        (16, 8, None, 9 / 16),  # a run with all 16 goes 9 times as fast as with one, 8 with two each 2 times
        (16, 1, 1, 9.0),
        (16, 4, 1, 9 / 4),
        (16, 99, 1, 9 / 16),
    ],
)
def test_runs_at_once_gain_what_further_cores_are_worth(cores: int, jobs: int, each: int | None, share: float) -> None:
    found = Estimate([MethodEstimate("one", "best", 1, seconds=100.0)], 1, 0.0, Machine(cores, 1.0))
    assert found.seconds_at_once(jobs, each) == pytest.approx(100 * share)


@pytest.mark.parametrize(
    ("names", "shown"),
    [
        (["bowl_001", "tank_003"], "real_20"),
        (["WaterSphere"], "watersphere"),
        (["WaterSphere", "WaterCube"], None),  # the paper has no mean of these
        (["HoneyCone"], None),
        (["bowl_001", "mine"], None),
        (["real_20"], None),  # the name of a set is no scene's
    ],
)
def test_the_papers_figures_stand_beside_its_own_scenes_alone(names: list[str], shown: str | None) -> None:
    found = _paper_of(names)
    assert (found.scene_set if found else None) == shown


def test_the_machine_is_measured_in_processor_time() -> None:
    machine = measure_machine(load_rates())
    assert machine.cores >= 1
    assert 0.02 < machine.factor < 50


def test_places_of_scenes(real: Path, tmp_path: Path) -> None:
    crops = [real / "real_scene_crop" / name for name in ("bowl_001", "tank_002")]
    assert find_scenes([str(real)]) == crops
    assert find_scenes([str(crops[1]), str(real)]) == [crops[1], crops[0]]
    assert len(find_scenes([str(real), f"{real}/../{real.name}"])) == 2
    assert find_scenes([str(real / "real_scene")])[0].parent.name == "real_scene"
    with pytest.raises(SplashbenchError, match=r"holds no scene .* download scenes"):
        find_scenes([str(tmp_path)])
    with pytest.raises(SplashbenchError, match="are not on this machine; fetch them"):
        find_scenes(["all"])
    _remember(real)
    with pytest.raises(SplashbenchError, match="lacks 18 of the 20 released scenes, such as bowl_002"):
        find_scenes(["all"])


def test_all_means_the_twenty(real: Path, tmp_path: Path) -> None:
    for name in load_scenes():
        place = tmp_path / "twenty" / "real_scene_crop" / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(real / "real_scene_crop" / "bowl_001")
    _remember(tmp_path / "twenty")
    assert [path.name for path in find_scenes(["all"])] == sorted(load_scenes())

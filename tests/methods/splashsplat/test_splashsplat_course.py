"""The order in which the parts of a fit are made, and what is shown on the way."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splashbench.container.footage_vessel import Standing
from splashbench.harness import side_by_side
from splashbench.harness.checkpoints import Checkpoints
from splashbench.harness.contract import Budget, Fitted, Run
from splashbench.scene import Scene, TrainingScene
from splashbench_methods import scaffold_gs
from splashbench_methods.splashsplat import (
    SplashSplat,
    SplashSplatConfig,
    coarse_fit,
    course,
    reconstruction,
    smaller,
)
from splashbench_methods.splashsplat.appearance import fitting
from splashbench_methods.splashsplat.appearance.fitting import Fit
from splashbench_methods.splashsplat.appearance.targets import TrainingTarget
from splashbench_methods.splashsplat.appearance.warm_start import Learned
from splashbench_methods.splashsplat.carriers.subframe import Track
from splashbench_methods.splashsplat.method import FittedSplashSplat

SMALL = {"hull_cells": 32, "transport_cells": 16, "control_cells": 6, "velocity_steps": 2, "self_calibration": False}


def error(fitted: Fitted, scene: Scene) -> float:
    camera = scene.cameras["6"]
    return float(
        np.mean([
            np.square(fitted.render(camera, float(scene.times[t])).rgb - scene.image("6", t) / 255).mean()
            for t in range(scene.n_frames)
        ])
    )  # fmt: skip


def fitted(scene: Scene, run: Run | None = None, **settings: Any) -> Fitted:
    config = SplashSplatConfig.preset("best", SMALL | {"background_preset": "quick"} | settings)
    return SplashSplat().fit(scene.training(), config, run or Run())


@pytest.fixture
def coarse_fits(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many iterations each coarse fit has had."""
    made: list[int] = []
    original = course.fit_coarsely

    def fit_coarsely(scene: TrainingScene, config: SplashSplatConfig, *others: Any) -> list[Learned]:
        made.append(config.coarse_iterations)
        return original(scene, config, *others)

    monkeypatch.setattr(course, "fit_coarsely", fit_coarsely)
    return made


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> dict[float, int]:
    """How many iterations were made on grids of so large transport voxels (scene units)."""
    made: dict[float, int] = {}
    original = reconstruction.fit_appearance

    def fit_appearance(look: Any, track: Track, *others: Any) -> Fit:
        fit = original(look, track, *others)
        made[track.grid.voxel] = made.get(track.grid.voxel, 0) + len(fit.losses)
        return fit

    monkeypatch.setattr(reconstruction, "fit_appearance", fit_appearance)
    return made


def test_the_first_iterations_are_made_on_coarse_grids(
    balls: Scene, flat_background: None, coarse_fits: list[int], steps: dict[float, int]
) -> None:
    with_it = fitted(balls, iterations=100, coarse_grids_share=0.4)
    assert coarse_fits == [40]
    fine, coarse = sorted(steps)
    assert coarse > 1.4 * fine
    assert steps == {coarse: 40, fine: 60}
    # Sixty steps of a hundred, alone: the rates are as high, but nothing was learned before.
    steps.clear()
    without = fitted(balls, iterations=60, coarse_grids_share=0.0)
    assert steps == {fine: 60}
    assert error(with_it, balls) < error(without, balls)


def test_a_fit_that_looks_at_withheld_photographs_has_not_seen_them_on_coarse_grids(
    balls: Scene, flat_background: None, coarse_fits: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[float, set[tuple[str, int]]] = {}
    of, look = fitting.ActiveCarriers.of, fitting.EarningSchedule.look
    looks = 0

    def note(self: fitting.ActiveCarriers, target: TrainingTarget) -> Any:
        seen.setdefault(self._track.grid.voxel, set()).add((target.camera.name, target.frame))
        return of(self, target)

    def count(self: fitting.EarningSchedule, iteration: int, found: Any) -> None:
        nonlocal looks
        looks += 1
        look(self, iteration, found)

    def chosen(count: int, share: float, rng: Any) -> np.ndarray:
        return np.arange(count) < 3

    monkeypatch.setattr(fitting.ActiveCarriers, "of", note)
    monkeypatch.setattr(fitting.EarningSchedule, "look", count)
    monkeypatch.setattr(fitting, "withheld", chosen)
    monkeypatch.setattr(fitting, "_LOOK_EVERY", 5)
    # Without looks for idle carriers, which ask about all photographs.
    withholding = {"validation_share": 0.04, "price": 0.1, "idle_share": 0.0}
    fitted(balls, iterations=200, coarse_grids_share=0.4, **withholding)
    assert coarse_fits == [80]
    fine, coarse = sorted(seen)
    assert looks > 0
    assert len(seen[fine] - seen[coarse]) == 3


def on_cores(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Parts of a fit are made on so many cores."""
    for module in (course, side_by_side):
        monkeypatch.setattr(module, "thread_count", lambda: count)


#: How much shows through the liquid.
TRANSPARENT = pytest.mark.parametrize("share", [0.0, 1.0])


@pytest.mark.parametrize(
    ("share", "threads"),
    [
        (0.0, 1),
        (1.0, 2),
        pytest.param(0.0, 2, marks=pytest.mark.slow),
        pytest.param(1.0, 1, marks=pytest.mark.slow),
    ],
)
def test_who_looks_on_changes_nothing(
    share: float, threads: int, balls: Scene, short_background: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a draft, and states on the way."""
    on_cores(monkeypatch, threads)
    monkeypatch.setattr(smaller, "_DRAFT_ITERATIONS", 20)
    monkeypatch.setattr(course, "transmittance", lambda *_: share)
    images = []
    for watched in (False, True):
        run = Run()
        if watched:
            run._checkpoints = Checkpoints(tmp_path, [0.0, 1e9], lambda: 7.0, lambda: None)
        found = fitted(balls, run, iterations=40, draft_cells=32)
        images.append(found.render(balls.cameras["6"], float(balls.times[3])).rgb)
    np.testing.assert_array_equal(*images)


def test_a_draft_does_not_wait_for_all_that_the_footage_tells_of_a_container(
    balls: Scene, short_background: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []

    def look(name: str) -> Callable[..., Standing]:
        return lambda *_: (done.append(name), Standing(None, None))[1]

    draft = course.make_draft
    monkeypatch.setattr(course, "make_draft", lambda *given: (draft(*given), done.append("draft"))[0])
    for name in ("standing_roughly", "standing_about_liquid"):
        monkeypatch.setattr(course, name, look(name))
    monkeypatch.setattr(smaller, "_DRAFT_ITERATIONS", 20)
    run = Run()
    run._checkpoints = Checkpoints(tmp_path, [0.0, 1e9], lambda: 7.0, lambda: None)
    fitted(balls, run, iterations=20, draft_cells=32, container=False, container_masks=False)
    assert done == ["standing_roughly", "draft", "standing_about_liquid"]


def test_a_draft_of_liquid_that_shows_what_is_behind_it_learns_longer() -> None:
    """And has its background as soon as any other."""
    never, always = (
        smaller.draft_of(SplashSplatConfig(transmission=transmission)) for transmission in ("never", "always")
    )
    assert always.iterations > never.iterations > 0
    assert always.iterations * always.plates_share == pytest.approx(never.iterations * never.plates_share)


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Which parts were begun, in their order, and after how many iterations since the part before."""
    begun: list[str] = []

    def noted(module: Any, name: str, word: Callable[..., str]) -> None:
        original = getattr(module, name)

        def function(*arguments: Any, **others: Any) -> Any:
            begun.append(word(*arguments))
            return original(*arguments, **others)

        monkeypatch.setattr(module, name, function)

    noted(course, "fit_coarsely", lambda *_: "coarse")
    noted(course, "trace_liquid", lambda *_: "trace")
    noted(scaffold_gs, "shared_background", lambda *_: "background")
    noted(fitting, "image_loss", lambda *_: "step")
    return begun


def in_order(parts: list[str]) -> list[str | int]:
    """`parts` with iterations counted."""
    return [len(list(group)) if name == "step" else name for name, group in itertools.groupby(parts)]


@TRANSPARENT
def test_where_the_background_comes(
    share: float, balls: Scene, short_background: None, parts: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """First where the liquid is transparent; else after the first fifth of the iterations on fine grids."""
    on_cores(monkeypatch, 1)
    monkeypatch.setattr(course, "transmittance", lambda *_: share)
    run = Run()
    fitted(balls, run, iterations=50, coarse_grids_share=0.2)
    late, first = ["coarse", 10, "trace", 8, "background", 32], ["background", "coarse", 10, "trace", 40]
    assert in_order(parts) == (first if share else late)
    (decision,) = [found for found in run.decisions if found.name == "background"]
    assert decision.chosen == ("before the coarse grids" if share else "once fine grids show something")
    assert f"{100 * share:.0f} %" in decision.because


@TRANSPARENT
def test_cores_decide_what_is_made_beside_what_and_nothing_else(
    share: float, balls: Scene, short_background: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(course, "transmittance", lambda *_: share)
    images = []
    for cores in (1, 2):
        on_cores(monkeypatch, cores)
        found = fitted(balls, iterations=40)
        images.append(found.render(balls.cameras["6"], float(balls.times[3])).rgb)
    np.testing.assert_array_equal(*images)


#: Liquid and whether there is a background, of each state with none to follow for a while.
Milestones = list[tuple[int, bool]]


def milestones(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Milestones:
    """Of `run`, from now on."""
    shown: Milestones = []
    run._checkpoints = Checkpoints(tmp_path, [1e9], lambda: 7.0, lambda: None)

    def offer(state: Callable[[], Fitted], milestone: bool) -> None:
        if milestone:
            model = state()
            assert isinstance(model, FittedSplashSplat)
            shown.append((model.liquid.carriers.count, len(model.background.model) > 0))

    monkeypatch.setattr(run._checkpoints, "offer", offer)
    return shown


def test_opaque_liquid_is_shown_before_there_is_a_background(
    balls: Scene, short_background: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The coarse liquid, and the fine one once all photographs were seen."""
    on_cores(monkeypatch, 1)
    run = Run()
    shown = milestones(run, tmp_path, monkeypatch)
    fitted(balls, run, iterations=300, draft_cells=0, plates_share=0.5)
    (coarse, before), (fine, then) = shown
    assert (before, then) == (False, False)
    assert fine > 1.5 * coarse


@pytest.mark.parametrize("cores", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_transparent_liquid_is_shown_before_the_background_first(
    cores: int, balls: Scene, short_background: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The draft with a coarse background, the same liquid before the fitted one, and the coarse grids'."""
    on_cores(monkeypatch, cores)
    monkeypatch.setattr(smaller, "_DRAFT_ITERATIONS", 20)
    monkeypatch.setattr(course, "transmittance", lambda *_: 1.0)
    run, offered = Run(), []
    shown = milestones(run, tmp_path, monkeypatch)
    original = scaffold_gs.shared_background

    def shared_background(*arguments: Any, offer: Any = None) -> scaffold_gs.Background:
        offered.append(offer is not None)
        return original(*arguments, offer=offer)

    monkeypatch.setattr(scaffold_gs, "shared_background", shared_background)
    fitted(balls, run, iterations=40, draft_cells=32)
    drafted, behind, coarse = shown[-3:]
    assert drafted[0] == behind[0] != coarse[0]
    assert behind[1]
    assert coarse[1]
    # States on the way stop the clock, and with it what runs beside the background.
    assert offered == [cores == 1]


def test_first_states_of_coarse_grids_are_left_out_where_gaussians_show_what_is_behind_them(
    balls: Scene, short_background: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As long as they are below the draft, where there is one. What stands for a while is always shown."""
    ways: dict[tuple[str, int], list[bool]] = {}

    def fit_liquid(*_: Any, offer: Any, keep: Any) -> None:
        keep(Learned)
        for _ in range(balls.n_frames * len(balls.train)):
            offer(lambda: None, False)

    monkeypatch.setattr(coarse_fit, "trace_liquid", lambda *_: None)
    monkeypatch.setattr(coarse_fit, "fit_liquid", fit_liquid)
    for transmission, draft in (("never", 140), ("always", 140), ("always", 0)):
        shown = ways.setdefault((transmission, draft), [])
        config = SplashSplatConfig(transmission=transmission, draft_cells=draft)
        offer = lambda _, milestone, shown=shown: shown.append(milestone)  # noqa: E731
        coarse_fit.fit_coarsely(balls, config, Run(), None, [], {}, offer, (0, 1))
    photographs = balls.n_frames * len(balls.train)
    assert len(ways["never", 140]) == len(ways["always", 0]) == photographs + 1
    assert len(ways["always", 140]) == photographs + 1 - round(coarse_fit._BELOW_DRAFT * photographs)
    assert ways["always", 140][-1]


def test_where_the_coarse_fit_learns_nothing_there_is_none(
    balls: Scene, flat_background: None, steps: dict[float, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(course, "fit_coarsely", lambda *_: [])
    fitted(balls, iterations=10)
    assert list(steps.values()) == [10]


def test_a_run_aside_leaves_no_record(tmp_path: Path) -> None:
    told: list[tuple[float, str]] = []
    run = Run(seed=3, device="cuda", directory=tmp_path, budget=Budget(seconds=5.0))
    run._report = lambda done, message: told.append((done, message))
    part = run.aside((0.2, 0.6))
    assert (part.seed, part.device, part.directory, part.budget.limits) == (3, "cuda", tmp_path, {})
    part.progress(0.5, "half")
    part.note("name", "text")
    with part.stage("stage"):
        run.aside().progress(0.9, "nobody is told")
    assert told == [(pytest.approx(0.4), "half")]
    assert not run.notes
    assert not run.stages


@pytest.mark.parametrize(
    ("settings", "budget"),
    [
        ({"validation_share": 0.04, "price": 0.0}, Budget()),
        ({"plates_share": 0.0}, Budget()),
        ({}, Budget(seconds=60.0)),
        ({"coarse_grids_share": 0.0}, Budget()),
        ({"coarse_grids_side": 95}, Budget()),  # photographs are 96 pixels wide
    ],
)
def test_there_is_none_where_something_else_ends_the_fit(
    settings: dict[str, Any], budget: Budget, balls: Scene, flat_background: None, coarse_fits: list[int]
) -> None:
    fitted(balls, Run(budget=budget), iterations=12, **settings)
    assert coarse_fits == []


@pytest.mark.slow
def test_a_draft_of_large_photographs_sees_small_ones_and_the_fit_is_the_same(
    balls: Scene, short_background: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(smaller, "_DRAFT_ITERATIONS", 20)
    seen: list[TrainingScene] = []
    made = course.make_draft

    def make_draft(scene: TrainingScene, *others: Any) -> Any:
        seen.append(scene)
        return made(scene, *others)

    monkeypatch.setattr(course, "make_draft", make_draft)
    images = []
    for side in (400, 48):
        monkeypatch.setattr(course, "_DRAFT_SIDE", side)
        run = Run()
        run._checkpoints = Checkpoints(tmp_path / str(side), [0.0, 1e9], lambda: 7.0, lambda: None)
        found = fitted(balls, run, iterations=40, draft_cells=32)
        images.append(found.render(balls.cameras["6"], float(balls.times[3])).rgb)
    assert [scene.cameras["1"].width for scene in seen] == [96, 48]
    np.testing.assert_array_equal(*images)

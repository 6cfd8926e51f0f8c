"""How long the fit goes on: fixed schedules, and the one that looks at withheld photographs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from splashbench.harness.contract import Run
from splashbench.scene import Scene
from splashbench.synth.balls import write_balls_scene
from splashbench_methods.splashsplat.appearance import fitting as fit
from splashbench_methods.splashsplat.appearance.iterations import iterations_decision
from splashbench_methods.splashsplat.appearance.schedule import (
    LOWEST,
    AdaptiveSchedule,
    EarningSchedule,
    FixedSchedule,
    Schedule,
    WithheldLook,
    withheld,
)
from splashbench_methods.splashsplat.reconstruction import fit_liquid
from splashbench_methods.splashsplat.settings import SplashSplatConfig
from splashbench_methods.splashsplat.trace import trace_liquid

TINY = {"hull_cells": 48, "transport_cells": 32, "control_cells": 8, "ssim_every": 4}


def factors(schedule: Schedule, losses: dict[int, float] | None = None) -> list[float]:
    """The factors of a whole run, in which the withheld photographs have the loss `losses` gives for the iteration."""
    found: list[float] = []
    while True:
        if schedule.due(len(found)):
            assert losses is not None
            schedule.look(len(found), WithheldLook(losses[len(found)], np.zeros(1)))
        factor = schedule.factor(len(found))
        if factor is None:
            return found
        assert 0 <= schedule.done(len(found)) < 1
        found.append(factor)


def adaptive(limit: int = 900, gain: float = 0.02) -> AdaptiveSchedule:
    return AdaptiveSchedule(limit, every=100, gain=gain, fall=0.5)


def test_a_fixed_schedule_runs_all_its_iterations():
    assert factors(FixedSchedule(5, anneal=False)) == [1.0] * 5
    falling = factors(FixedSchedule(200, anneal=True))
    assert len(falling) == 200
    assert falling[0] == 1
    assert falling[100] == pytest.approx((1 + LOWEST) / 2)
    assert falling[-1] == pytest.approx(LOWEST, abs=1e-3)
    assert (np.diff(falling) < 0).all()
    assert factors(FixedSchedule(0, anneal=True)) == []


def test_rates_stay_up_to_the_limit_while_withheld_photographs_gain():
    found = factors(adaptive(1500), {i: 0.9**i for i in range(100, 1500, 100)})
    assert len(found) == 1500
    assert found[:1000] == [1.0] * 1000
    assert (np.diff(found[999:]) <= 0).all()
    assert found[-1] == pytest.approx(LOWEST, abs=1e-3)


def test_the_fit_ends_soon_after_withheld_photographs_stop_gaining():
    # Four looks on the mean: .785 from 500 to 800 against .8 from 100 to 400, 1.9 % less.
    losses = {**dict.fromkeys(range(100, 500, 100), 0.8), 500: 0.77, 600: 0.79, 700: 0.79, 800: 0.79, 900: 0.1}
    assert len(factors(adaptive(3000, gain=0.018), losses | dict.fromkeys(range(900, 2100, 100), 0.1))) > 1200
    found = factors(adaptive(3000, gain=0.02), losses)
    assert len(found) == 1200
    assert found[799] == 1 > found[801]


@pytest.mark.parametrize("limit", [0, 1, 2, 3, 7, 100, 1200])
def test_a_limit_without_room_for_looks_is_kept_and_nothing_is_withheld(limit: int):
    schedule = adaptive(limit)
    assert not schedule.may_stop
    assert not schedule.withholds
    found = factors(schedule)
    assert abs(len(found) - limit) <= 1
    assert len(found) <= limit
    assert (np.diff(found) <= 0).all()


def test_one_bad_look_does_not_end_the_fit():
    losses = {i: 0.97 ** (i / 100) for i in range(100, 2100, 100)}
    losses[800], losses[1300] = 0.85, 0.72
    assert len(factors(adaptive(3000), losses)) == 3000


def test_some_photographs_are_withheld_where_there_are_enough():
    for count, expected in ((20, 0), (79, 0), (80, 8), (250, 10), (1000, 40)):
        assert withheld(count, 0.04, np.random.default_rng(0)).sum() == expected


@pytest.fixture(scope="module")
def many_balls(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A scene with enough photographs to withhold some."""
    return write_balls_scene(tmp_path_factory.mktemp("scenes") / "balls", size=(48, 32), n_frames=20)


def fitted(scene: Scene, **overrides: object) -> list[float]:
    """The progress of a fit on grey backgrounds, iteration by iteration."""
    training = scene.training()
    grey = {name: np.full((c.height, c.width, 3), 0.5, np.float32) for name, c in training.cameras.items()}
    config = SplashSplatConfig.preset("quick", TINY | overrides)
    told: list[float] = []

    def note(fraction: float, message: str) -> None:
        if message == "appearance":
            told.append(fraction)

    run = Run(seed=1, _report=note)
    fit_liquid(training, grey, trace_liquid(training, config, run), run)
    return told


@pytest.mark.slow
def test_a_scene_that_is_soon_explained_is_soon_fitted(many_balls: Scene, monkeypatch: pytest.MonkeyPatch):
    looks: list[tuple[int, float]] = []
    look = AdaptiveSchedule.look

    def note(self: AdaptiveSchedule, iteration: int, seen: WithheldLook) -> None:
        look(self, iteration, seen)
        looks.append((iteration, seen.loss))

    monkeypatch.setattr(AdaptiveSchedule, "look", note)
    monkeypatch.setattr(fit, "_LOOK_EVERY", 20)
    # Carriers that begin without the photographs' colours have something to gain from one look to the next.
    few = fitted(many_balls, iterations=600, validation_share=0.1, stop_gain=0.2, first_look=False)
    assert len(looks) >= 3
    assert looks[-1][1] < 0.9 * looks[0][1]  # what is withheld is explained better and better
    assert len(few) == looks[-1][0] * 1.5  # and the rates fall from the last look on
    assert len(few) < 500
    assert few[-1] == pytest.approx(1)
    assert len(fitted(many_balls, iterations=60, validation_share=0.0)) == 60


@pytest.mark.slow
def test_withheld_photographs_are_fitted_once_the_rates_fall(many_balls: Scene, monkeypatch: pytest.MonkeyPatch):
    """All photographs but the withheld ones in the first part, all of them in the second."""
    seen: list[int] = []
    monkeypatch.setattr(fit, "_LOOK_EVERY", 35)
    real = fit.image_loss

    def note(image, alpha, target, *others):
        if image.requires_grad:  # a look is no step of the fit
            seen.append(id(target))
        return real(image, alpha, target, *others)

    monkeypatch.setattr(fit, "image_loss", note)
    fitted(many_balls, iterations=450, validation_share=0.1, stop_gain=0.0)
    first, second = set(seen[:300]), set(seen[300:])
    everything = len(first | second)
    assert 0.08 * everything <= len(second - first) <= 0.1 * everything + 1


def test_what_was_withheld_comes_twice_as_often_afterwards():
    some = np.array([False, True, False, False, True])
    assert sorted(fit._fitted(some, withholds=True)) == [0, 2, 3]
    assert sorted(fit._fitted(some, withholds=False)) == [0, 1, 1, 2, 3, 4, 4]
    assert sorted(fit._fitted(np.zeros(3, bool), withholds=False)) == [0, 1, 2]


def earning(quality: Callable[[int], float], price: float = 0.1, limit: int = 6000) -> tuple[EarningSchedule, int]:
    """A schedule whose withheld photographs have the `quality` (dB) at each iteration; and how many it had."""
    schedule = EarningSchedule(limit, every=100, price=price, before=1500, fall=0.5)
    iteration = 0
    while schedule.factor(iteration) is not None:
        if schedule.due(iteration):
            schedule.look(iteration, WithheldLook(0.0, quality(iteration) + np.array([-0.1, 0.0, 0.1])))
        iteration += 1
    return schedule, iteration


def test_iterations_end_when_they_gain_less_than_their_time_is_worth():
    # Half a decibel for each doubling of the iterations: worth it until the time hardly doubles any more.
    slow = earning(lambda n: 20 + 0.5 * np.log2(n))
    never = earning(lambda n: 20.0)
    assert slow[1] == 6000
    assert never[1] == 1200  # eight looks, and half as many iterations in which the rates fall
    assert all(stretch.pays for stretch in slow[0].earned)
    assert [stretch.pays for stretch in never[0].earned] == [False]
    assert never[0].earned[0].standard_error == pytest.approx(0, abs=1e-9)


def test_one_that_pays_to_the_end_has_the_rates_of_a_fixed_one():
    limit = 3000
    schedule = EarningSchedule(limit, every=100, price=0.1, before=1500, fall=0.5)
    found, withheld_until = [], 0
    for iteration in range(limit):
        if schedule.due(iteration):
            schedule.look(iteration, WithheldLook(0.0, np.full(3, float(iteration))))
        found.append(schedule.factor(iteration))
        withheld_until = iteration if schedule.withholds else withheld_until
    assert found == factors(FixedSchedule(limit, anneal=True))
    # No photograph is withheld once there is nothing to be saved any more.
    assert withheld_until == 1999


def test_what_another_fit_began_is_gone_on_with():
    """Rates, the end and what time is worth count from the first iteration of both; looks from the second fit's own."""

    def run(begun: int) -> tuple[EarningSchedule, list[float]]:
        schedule = EarningSchedule(3000, every=100, price=0.1, before=1500, fall=0.5, begun=begun)
        found: list[float] = []
        while (factor := schedule.factor(len(found))) is not None:
            found.append(factor)
            assert schedule.done(len(found)) == pytest.approx((begun + len(found)) / schedule._end)
            if schedule.due(len(found)):
                quality = min(begun + len(found), 1700) / 100
                schedule.look(len(found), WithheldLook(0.0, np.full(3, float(quality))))
        return schedule, found

    whole, later = run(0), run(600)
    assert later[0].earned[0].iterations == (1000, 1400)
    assert later[0].earned[0].price == next(e.price for e in whole[0].earned if e.iterations == (1000, 1400))
    assert later[0].earned[-1].iterations[1] == whole[0].earned[-1].iterations[1]
    assert later[1] == whole[1][600:]
    assert not EarningSchedule(3000, every=100, price=0.1, before=1500, fall=0.5, begun=1300).may_stop


def test_rates_go_on_falling_from_where_they_were():
    schedule = EarningSchedule(6000, every=100, price=0.1, before=1500, fall=0.5)
    found: list[float] = []
    while (factor := schedule.factor(len(found))) is not None:
        found.append(factor)
        if schedule.due(len(found)):
            schedule.look(len(found), WithheldLook(0.0, np.full(3, min(len(found), 1500) / 100)))
    steps = -np.diff(found)
    assert (steps >= -1e-12).all()
    assert steps.max() < 0.01
    assert found[-1] == pytest.approx(LOWEST, abs=1e-3)
    assert 2000 < len(found) < 3500


def test_a_higher_price_gives_fewer_iterations():
    def quality(iteration: int) -> float:
        return 25 - 4 * np.exp(-iteration / 800)

    counts = [earning(quality, price)[1] for price in (0.01, 0.1, 0.5, 2.0)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[-1]


def test_what_was_earned_is_a_decision():
    decision = iterations_decision(earning(lambda n: 25 - 4 * np.exp(-n / 400))[0].earned, 3000)
    assert decision.chosen == "3000 iterations"
    assert [rung.bought for rung in decision.rungs] == [True] * (len(decision.rungs) - 1) + [False]
    assert all(rung.gain is not None for rung in decision.rungs)
    many = earning(lambda n: float(n), limit=9000)[0].earned
    assert len(iterations_decision(many, 9000).rungs) <= 40

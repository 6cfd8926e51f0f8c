"""Knees of curves with known answers: bends, prices, plateaus, noise, one rung, failed rungs."""

from __future__ import annotations

from collections.abc import Sequence
from math import log2, nan

import numpy as np
import pytest

from splashbench.study.knee import PRICE, Rung, bend, find_knee


def _rungs(
    test: Sequence[float],
    train: Sequence[float] | None = None,
    bytes: Sequence[float] | None = None,
    seconds: Sequence[float] | None = None,
) -> list[Rung]:
    """Rungs with these PSNR, by default each of twice the bytes and seconds of the one before."""
    doublings = [2.0**k for k in range(len(test))]
    columns = (seconds or doublings, bytes or doublings, test, train or [nan] * len(test))
    return [Rung(number, *values) for number, values in enumerate(zip(*columns), 1)]


def test_a_curve_that_flattens_has_its_knee_where_it_no_longer_pays() -> None:
    # A rung costs a doubling of both, .2 dB: 1 and .5 pay, .15 and .05 do not.
    knee = find_knee(_rungs([18, 19, 19.5, 19.65, 19.7]))
    assert (knee.rung, knee.rising, knee.last) == (3, False, 5)
    assert (knee.beyond, knee.test_change) == ("too dear", pytest.approx(0.2))


def test_the_bend_is_farthest_above_the_diagonal() -> None:
    # Scaled: x 0, 1/4, 1/2, 3/4, 1 and y 0, .6, .8, .9, 1.
    rungs = _rungs([10, 16, 18, 19, 20])
    assert bend([rung.bytes for rung in rungs], rungs) == 2
    # Satopaa et al., section 2: f(x) = -1 / x + 5 has its knee where the scaled curve is steeper than the diagonal
    # no longer. On x in [.2, 2] the scaled slope is 1 at x = sqrt(.2 * 2) = .63.
    places = np.arange(0.2, 2.001, 0.01)
    curve = [Rung(k, 1.0, 2.0**x, -1 / x + 5) for k, x in enumerate(places)]
    found = bend([rung.bytes for rung in curve], curve)
    assert found is not None
    assert places[found] == pytest.approx(np.sqrt(0.4), abs=0.01)


def test_a_curve_whose_last_rung_pays_has_no_knee() -> None:
    knee = find_knee(_rungs([18, 18.5, 19, 19.5]))
    assert (knee.rung, knee.rising, knee.last, knee.beyond) == (None, True, 4, None)
    # A straight line bends nowhere.
    assert knee.bend_bytes is knee.bend_seconds is None


def test_a_plateau_between_two_rises_is_climbed_where_both_pay_together() -> None:
    assert find_knee(_rungs([18, 18.1, 18.1, 20, 20])).rung == 4
    assert find_knee(_rungs([18, 18.1, 18.1, 18.2, 18.2])).rung == 1
    flat = find_knee(_rungs([18, 18, 18]))
    assert (flat.rung, flat.beyond, flat.bend_bytes) == (1, "plateau", None)


def test_test_views_that_fall_while_training_views_rise_are_overfitting() -> None:
    knee = find_knee(_rungs([18, 19, 18.5], [19, 21, 23]))
    assert (knee.rung, knee.beyond) == (2, "overfitting")
    assert (knee.test_change, knee.train_change) == (-0.5, 2)
    # Both fall, or nobody knows: no overfitting.
    assert find_knee(_rungs([18, 19, 18.5], [19, 21, 20])).beyond == "worse"
    assert find_knee(_rungs([18, 19, 18.5])).beyond == "worse"
    assert find_knee(_rungs([18, 19, 18.98], [19, 21, 23])).beyond == "plateau"


@pytest.mark.parametrize("seed", range(20))
def test_noise_moves_no_knee(seed: int) -> None:
    noise = np.random.default_rng(seed).uniform(-0.05, 0.05, 6)
    knee = find_knee(_rungs((np.array([16, 18, 19, 19.02, 19.02, 19.03]) + noise).tolist()))
    assert knee.rung == 3
    line = _rungs((np.arange(6) + 10 * noise / 2).tolist())
    assert bend([rung.bytes for rung in line], line) is None


def test_each_cost_has_its_price() -> None:
    # The second rung gains .15 dB: enough for a doubling of one, not of both, and four times one is two doublings.
    assert find_knee(_rungs([18, 18.15], bytes=[5, 5])).rising
    assert find_knee(_rungs([18, 18.15], seconds=[5, 5])).rising
    assert find_knee(_rungs([18, 18.15])).rung == 1
    assert find_knee(_rungs([18, 18.15], bytes=[1, 4], seconds=[5, 5])).rung == 1
    assert PRICE * log2(4) > 0.15
    # One that is better and cheaper is climbed in any case; bytes that do not change have no bend.
    knee = find_knee(_rungs([18, 18.01, 18.01], bytes=[5, 5, 5], seconds=[4, 2, 4]))
    assert (knee.rung, knee.bend_bytes) == (2, None)
    # Where cost falls, quality is no function of it.
    assert find_knee(_rungs([10, 16, 18, 19, 20], seconds=[3, 2, 4, 8, 16])).bend_seconds is None


@pytest.mark.parametrize(
    ("test", "last"), [([], None), ([18.0], 1), ([nan], None), ([nan, 18, nan], 2), ([18, float("inf")], 1)]
)
def test_one_rung_says_nothing(test: list[float], last: int | None) -> None:
    knee = find_knee(_rungs(test))
    assert (knee.rung, knee.rising, knee.beyond, knee.last) == (None, False, None, last)


def test_rungs_that_failed_are_passed_over() -> None:
    assert find_knee(_rungs([18, nan, 19.5, 19.5])).rung == 3
    rising = find_knee(_rungs([18, 19, nan, nan]))
    assert (rising.rung, rising.rising, rising.last) == (None, True, 2)
    # A model without bytes, or a fit without time, has no doublings.
    assert find_knee(_rungs([18, 19, 20], bytes=[0, 1, 2])).last == 3
    assert find_knee(_rungs([18, 19, 20], seconds=[1, 2, nan])).last == 2

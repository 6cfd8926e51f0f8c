"""Retention, S, CVaR10 and breakdown points against known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from splashbench.study.stability import StressRun, breakdown, retentions, stability, worst_mean

NOTHING = {("a", 0): 10.0, ("b", 0): 10.0, ("a", 1): 10.0}


def run(level: int, value: float | None, kind: str = "haze", scene: str = "a", seed: int = 0) -> StressRun:
    return StressRun("m", scene, seed, kind if level else "as_recorded", level, value)


def test_retention_is_the_share_of_the_gain_that_is_left() -> None:
    runs = [run(0, 30.0), run(1, 30.0), run(2, 25.0), run(3, 40.0), run(4, 5.0), run(5, None)]
    found = retentions(runs, NOTHING, higher_is_better=True)
    assert [found[r] for r in runs[1:]] == [1.0, 0.75, 1.0, 0.0, 0.0]
    runs = [run(0, 0.2), run(1, 0.6), run(2, 1.2)]
    found = retentions(runs, {("a", 0): 1.0}, higher_is_better=False)
    assert [found[r] for r in runs[1:]] == pytest.approx([0.5, 0.0])


def test_who_gains_nothing_keeps_nothing() -> None:
    for whole in (10.0, 9.0, None):
        runs = [run(0, whole), run(1, 30.0)]
        assert retentions(runs, NOTHING, higher_is_better=True)[runs[1]] == 0.0
    with pytest.raises(KeyError):
        retentions([run(1, 30.0)], NOTHING, higher_is_better=True)


def test_the_worst_tenth_holds_a_run_at_least() -> None:
    values = np.append(np.linspace(1, 0.1, 10), np.nan)
    assert worst_mean(values) == pytest.approx(0.1)
    assert worst_mean(np.arange(40.0)) == pytest.approx(1.5)
    assert worst_mean(np.array([[3.0, 2.0], [1.0, np.nan]])) == pytest.approx([2.0, 1.0])


def test_stability_counts_failures_and_has_an_interval_where_runs_are_enough() -> None:
    runs = [
        run(0, 30.0),
        *(run(level, 30.0) for level in range(1, 6)),
        *(run(level, None, "gamma") for level in range(1, 6)),
    ]
    found = stability(retentions(runs, NOTHING, higher_is_better=True))
    assert (found.runs, found.failed) == (10, 5)
    assert found.score.value == pytest.approx(0.5)
    assert found.worst.value == 0.0
    low, high = found.score.interval or (math.nan, math.nan)
    assert 0 <= low < 0.5 < high <= 1


def test_a_method_breaks_between_the_severities_that_say_so() -> None:
    amounts = [0, 1, 2, 4, 8, 16]
    runs = [run(0, 30.0), *(run(k, 10 + 20 * kept) for k, kept in enumerate((1, 0.9, 0.7, 0.3, 0.1), 1))]
    found = breakdown(retentions(runs, NOTHING, higher_is_better=True), "haze", amounts)
    assert found.point == pytest.approx(6.0)  # halfway between .7 at 4 and .3 at 8
    assert found.interval == (None, None)  # one run a severity says nothing of their spread
    assert found.retentions == pytest.approx((1, 1, 0.9, 0.7, 0.3, 0.1))


def test_what_never_breaks_is_told_and_what_falls_at_once_breaks_before_the_first_severity() -> None:
    whole = retentions([run(0, 30.0), run(1, 29.0), run(2, 28.0)], NOTHING, higher_is_better=True)
    assert breakdown(whole, "haze", [0, 1, 2]).point is None
    broken = retentions([run(0, 30.0), run(1, 10.0), run(2, 10.0)], NOTHING, higher_is_better=True)
    assert breakdown(broken, "haze", [0, 1, 2]).point == pytest.approx(0.5)
    falling = [1.0, 0.9, 0.4]  # an intersection over union, which grows worse downwards
    worse = retentions([run(0, 30.0), run(1, 30.0), run(2, 10.0)], NOTHING, higher_is_better=True)
    assert breakdown(worse, "haze", falling).point == pytest.approx(0.65)


def test_a_curve_never_rises_and_luck_at_one_severity_is_evened_out() -> None:
    runs = [run(0, 30.0), run(1, 20.0), run(2, 28.0), run(3, 12.0)]
    found = breakdown(retentions(runs, NOTHING, higher_is_better=True), "haze", [0, 1, 2, 3])
    assert found.retentions == pytest.approx((1, 0.5, 0.9, 0.1))
    assert found.fitted == pytest.approx((1, 0.7, 0.7, 0.1))
    assert found.point == pytest.approx(2 + 0.2 / 0.6)


def test_the_interval_spans_scenes_that_break_elsewhere() -> None:
    runs = []
    for scene, kept in (("a", (1, 0.9, 0.0)), ("b", (0.2, 0.0, 0.0))):
        runs += [run(0, 30.0, scene=scene), *(run(k, 10 + 20 * v, scene=scene) for k, v in enumerate(kept, 1))]
    found = breakdown(retentions(runs, NOTHING, higher_is_better=True), "haze", [0, 1, 2, 3])
    low, high = found.interval
    assert found.point is not None
    assert low == pytest.approx(0.625)  # scene b alone
    assert high == pytest.approx(2 + 0.4 / 0.9)  # scene a alone
    assert low < found.point < high


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """Runs of twelve scenes whose breaking points are spread about 3; the truth is that of ten thousand such scenes."""
    rng = np.random.default_rng(0)
    amounts = [0, 1, 2, 3, 4, 5]

    def kept(count: int) -> np.ndarray:
        breaks = 3 + rng.normal(scale=0.5, size=(count, 1))
        return np.clip(1 - 0.5 * (np.array(amounts[1:]) / breaks) ** 4, 0, 1)

    def found(table: np.ndarray) -> dict[StressRun, float]:
        return {run(k, None, scene=f"s{n}"): v for n, row in enumerate(table) for k, v in enumerate(row.tolist(), 1)}

    means = kept(10_000).mean(axis=0)
    truth = float(np.interp(-0.5, -np.append(1.0, means), amounts))
    hits = 0
    for _ in range(60):
        low, high = breakdown(found(kept(12)), "haze", amounts).interval
        hits += low is not None and high is not None and low <= truth <= high
    assert hits >= 51, hits

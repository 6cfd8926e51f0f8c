"""Retention, S, CVaR10 and breakdown points against known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from splashbench.study.stability import Stability, StressRun, breakdown, retentions, stability, worst_mean

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


KINDS = ("haze", "gamma", "blur", "noise", "holes", "drift")


def test_stability_counts_failures_and_resamples_kinds_where_recordings_are_few() -> None:
    runs = [run(0, 30.0)]
    for number, kind in enumerate(KINDS):
        runs += [run(level, 30.0 if number % 2 else None, kind) for level in range(1, 6)]
    found = stability(retentions(runs, NOTHING, higher_is_better=True))
    assert (found.runs, found.failed, found.resampled) == (30, 15, "kinds")
    assert found.score.value == pytest.approx(0.5)
    assert found.worst.value == 0.0
    # Of six kinds that keep all or nothing, whole kinds are drawn: 30 runs one by one would lie closer about .5.
    assert found.score.interval == pytest.approx((0.0, 1.0), abs=0.01)
    of_four = {r: kept for r, kept in retentions(runs, NOTHING, higher_is_better=True).items() if r.kind in KINDS[:4]}
    assert stability(of_four).score.interval is None


def test_stability_resamples_recordings_with_all_that_was_done_to_them() -> None:
    """However many harms there are, it is the recordings whose spread is told."""

    def of(kept: dict[tuple[str, int], float]) -> Stability:
        return stability(
            {
                run(level, 1.0, kind, scene, seed): value
                for (scene, seed), value in kept.items()
                for kind in KINDS
                for level in range(1, 6)
            }
        )

    alike = of({(scene, seed): 0.7 for scene in "ab" for seed in range(3)})
    assert alike.resampled == "recordings"
    assert alike.score.interval == pytest.approx((0.7, 0.7))
    apart = of({(scene, seed): value for scene in "ab" for seed, value in enumerate((0.0, 0.5, 1.0))})
    assert apart.score.value == pytest.approx(0.5)
    low, high = apart.score.interval or (math.nan, math.nan)
    assert low < 0.2
    assert high > 0.8
    assert of({("a", 0): 0.2, ("b", 0): 0.8}).resampled == "kinds"


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
        for seed in range(3):
            of = {"scene": scene, "seed": seed}
            runs += [run(0, 30.0, **of), *(run(k, 10 + 20 * v, **of) for k, v in enumerate(kept, 1))]
    nothing = {(scene, seed): 10.0 for scene in "ab" for seed in range(3)}
    of_four = [r for r in runs if r.seed < 2]
    assert breakdown(retentions(of_four, nothing, True), "haze", [0, 1, 2, 3]).interval == (None, None)
    found = breakdown(retentions(runs, nothing, True), "haze", [0, 1, 2, 3])
    low, high = found.interval
    assert found.point is not None
    assert low == pytest.approx(0.625)  # scene b alone
    assert high == pytest.approx(2 + 0.4 / 0.9)  # scene a alone
    assert low < found.point < high


def test_runs_that_a_budget_left_out_shift_no_breaking_point() -> None:
    """Ten scenes, of which one breaks at once; a bisection runs its first severity, and the last ones of the others."""
    amounts = [0, 1, 2, 3, 4, 5]
    whole, bisected = {}, {}
    for scene in range(10):
        for level in range(1, 6):
            ran = run(level, 1.0, scene=f"s{scene}")
            whole[ran] = 0.0 if scene == 0 else 1.0
            if level in ((1, 3) if scene == 0 else (3, 5)):
                bisected[ran] = whole[ran]
    assert breakdown(bisected, "haze", amounts) == breakdown(whole, "haze", amounts)
    assert breakdown(whole, "haze", amounts).point is None
    # Between two runs and before the first it is read from both; beyond the last it stays.
    one = {run(2, 1.0): 0.8, run(4, 1.0): 0.2}
    assert breakdown(one, "haze", amounts).retentions == pytest.approx((1, 0.9, 0.8, 0.5, 0.2, 0.2))


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

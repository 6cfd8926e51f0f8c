"""The statistics against known answers: by hand, by brute force, in simulation, and by another package."""

import itertools

import numpy as np
import pytest
from scipy.stats import trim_mean

from splashbench.statistics import (
    Trajectory,
    compare,
    estimate,
    expected_running_time,
    hypervolume,
    interquartile_mean,
    mean,
    resampled,
)


def test_the_interquartile_mean_leaves_out_a_quarter_at_either_end() -> None:
    assert interquartile_mean(np.array([100.0, 2, 3, 4, 5, -100, 1, 6])) == pytest.approx(3.5)
    assert interquartile_mean(np.array([1.0, 2, 6])) == pytest.approx(3)  # a quarter of three is no run
    values = np.random.default_rng(0).normal(size=(7, 30))
    np.testing.assert_allclose(interquartile_mean(values), trim_mean(values, 0.25, axis=1))


def test_what_is_missing_is_left_out() -> None:
    values = np.array([[1.0, 2, 3, 4, np.nan, np.nan], [np.nan] * 6])
    np.testing.assert_allclose(interquartile_mean(values), [2.5, np.nan])
    np.testing.assert_allclose(mean(values[:1]), [2.5])


def test_resampling_draws_scenes_first_and_then_their_seeds() -> None:
    drawn = resampled([np.array([1.0, 2]), np.array([10.0, 20, 30])], samples=4000)
    from_first = (drawn < 5).sum(axis=1)
    # Two scenes are drawn, so the first one comes 0, 1 or 2 times, each time with two seeds.
    assert set(from_first) == {0, 2, 4}
    np.testing.assert_allclose(np.bincount(from_first)[[0, 2, 4]] / 4000, [0.25, 0.5, 0.25], atol=0.03)
    assert set(np.isfinite(drawn).sum(axis=1)) == {4, 5, 6}
    once, again = (resampled([np.arange(3.0)], samples=50) for _ in range(2))
    np.testing.assert_array_equal(once, again)


def test_four_runs_have_no_interval() -> None:
    assert estimate([np.array([1.0, 3.0]), np.array([2.0, 2.0])]).interval is None
    found = estimate([np.array([1.0, 3.0, 2.0]), np.array([2.0, 2.0])])
    assert found.value == pytest.approx(2)
    assert found.interval is not None
    assert found.interval[0] <= 2 <= found.interval[1]


def test_the_interval_covers_the_truth_as_often_as_it_says() -> None:
    rng, covered, trials = np.random.default_rng(1), 0, 400
    for _ in range(trials):
        scenes = rng.normal(0, 2, size=(20, 1)) + rng.normal(0, 0.5, size=(20, 3))
        interval = estimate(list(scenes), mean, samples=400).interval
        assert interval is not None
        covered += interval[0] <= 0 <= interval[1]
    # A percentile bootstrap of twenty scenes is a little narrow; seeds alone, without scenes, would cover a third.
    assert 0.90 <= covered / trials <= 0.98


def test_the_interquartile_mean_is_that_of_another_package() -> None:
    metrics = pytest.importorskip("rliable.metrics", reason="rliable is not installed (pip install rliable)")
    for seeds, scenes in ((5, 8), (3, 6), (1, 7)):
        scores = np.random.default_rng(seeds).normal(size=(seeds, scenes))
        assert estimate(list(scores.T)).value == pytest.approx(float(metrics.aggregate_iqm(scores)))


@pytest.mark.parametrize("dimensions", [1, 2, 3])
def test_the_hypervolume_by_counting_cells(dimensions: int) -> None:
    rng, side = np.random.default_rng(dimensions), 8
    cells = np.array(list(itertools.product(range(side), repeat=dimensions)))
    for _ in range(20):
        corners = rng.integers(0, side + 2, size=(rng.integers(0, 7), dimensions))
        # A cell is dominated where some point lies at or below its lower corner.
        inside = np.zeros(len(cells), bool)
        for corner in corners:
            inside |= (cells >= corner).all(axis=1)
        assert hypervolume(corners / side) == pytest.approx(inside.mean())


def test_points_beyond_the_reference_or_the_ideal() -> None:
    assert hypervolume(np.array([[0.5, 1.2]])) == 0
    assert hypervolume(np.array([[-3.0, 0.5]])) == pytest.approx(0.5)
    assert hypervolume(np.zeros((0, 3))) == 0


def test_a_run_in_the_course_of_time() -> None:
    run = Trajectory((5.0, 10.0, 32.0), (20.0, 24.0, 23.5))
    assert np.isnan(run.at(4.9))
    assert [run.at(t, before=10.0) for t in (4.9, 5, 9.9, 10, 1e9)] == [10, 20, 20, 24, 23.5]
    assert run.reaches(23, higher_is_better=True) == 10
    assert run.reaches(22, higher_is_better=False) == 5
    assert run.reaches(25, higher_is_better=True) is None
    assert run.spent() == 32


def test_failures_are_charged_to_the_time_to_a_target() -> None:
    good, slow = Trajectory((10.0, 40.0), (20.0, 25.0)), Trajectory((10.0, 100.0), (18.0, 19.0))
    failed = Trajectory((), (), failed_after=70.0)
    assert expected_running_time([good], 24, True) == 40
    assert expected_running_time([good, good], 20, True) == 10
    # One of three reaches it: 40 s, and the 100 and 70 s that were spent in vain.
    assert expected_running_time([good, slow, failed], 24, True) == 210
    assert expected_running_time([slow, failed], 24, True) == float("inf")


def test_methods_are_compared_on_the_scenes_both_have() -> None:
    rng = np.random.default_rng(3)
    runs = [(scene, seed) for scene in "abcdef" for seed in range(3)]
    level = {scene: float(rng.normal(0, 10)) for scene in "abcdef"}
    values = {
        "better": {run: level[run[0]] + 1 + 0.1 * rng.normal() for run in runs} | {("alone", 0): -500.0},
        # Other seeds: the numbers of two methods' seeds have nothing to do with each other.
        "worse": {(scene, seed + 5): level[scene] for scene, seed in runs if seed < 2},
        "few": {("a", 0): level["a"] - 1},
        "elsewhere": {("z", 0): 1.0},
    }
    found = compare("better", "worse", values, higher_is_better=True)
    assert found is not None
    assert found.scenes == 6
    assert found.difference.value == pytest.approx(1, abs=0.1)
    assert found.difference.interval is not None
    # The scenes' spread of ten times the difference cancels out.
    assert 0.8 < found.difference.interval[0] < found.difference.interval[1] < 1.2
    assert found.probability == 1.0
    lower = compare("better", "worse", values, higher_is_better=False)
    assert lower is not None
    assert lower.probability == 0.0
    few = compare("few", "worse", values, higher_is_better=True)
    assert few is not None
    assert (few.scenes, few.difference.interval) == (1, None)
    assert compare("better", "elsewhere", values, higher_is_better=True) is None

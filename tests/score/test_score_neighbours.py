"""Sums over nearest neighbours against those of a k-d tree: points spread evenly, in clumps, afar and on one spot."""

import time

import numpy as np
import pytest
from scipy.spatial import cKDTree

from splashbench.score.particles import neighbours
from splashbench.score.particles.copies import limited_copies
from splashbench.score.particles.neighbours import nearest_poly6_sums

RADIUS = 0.3


def _by_tree(points: np.ndarray, count: int, radius: float) -> np.ndarray:
    count = min(count, len(points) - 1)
    distances, _ = cKDTree(points).query(points, count + 1)
    inner = radius**2 - np.square(np.minimum(distances[:, 1:], radius))
    return (inner**3).sum(axis=1)


def _points(kind: str) -> np.ndarray:
    rng = np.random.default_rng(3)
    volume = rng.random((3000, 3)) * [3, 1, 1]
    if kind == "volume":
        return volume
    if kind == "sheet":
        return volume * [1, 1, 0.01]
    if kind == "line":
        return volume * [1, 0, 0]
    if kind == "clump and spray":
        return np.concatenate([0.02 * volume, 3 * volume[:1500]])
    if kind == "stray":
        return np.concatenate([volume[:500], 1e9 * rng.normal(size=(50, 3)), [[1e300, 0, 0], [-1e300, 0, 0]]])
    if kind == "one spot":
        return np.concatenate([np.ones((400, 3)), volume[:100]])
    if kind == "sparse":
        return 100 * volume[:200]
    raise AssertionError(kind)


@pytest.mark.parametrize("count", [1, 8, 64])
@pytest.mark.parametrize("kind", ["volume", "sheet", "line", "clump and spray", "stray", "one spot", "sparse"])
def test_sums_are_those_of_a_tree(kind: str, count: int) -> None:
    points = _points(kind)
    near = np.abs(points).max(axis=1) < 1e6  # the others are nobody's neighbours
    found = nearest_poly6_sums(points, count, RADIUS)
    np.testing.assert_allclose(found[near], _by_tree(points[near], count, RADIUS), rtol=1e-12)
    assert not found[~near].any()


def test_one_stray_point_leaves_the_others_their_cells() -> None:
    points = _points("volume")
    low = np.concatenate([points, [[-1e10, -1e10, -1e10]]])
    offsets = low - np.median(low, axis=0)
    size = neighbours._cell_size(offsets, 32, RADIUS)
    cells = neighbours._cells(offsets, size)
    assert len(np.unique(cells[:-1], axis=0)) > 50
    assert size == pytest.approx(neighbours._cell_size(points - np.median(points, axis=0), 32, RADIUS), rel=1e-2)


@pytest.mark.parametrize("share", [0.001, 0.02, 0.1, 5.0, 100.0])
def test_the_size_of_cells_does_not_matter(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    points = _points("volume")
    monkeypatch.setattr(neighbours, "_PER_NEIGHBOUR", share)
    np.testing.assert_allclose(nearest_poly6_sums(points, 64, RADIUS), _by_tree(points, 64, RADIUS), rtol=1e-12)


def test_fewer_points_than_neighbours_and_none() -> None:
    points = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    near, far = (RADIUS**2 - 0.01) ** 3, (RADIUS**2 - 0.04) ** 3
    np.testing.assert_allclose(nearest_poly6_sums(points, 64, RADIUS), [near + far, 2 * near, near + far])
    assert nearest_poly6_sums(np.zeros((0, 3)), 64, RADIUS).shape == (0,)
    assert nearest_poly6_sums(np.zeros((1, 3)), 64, RADIUS).tolist() == [0.0]


def test_the_same_sums_in_any_order_and_on_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    points = _points("clump and spray")
    sums = nearest_poly6_sums(points, 16, RADIUS)
    order = np.random.default_rng(4).permutation(len(points))
    np.testing.assert_allclose(nearest_poly6_sums(points[order], 16, RADIUS), sums[order], rtol=1e-13)
    monkeypatch.setattr("splashbench.parallel.thread_count", lambda: 1)
    np.testing.assert_array_equal(nearest_poly6_sums(points, 16, RADIUS), sums)


def _hostile(kind: str) -> np.ndarray:
    rng = np.random.default_rng(4)
    half = 8000
    if kind == "one point":
        return np.full((20_000, 3), 0.7)
    if kind == "nearly one point":
        return 1e-300 * rng.random((2 * half, 3))
    if kind == "half of them a clump":
        return np.concatenate([1e-7 * rng.random((half, 3)), rng.random((half, 3)) * [3, 1, 3]])
    if kind == "a clump amid strays":
        return np.concatenate([1e-7 * rng.random((half, 3)), 0.3 * (rng.random((half, 3)) - 0.5)])
    if kind == "two clumps, far apart":
        return np.concatenate([1e-6 * rng.random((half, 3)), 1e-6 * rng.random((half, 3)) + 1e30])
    raise AssertionError(kind)


@pytest.mark.parametrize(
    "kind",
    ["one point", "nearly one point", "half of them a clump", "a clump amid strays", "two clumps, far apart"],
)
def test_no_cloud_takes_the_square_of_its_number(kind: str) -> None:
    points = _hostile(kind)
    nearest_poly6_sums(points[:100], 64, RADIUS)  # compiled by now
    began = time.process_time()
    sums = nearest_poly6_sums(points, 64, RADIUS)
    seconds = time.process_time() - began
    assert seconds < 0.3  # points that are spread evenly: 0.05; every pair: 0.4 to 1.6
    if "one point" in kind:
        np.testing.assert_allclose(sums, 64 * RADIUS**6, rtol=1e-12)


def test_a_clump_within_a_cloud_changes_no_sum() -> None:
    points = _hostile("a clump amid strays")[6000:10_000]  # few enough for a tree
    np.testing.assert_allclose(nearest_poly6_sums(points, 8, RADIUS), _by_tree(points, 8, RADIUS), rtol=1e-10)


def test_points_that_lie_on_each_other_are_looked_at_as_often_as_it_takes() -> None:
    rng = np.random.default_rng(5)
    points = rng.random((300, 3))[rng.integers(0, 300, 6000)]  # some twenty at each place
    for count in (4, 64):
        np.testing.assert_allclose(
            nearest_poly6_sums(points, count, RADIUS), _by_tree(points, count, RADIUS), rtol=1e-9
        )


def test_copies_are_limited_and_each_point_knows_one_at_its_place() -> None:
    rng = np.random.default_rng(6)
    points = rng.random((50, 3))[rng.integers(0, 50, 3000)]
    limited = limited_copies(points, 5)
    assert limited is not None
    kept, place = limited
    assert len(kept) == 250
    assert (np.diff(kept) > 0).all()
    np.testing.assert_array_equal(points[kept][place], points)
    np.testing.assert_array_equal(place[kept], np.arange(250))
    for row in np.unique(points, axis=0):  # the first ones stay
        rows = np.flatnonzero((points == row).all(axis=1))
        np.testing.assert_array_equal(np.intersect1d(kept, rows), rows[:5])
    assert limited_copies(rng.random((3000, 3)), 5) is None
    assert limited_copies(points[:500], 5) is None

"""Particles are coloured by what they do: speeds, ages and heights with known answers."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench.scene import Particles
from splashbench.viewer.coloring import UNKNOWN, colors_of, legend
from splashbench.viewer.tracks import Tracks

TIMES = np.array([0.0, 0.1, 0.3, 0.4])
UP = np.array([0.0, 1.0, 0.0])


def falling(velocities: bool = False) -> Particles:
    """Row 0 flies along x at 2 units a second; row 1 rests, 5 high, from .1 to .3 s; row 2 is never there."""
    positions = np.zeros((4, 3, 3))
    positions[:, 0, 0] = 2 * TIMES
    positions[:, 1, 1] = 5
    active = np.array([[1, 0, 0], [1, 1, 0], [1, 1, 0], [1, 0, 0]], bool)
    own = np.full((4, 3, 3), 7.0) if velocities else None
    return Particles(positions, active, own)  # type: ignore[arg-type]


def test_each_timestep_has_those_that_are_there() -> None:
    tracks = Tracks.of(falling(), TIMES, most=10)
    assert [len(p) for p in tracks.positions] == [1, 2, 2, 1]
    assert tracks.left_out == 0


def test_speeds_are_of_the_same_row() -> None:
    tracks = Tracks.of(falling(), TIMES, most=10)
    for t in range(4):
        assert tracks.values("speed", t, UP)[0] == pytest.approx(2.0, rel=1e-5)
    assert tracks.values("speed", 1, UP)[1] == 0


def test_the_methods_own_velocities_come_first() -> None:
    tracks = Tracks.of(falling(velocities=True), TIMES, most=10)
    assert tracks.values("speed", 1, UP).tolist() == pytest.approx([7 * 3**0.5] * 2)


def test_ages_start_with_the_particle() -> None:
    tracks = Tracks.of(falling(), TIMES, most=10)
    assert tracks.values("age", 2, UP).tolist() == pytest.approx([0.3, 0.2])


def test_a_particle_that_comes_back_is_young_again() -> None:
    active = np.array([[1], [0], [1], [1]], bool)
    tracks = Tracks.of(Particles(np.zeros((4, 1, 3)), active), TIMES, most=10)  # type: ignore[arg-type]
    assert tracks.values("age", 3, UP).tolist() == pytest.approx([0.1])


def test_heights_are_along_up() -> None:
    tracks = Tracks.of(falling(), TIMES, most=10)
    assert tracks.values("height", 1, UP).tolist() == [0, 5]
    assert tracks.values("height", 1, -UP).tolist() == [0, -5]


def test_rows_that_are_another_particle_each_time_have_neither_speed_nor_age() -> None:
    active = np.arange(4)[:, None] % 2 == np.arange(6)[None] % 2
    tracks = Tracks.of(Particles(np.zeros((4, 6, 3)), active), TIMES, most=10)  # type: ignore[arg-type]
    assert not tracks.followed
    assert np.isnan(tracks.values("speed", 1, UP)).all()
    assert np.isnan(tracks.values("age", 1, UP)).all()
    assert [tracks.has(measure) for measure in ("speed", "age", "height")] == [False, False, True]


def test_the_colours_mean_the_same_at_every_time() -> None:
    tracks = Tracks.of(falling(), TIMES, most=10)
    assert tracks.span("speed", UP)[0] == 0
    assert tracks.span("speed", UP)[1] == pytest.approx(2.0, rel=1e-5)
    low, high = tracks.span("height", UP)
    assert (low, high) == (0, 5)


def test_too_many_are_thinned_by_rows() -> None:
    rng = np.random.default_rng(0)
    crowd = Particles(rng.normal(size=(4, 1000, 3)), np.ones((4, 1000), bool))  # type: ignore[arg-type]
    tracks = Tracks.of(crowd, TIMES, most=300)
    assert [len(p) for p in tracks.positions] == [250] * 4
    np.testing.assert_array_equal(tracks.positions[2], crowd.positions[2, ::4])
    assert tracks.left_out == pytest.approx(0.75)


def test_none_at_all() -> None:
    tracks = Tracks.of(Particles(np.zeros((4, 0, 3)), np.zeros((4, 0))), TIMES, most=10)  # type: ignore[arg-type]
    assert tracks.span("speed", UP) == (0, 1)
    assert not tracks.has("speed")


def test_colours_run_from_dark_blue_to_yellow_and_grey_is_unknown() -> None:
    found = colors_of([-1.0, 0.0, 2.0, 9.0, float("nan")], (0.0, 2.0)).astype(int)
    assert (found[0] == found[1]).all()
    assert (found[2] == found[3]).all()
    assert found[1, 2] > found[1, 0]  # blue
    assert min(found[2, :2]) > 2 * found[2, 2]  # yellow
    assert tuple(found[4]) == UNKNOWN
    assert (legend()[0, 0] == found[1]).all()
    assert (legend()[0, -1] == found[2]).all()

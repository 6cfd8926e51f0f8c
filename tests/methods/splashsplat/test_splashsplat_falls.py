"""How fast a jet falls where nobody told how strong gravity is: by its ends, its shape and its beads."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench_methods.splashsplat.fields.falls import Ends, FreeFall, Unscaled
from splashbench_methods.splashsplat.fields.jet import Slices, fit_jets

VOXEL = 0.005
TOP, BOTTOM = 0.3, 0.1
TIMES = np.arange(40) / 30


def poured(
    fall: FreeFall, times: np.ndarray, first: float | None, last: float | None, unit: float = 1.0, beads: float = 0.0
) -> list[Slices]:
    """Slices of a jet that drifts as it falls, whose first drop passes the top at `first` and its last at `last`
    seconds, in units of which a metre has `unit`; `beads`: how much thicker and thinner it is where it is."""
    frames = []
    for t, time in enumerate(times):
        height = (np.arange(20, 60) + 0.5) * VOXEL
        left = time - fall.lasted(height)  # when it passed the top
        there = np.ones(len(height), bool)
        if first is not None:
            there &= left >= first
        if last is not None:
            there &= left <= last
        rng = np.random.default_rng(t)
        middle = np.stack([0.35 * fall.lasted(height), np.zeros(len(height))], axis=1)
        middle += rng.normal(0, 0.1 * VOXEL, middle.shape)
        thick = 1 + beads * (np.sin(2 * np.pi * left / 0.022) + 0.6 * np.sin(2 * np.pi * left / 0.051)) / 1.6
        area = 6e-4 / fall.down(height) * thick * np.exp(rng.normal(0, 0.05, len(height)))
        frames.append(Slices(unit * height[there], unit * middle[there], unit**2 * area[there]))
    return frames


@pytest.mark.parametrize("unit", [0.1, 1.0, 7.0])
@pytest.mark.parametrize(("first", "last"), [(0.21, 1.03), (0.22, None), (None, 0.94)])
@pytest.mark.parametrize(("speed", "gravity"), [(1.0, 9.81), (1.6, 9.81), (1.0, 3.7)])
def test_ends_tell_how_strong_gravity_is(
    speed: float, gravity: float, first: float | None, last: float | None, unit: float
) -> None:
    fall = FreeFall(TOP, speed, gravity)
    jet = fit_jets(poured(fall, TIMES, first, last, unit), TIMES, None, unit * VOXEL)[15]
    assert jet is not None
    heights = np.array([0.12, 0.2, 0.29])
    np.testing.assert_allclose(-jet.velocity(unit * heights)[:, 2] / unit, fall.down(heights), rtol=0.2)
    np.testing.assert_allclose(jet.velocity(unit * heights)[:, 0] / unit, 0.35, rtol=0.2)
    assert jet.gravity / unit == pytest.approx(gravity, rel=0.4)


def test_a_steady_jet_may_be_slow_or_fast() -> None:
    """Its shape has the ratio of speed and gravity alone."""
    steady = poured(FreeFall(TOP, 1.0, 9.81), TIMES, None, None)
    assert fit_jets(steady, TIMES, None, VOXEL) == [None] * len(TIMES)
    assert fit_jets(steady, TIMES, 9.81, VOXEL) != [None] * len(TIMES)


@pytest.mark.parametrize("seed", range(4))
def test_masks_that_flicker_at_the_ends_of_a_steady_jet_are_no_drops(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flickering = []
    for frame, low, high in zip(poured(FreeFall(TOP, 1.0, 9.81), TIMES, None, None), *rng.integers(0, 15, (2, 40))):
        kept = slice(low, len(frame.height) - high)
        flickering.append(Slices(frame.height[kept], frame.middle[kept], frame.area[kept]))
    assert fit_jets(flickering, TIMES, None, VOXEL) == [None] * len(TIMES)


def test_ends_that_fall_between_two_frames_say_too_little() -> None:
    """Half a second from frame to frame: no end is seen twice."""
    times = np.arange(10) * 0.5
    assert fit_jets(poured(FreeFall(TOP, 1.0, 9.81), times, 0.48, 3.9), times, None, VOXEL) == [None] * 10


def test_beads_tell_it_finer() -> None:
    fall = FreeFall(TOP, 1.25, 9.81)
    jet = fit_jets(poured(fall, TIMES, 0.21, 1.03, beads=0.8), TIMES, None, VOXEL)[15]
    assert jet is not None
    heights = np.array([0.12, 0.2, 0.29])
    np.testing.assert_allclose(-jet.velocity(heights)[:, 2], fall.down(heights), rtol=0.05)


def test_a_faster_fall_of_the_same_shape() -> None:
    fall, heights = FreeFall(TOP, 1.0, 9.81), np.array([0.1, 0.2, 0.32])
    np.testing.assert_allclose(fall.faster(3.0).lasted(heights), fall.lasted(heights) / 3)
    np.testing.assert_allclose(fall.faster(3.0).down(heights), 3 * fall.down(heights))
    assert fall.lasted(np.array([TOP])) == 0
    assert fall.down(np.array([5.0])) == 0  # it never was so high


def test_first_drops_are_followed_to_the_ground_where_it_is_seen() -> None:
    times, heights = np.arange(5) * 0.04, [np.array([0.22, 0.28]), *[np.array([0.12, 0.28])] * 4]
    assert Ends.of(heights, times, VOXEL, TOP, BOTTOM + 0.02).runs == []
    (run,) = Ends.of(heights, times, VOXEL, TOP, BOTTOM + 0.02, [0.22, 0.14, 0.03, 0.0, 0.0]).runs
    np.testing.assert_allclose(run, [[0.0, 0.22], [0.04, 0.14], [0.08, 0.03]])
    # A drop that lags behind is no end of the jet's.
    (run,) = Ends.of(heights, times, VOXEL, TOP, BOTTOM + 0.02, [0.22, 0.14, 0.11, 0.0, 0.0]).runs
    np.testing.assert_allclose(run, [[0.0, 0.22], [0.04, 0.14]])
    # Where there is no liquid yet, none falls; and what rises does not.
    lowest = [np.inf, 0.2, 0.1, 0.15, 0.0]
    (run,) = Ends.of(heights, times, VOXEL, TOP, BOTTOM + 0.02, lowest).runs
    np.testing.assert_allclose(run, [[0.04, 0.2], [0.08, 0.1]])


def test_falls_are_known_where_all_that_explain_as_much_last_alike() -> None:
    fall = FreeFall(TOP, 1.0, 9.81)
    seen = np.array([[0.0, TOP - fall.speed * 0.03 - 0.5 * 9.81 * 0.03**2], [0.06, TOP - 0.09 - 0.5 * 9.81 * 0.09**2]])
    shapes, flat = 9.81 * np.geomspace(0.2, 5, 9), np.zeros(9)
    told = Unscaled.of(shapes, flat, Ends([seen], VOXEL), TIMES, TOP, BOTTOM)
    assert told.known
    half_way = seen[:, 1].mean()
    assert told.best().down(half_way) == pytest.approx(fall.down(half_way), rel=0.1)
    assert 0 < len(told.as_good()) < told.cost.size
    for nothing in ([], [np.array([[0.0, 0.25], [0.04, 0.2495]])]):
        assert not Unscaled.of(shapes, flat, Ends(nothing, VOXEL), TIMES, TOP, BOTTOM).known

"""The parts of videos by themselves: scales, captions, speeds in words, and flicker."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.scene import Camera, look_at
from splashbench.video.captions import Line, Strip, speed_text
from splashbench.video.flicker import second_difference, subdivided
from splashbench.video.scales import Scale, round_range
from splashbench.video.timing import Timing
from splashbench.video.views import looked_at, upright


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.803, 1.131, (0.8, 1.15)),
        (0.0, 0.47, (0.0, 0.5)),
        (-13.2, 87.0, (-20.0, 100.0)),
        (0.0, 1e-5, (0.0, 1e-5)),
        (2.0, 2.0, (1.8, 2.2)),
        (0.0, 0.0, (-0.0001, 0.0001)),
    ],
)
def test_ends_of_a_scale_are_round_and_hold_what_is_seen(
    low: float, high: float, expected: tuple[float, float]
) -> None:
    ends = round_range(low, high)
    assert ends == pytest.approx(expected)
    assert ends[0] <= low <= high <= ends[1]


def test_colours_of_a_scale_rise_in_brightness_and_end_at_its_ends() -> None:
    for name in ("viridis", "cividis", "inferno"):
        scale = Scale("depth", 2.0, 4.0, "m", name)
        brightness = scale.colors(np.linspace(2, 4, 50)) @ np.array([0.2126, 0.7152, 0.0722])
        assert (np.diff(brightness) > -0.6).all()
        assert brightness[-1] > brightness[0] + 100
        ends = scale.colors(np.array([-9.0, 2.0, 4.0, 99.0]))
        assert np.array_equal(ends[0], ends[1])
        assert np.array_equal(ends[2], ends[3])


def test_what_has_no_value_is_grey() -> None:
    picture = np.full((2, 2, 3), (200, 10, 90), np.uint8)
    values = np.array([[np.nan, 1.0], [0.0, np.nan]], np.float32)
    shown = Scale("speed", 0.0, 1.0, "m/s", "viridis").over(values, picture)
    assert np.ptp(shown[0, 0]) == 0
    assert 0 < shown[0, 0, 0] < 90
    assert np.array_equal(shown[0, 1], [253, 231, 37])  # viridis' last
    assert np.array_equal(shown[1, 0], [68, 1, 84])


def test_a_strip_has_one_height_and_breaks_what_does_not_fit() -> None:
    line = Line("splashsplat", "0.533 s, 1/8 speed")
    wide, narrow, half = (Strip(*given, None) for given in ((600, [line]), (100, [line]), (100, [Line("splashsplat")])))
    assert wide.draw([Line("a", "b")], wide.height).shape == (wide.height, 600, 3)
    assert narrow.height > half.height  # two lines
    long = Strip(60, [Line("a name that is longer than the picture is wide")], None)
    strip = long.draw([Line("a name that is longer than the picture is wide")], long.height)
    assert strip.shape[1] == 60
    assert strip.max() > 150


def test_a_strip_shows_the_colours_of_its_scale() -> None:
    scale = Scale("depth", 0.0, 1.0, "m", "viridis")
    strip = Strip(300, [Line("x")], scale)
    drawn = strip.draw([Line("x")], strip.height)
    for color in scale.colors(np.array([0.25, 0.5, 0.75])):
        assert (np.abs(drawn.astype(int) - color).max(axis=-1) <= 3).any()


@pytest.mark.parametrize(
    ("speed", "text"),
    [
        *[(1.0, "real time"), (0.125, "1/8 speed"), (0.5, "1/2 speed"), (2.0, "2x speed"), (0.0, "frozen")],
        *[(0.3, "0.3x speed"), (-1.0, "-1x speed"), (0.01, "1/100 speed"), (1 / 3, "1/3 speed")],
    ],
)
def test_speeds_in_words(speed: float, text: str) -> None:
    assert speed_text(speed) == text


def test_timing_is_of_numbers() -> None:
    for times in ([], [np.nan], [[0.0]]):
        with pytest.raises(ValueError, match="instants, which are numbers"):
            Timing(np.array(times), 30)
    for fps in (0, np.inf, np.nan, -30):
        with pytest.raises(SplashbenchError, match="frames a second"):
            Timing(np.array([0.0]), fps)


def test_up_is_across_the_rows_of_the_pictures() -> None:
    eyes = [(np.cos(a), 0.6, np.sin(a)) for a in (0.2, 0.6, 1.0)]
    K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    cameras = [Camera("c", 100, 100, K, look_at(eye, (0, 0.1, 0))) for eye in eyes]
    assert upright(cameras) == pytest.approx([0, 1, 0], abs=1e-9)
    assert looked_at(cameras) == pytest.approx([0, 0.1, 0])
    one = upright(cameras[:1] * 3)  # rows that tell nothing
    assert one @ np.array([0, 1, 0]) > 0.8 * np.linalg.norm(one)


def video(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A soft blob at `places` [N] along a row of 64 pixels: colours and where it is."""
    x = np.arange(64) + 0.5
    alpha = np.exp(-(((x - places[:, None]) / 4) ** 2))[:, None]
    return np.repeat(alpha[..., None], 3, axis=-1), alpha > 0.5


def test_steady_motion_does_not_flicker_and_a_jump_at_timesteps_does() -> None:
    steady = np.linspace(12, 52, 49)
    smooth = second_difference(*video(steady), 8)
    assert smooth.ratio == pytest.approx(1, abs=0.05)
    jumping = steady + 0.4 * (np.arange(49) % 8 == 0)
    assert second_difference(*video(jumping), 8).ratio > 2
    held = second_difference(*video(steady[np.arange(49) // 8 * 8]), 8)
    assert held.mean > 3 * smooth.mean
    assert held.ratio > 5
    assert np.isnan(smooth.values[[0, -1]]).all()


def test_a_blend_of_timesteps_has_all_its_second_difference_at_them() -> None:
    rgb, liquid = video(np.linspace(12, 52, 49))
    steps, place = rgb[::8], np.arange(49) / 8
    before = np.minimum(place.astype(int), 5)
    share = (place - before)[:, None, None, None]
    blended = second_difference((1 - share) * steps[before] + share * steps[before + 1], liquid, 8)
    assert blended.between == pytest.approx(0, abs=1e-9)
    assert blended.seams > 1


def test_it_is_of_liquid_alone() -> None:
    rgb, liquid = video(np.full(17, 30.0))
    rgb[::2, :, :5] = 1  # the corner flickers, where no liquid is
    assert second_difference(rgb, liquid, 8).mean == 0
    assert np.isnan(second_difference(rgb, np.zeros_like(liquid), 8).mean)
    with pytest.raises(ValueError, match="three frames"):
        second_difference(rgb[:2], liquid[:2], 8)


def test_instants_divide_uneven_steps_evenly() -> None:
    assert subdivided(np.array([0.0, 1.0, 3.0]), 2).tolist() == [0, 0.5, 1, 2, 3]

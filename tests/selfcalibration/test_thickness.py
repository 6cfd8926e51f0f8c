"""Clocks that are off are found by liquid that has no droplets: how much of it planes hold comes and goes together."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from numpy.typing import NDArray

from splashbench.scene import Camera
from splashbench.scene.camera import look_at
from splashbench.selfcalibration.clocks import clock_offsets, droplets_of
from splashbench.selfcalibration.thickness import Thickness, lag_of, rough_offsets

from .conftest import STEP, Droplets, discs

Cameras = dict[str, Camera]
Shown = Callable[[Camera, float], NDArray[np.bool_]]
DOWN = np.array([0.0, -1.0, 0.0])
TIMESTEPS = 40


def swell(camera: Camera, time: float) -> NDArray[np.bool_]:
    """Bodies of liquid that rise and fall above a pool, each at its own pace: bool [H, W]."""
    rng = np.random.default_rng(5)
    count = 7
    middle = rng.uniform([-0.4, 0.1, -0.4], [0.4, 0.45, 0.2], (count, 3))
    pace, start = rng.uniform(4, 11, (count, 2)), rng.uniform(0, 2 * np.pi, (count, 2))
    middle[:, 1] += (rng.uniform(0.05, 0.15, (count, 2)) * np.sin(pace * time + start)).sum(axis=1)
    return discs(camera, middle, rng.uniform(5, 12, count))


def seen(cameras: Mapping[str, Camera], late: Mapping[str, float], shown: Shown = swell) -> dict[str, Thickness]:
    """late: by camera, timesteps."""
    return {
        name: Thickness.of([shown(camera, (t + late.get(name, 0.0)) * STEP) for t in range(TIMESTEPS)], camera)
        for name, camera in cameras.items()
    }


def apart(offsets: Mapping[str, float], late: Mapping[str, float]) -> NDArray[np.float64]:
    """Errors, but for what all are off by together."""
    errors = np.array([offsets[name] - late.get(name, 0.0) for name in offsets])
    return np.asarray(errors - np.median(errors))


@pytest.mark.parametrize("late", [0.0, 0.25, -0.6, 1.0, 2.6, -3.5, 6.0])
@pytest.mark.parametrize("name", ["1", "3"])
def test_one_clock_that_is_off_is_found(cameras: Cameras, name: str, late: float) -> None:
    offsets = rough_offsets(seen(cameras, {name: late}))
    assert set(offsets) == set(cameras)
    assert np.abs(apart(offsets, {name: late})).max() < 0.2


def test_clocks_that_are_all_off_are_found_beside_each_other(cameras: Cameras) -> None:
    late = {"1": -1.0, "2": 2.3, "3": 0.5, "4": -3.0, "5": 1.75}
    offsets = rough_offsets(seen(cameras, late))
    assert set(offsets) == set(cameras)
    assert np.abs(apart(offsets, late)).max() < 0.25


def test_the_second_of_a_pair_is_later_where_its_lag_is_positive(cameras: Cameras) -> None:
    views = seen(cameras, {"2": 2.0})
    lag = lag_of(views["1"], views["2"])
    assert lag is not None
    assert lag.timesteps == pytest.approx(2.0, abs=0.1)
    assert lag.agreement > 0.8
    back = lag_of(views["2"], views["1"])
    assert back is not None
    assert back.timesteps == pytest.approx(-2.0, abs=0.1)


def test_a_camera_that_shows_something_else_has_no_offset_and_the_others_keep_theirs(cameras: Cameras) -> None:
    views = seen(cameras, {"4": 2.0})
    rng = np.random.default_rng(0)
    other = [rng.random((160, 240)) < 0.05 for _ in range(TIMESTEPS)]
    views["2"] = Thickness.of(other, cameras["2"])
    offsets = rough_offsets(views)
    assert set(offsets) == {"1", "3", "4", "5"}
    assert np.abs(apart(offsets, {"4": 2.0})).max() < 0.2


def test_what_does_not_move_says_nothing(cameras: Cameras) -> None:
    assert rough_offsets(seen(cameras, {}, lambda camera, time: swell(camera, 0.0))) == {}
    assert rough_offsets(seen(cameras, {}, lambda camera, time: np.zeros((160, 240), bool))) == {}


def test_two_cameras_or_few_frames_say_nothing(cameras: Cameras) -> None:
    assert rough_offsets(seen({name: cameras[name] for name in ("1", "2")}, {"2": 1.0})) == {}
    views = seen(cameras, {})
    short = {name: Thickness(view.camera, view.wet[:7]) for name, view in views.items()}
    assert rough_offsets(short) == {}


def test_cameras_that_look_at_each_other_or_stand_in_one_place_are_no_pair() -> None:
    K = np.array([[230.0, 0, 120], [0, 230, 80], [0, 0, 1]])
    one = Camera("1", 240, 160, K, look_at((0, 0.3, 2)))
    facing = Camera("2", 240, 160, K, look_at((0, -0.3, -2)))
    masks = [swell(one, t * STEP) for t in range(TIMESTEPS)]
    assert lag_of(Thickness.of(masks, one), Thickness.of(masks, facing)) is None
    assert lag_of(Thickness.of(masks, one), Thickness.of(masks, one)) is None


def test_large_images_are_looked_at_smaller(cameras: Cameras) -> None:
    camera = cameras["1"].scaled(4)
    view = Thickness.of([np.repeat(np.repeat(swell(cameras["1"], 0.0), 4, 0), 4, 1)], camera)
    assert (view.camera.width, view.camera.height) == (240, 160)
    assert view.wet.sum() == pytest.approx(swell(cameras["1"], 0.0).sum())


@pytest.mark.parametrize("late", [0.3, 3.3, -5.0])
def test_droplets_tell_the_rest_and_where_there_are_none_it_stays_rough(cameras: Cameras, late: float) -> None:
    droplets = Droplets(30, (TIMESTEPS + 12) * STEP, seed=3)
    drops = {}
    for name, camera in cameras.items():
        off = late if name == "2" else 0.0
        masks = [droplets.mask(camera, (t + off + 6) * STEP) for t in range(TIMESTEPS)]
        drops[name] = droplets_of(masks, camera)
    roughly = rough_offsets(seen(cameras, {"2": late}))
    found = clock_offsets(drops, cameras, DOWN, roughly)
    assert set(found) == {"2"}
    assert found["2"].timesteps == pytest.approx(late, abs=0.04)
    assert found["2"].votes > 0
    # Without droplets it is told roughly, from a third of a timestep on.
    alone = clock_offsets({name: [np.zeros((0, 2))] * TIMESTEPS for name in cameras}, cameras, DOWN, roughly)
    if abs(late) < 0.35:
        assert alone == {}
    else:
        assert set(alone) == {"2"}
        assert alone["2"].timesteps == pytest.approx(late, abs=0.2)
        assert alone["2"].votes == 0


def test_cameras_that_are_known_roughly_do_not_move_the_clock_of_those_known_well(cameras: Cameras) -> None:
    """Of two cameras droplets do not tell, and both are taken to be a tenth of a timestep late."""
    droplets = Droplets(30, (TIMESTEPS + 12) * STEP, seed=3)
    drops = {}
    for name, camera in cameras.items():
        off = 2.0 if name == "2" else 0.0
        masks = [droplets.mask(camera, (t + off + 6) * STEP) for t in range(TIMESTEPS)]
        drops[name] = droplets_of(masks, camera) if name in "234" else [np.zeros((0, 2))] * TIMESTEPS
    found = clock_offsets(drops, cameras, DOWN, {"1": 0.1, "2": 2.0, "3": 0.0, "4": 0.0, "5": 0.15})
    assert set(found) == {"2"}
    assert found["2"].timesteps == pytest.approx(2.0, abs=0.04)


def test_a_camera_that_is_not_known_roughly_is_told_by_its_droplets(cameras: Cameras) -> None:
    """It starts from its clock as told, however far the others are off."""
    droplets = Droplets(30, (TIMESTEPS + 12) * STEP, seed=3)
    late = {"1": 0.6, "2": -4.0}
    drops = {
        name: droplets_of([droplets.mask(c, (t + late.get(name, 0.0) + 6) * STEP) for t in range(TIMESTEPS)], c)
        for name, c in cameras.items()
    }
    # Offsets whose common part is anything.
    found = clock_offsets(drops, cameras, DOWN, {"2": -1.0, "3": 3.0, "4": 3.0, "5": 3.0})
    assert {name: offset.timesteps for name, offset in found.items()} == pytest.approx(late, abs=0.05)


def test_droplets_that_contradict_all_other_liquid_have_no_say(cameras: Cameras) -> None:
    """Votes for an offset of one timestep, while what else there is says none."""
    droplets = Droplets(30, TIMESTEPS * STEP, seed=3)
    drops = {
        name: droplets_of(
            [droplets.mask(camera, (t + (0.6 if name == "2" else 0.0)) * STEP) for t in range(TIMESTEPS)], camera
        )
        for name, camera in cameras.items()
    }
    assert set(clock_offsets(drops, cameras, DOWN)) == {"2"}
    assert clock_offsets(drops, cameras, DOWN, rough_offsets(seen(cameras, {}))) == {}

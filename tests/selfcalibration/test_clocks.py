"""A clock that is off is found by droplets in flight, a camera that was knocked by what it sees before and after."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from splashbench.scene import Camera, Scene
from splashbench.selfcalibration import clocks
from splashbench.selfcalibration.clocks import Offset, clock_offsets, droplets_of
from splashbench.selfcalibration.stance import find_knock

from .conftest import KNOCKED_AT, KNOCKED_BY, STEP, Droplets, discs, photograph, turned

Cameras = dict[str, Camera]
DOWN = np.array([0.0, -1.0, 0.0])
TIMESTEPS = 24


@pytest.fixture(scope="module")
def droplets() -> Droplets:
    return Droplets(25, TIMESTEPS * STEP, seed=3)


def flown(droplets: Droplets, camera: Camera, late: float = 0.0) -> list[NDArray[np.bool_]]:
    return [droplets.mask(camera, t * STEP + late) for t in range(TIMESTEPS)]


def offsets(masks: Mapping[str, Iterable[NDArray[np.bool_]]], cameras: Cameras) -> dict[str, Offset]:
    drops = {name: droplets_of(each, cameras[name]) for name, each in masks.items()}
    return clock_offsets(drops, cameras, DOWN)


@pytest.mark.parametrize(("name", "late"), [("2", 0.010), ("5", -0.025)])
def test_a_clock_that_is_off_is_found_to_a_millisecond(
    droplets: Droplets, cameras: Cameras, name: str, late: float
) -> None:
    masks = {each: flown(droplets, camera, late if each == name else 0) for each, camera in cameras.items()}
    ((found, offset),) = offsets(masks, cameras).items()
    assert found == name
    assert offset.timesteps * STEP == pytest.approx(late, abs=0.001)
    assert offset.votes > 3 * max(offset.votes_as_told, offset.votes_elsewhere)


def test_two_clocks_that_are_off_are_found(droplets: Droplets, cameras: Cameras) -> None:
    late = {"1": -0.012, "4": 0.040}
    masks = {name: flown(droplets, camera, late.get(name, 0)) for name, camera in cameras.items()}
    found = offsets(masks, cameras)
    assert {name: offset.timesteps * STEP for name, offset in found.items()} == pytest.approx(late, abs=0.001)


def test_right_clocks_are_left_as_told(droplets: Droplets, cameras: Cameras) -> None:
    assert offsets({name: flown(droplets, camera) for name, camera in cameras.items()}, cameras) == {}


def test_without_droplets_nothing_is_known(droplets: Droplets, cameras: Cameras) -> None:
    nothing = {name: [np.zeros((160, 240), bool)] * TIMESTEPS for name in cameras}
    assert offsets(nothing, cameras) == {}
    # Two cameras cannot say which of them is off.
    two = {name: flown(droplets, cameras[name], late) for name, late in (("1", 0.0), ("2", 0.01))}
    assert offsets(two, cameras) == {}


def test_a_still_blob_says_nothing(cameras: Cameras) -> None:
    blob = {name: discs(camera, np.array([[0.0, 0.3, 0.0]]), np.array([2.5])) for name, camera in cameras.items()}
    masks = {name: [mask] * TIMESTEPS for name, mask in blob.items()}
    assert all(mask.sum() > 10 for mask in blob.values())
    assert offsets(masks, cameras) == {}


@pytest.mark.parametrize("late", [0.0, 0.010])
def test_the_beads_of_a_stream_say_nothing(cameras: Cameras, late: float) -> None:
    """They are alike and at the same distance, and later ones are where earlier ones were."""

    def beads(camera: Camera, time: float) -> NDArray[np.bool_]:
        interval = 0.03
        ages = time % interval + interval * np.arange(12)
        heights = 1.0 - 0.3 * ages - 0.5 * 9.81 * ages**2
        places = np.stack([0 * heights, heights, 0 * heights], axis=1)[heights > 0.02]
        return discs(camera, places, np.full(len(places), 1.2))

    masks = {
        name: [beads(camera, t * STEP + (late if name == "2" else 0)) for t in range(TIMESTEPS)]
        for name, camera in cameras.items()
    }
    for each in masks.values():
        assert sum(cv2.connectedComponents(mask.astype(np.uint8))[0] - 1 for mask in each) > 6 * TIMESTEPS
    assert offsets(masks, cameras) == {}


def test_droplets_are_small_and_whole_and_fly(cameras: Cameras) -> None:
    """Not what fills the image, nor what its edge cuts, nor what stays where it is."""
    masks = np.zeros((8, 160, 240), bool)
    for t in range(8):
        masks[t, 100:140, 20:80] = True  # a pool
        masks[t, 0:3, 100 + 2 * t : 103 + 2 * t] = True  # cut by the edge
        masks[t, 50:53, 200:203] = True  # stays
        masks[t, 40 + 4 * t : 43 + 4 * t, 120:123] = True
    found = droplets_of(masks, cameras["1"])
    assert [drops.tolist() for drops in found] == [[[121.5, 41.5 + 4 * t]] for t in range(8)]


def test_of_many_droplets_the_largest_have_a_say_and_flights_are_bounded(cameras: Cameras) -> None:
    """Votes would take hours and gigabytes: they grow with the sixth power of the droplets' number."""
    masks = np.zeros((3, 160, 240), bool)
    grid = [(row, column) for row in range(4, 144, 12) for column in range(4, 232, 12)]
    places = np.random.default_rng(0).permutation(grid)[:200]
    for t, mask in enumerate(masks):
        for number, (row, column) in enumerate(places):
            side = 3 if number < 80 else 2
            mask[row + 4 * t : row + 4 * t + side, column : column + side] = True
    found = droplets_of(masks, cameras["1"])
    assert [len(drops) for drops in found] == [80, 80, 80]
    assert {float(middle[0]) % 1 for middle in found[0]} == {0.5}  # of three pixels, not of two
    flights = clocks._flights(found, cameras["1"], DOWN, 12.0, 1.0)
    assert len(flights.frame) == len(flights.places) == len(flights.alike) == clocks._MOST_FLIGHTS


def views(frames: list[NDArray[np.uint8]], camera: Camera) -> Any:
    """A training scene of one camera."""
    return SimpleNamespace(
        cameras={camera.name: camera},
        n_frames=len(frames),
        image=lambda name, t: frames[t],
        mask=lambda name, t: np.zeros(frames[t].shape[:2], bool),
    )


def test_a_knocked_camera_is_found_with_frame_and_angle(wrong: Scene, cameras: Cameras) -> None:
    knock = find_knock(wrong.training(), "4")
    assert knock is not None
    assert knock.frame == KNOCKED_AT
    assert knock.degrees == pytest.approx(KNOCKED_BY, abs=0.02)
    # As it was turned, not the other way round.
    before = cameras["4"].w2c[:3, :3]
    np.testing.assert_allclose(knock.rotation @ before, turned(cameras["4"], KNOCKED_BY).w2c[:3, :3], atol=5e-4)
    assert find_knock(wrong.training(), "3") is None


@pytest.mark.parametrize("frame", [3, 5, 7])
def test_the_frame_of_a_knock_is_exact(cameras: Cameras, frame: int) -> None:
    """Where the plates of the first and of the last frames do not mix."""
    camera = cameras["3"]
    before, after = photograph(camera), photograph(turned(camera, 1.0, (1, 0, 0)))
    knock = find_knock(views([after if t >= frame else before for t in range(10)], camera), "3")
    assert knock is not None
    assert knock.frame == frame
    assert knock.degrees == pytest.approx(1.0, abs=0.02)


def test_where_little_is_seen_no_camera_was_knocked(cameras: Cameras) -> None:
    camera = cameras["3"]
    before, after = photograph(camera), photograph(turned(camera, 1.0))
    grey = np.full_like(before, 90)
    assert find_knock(views([before] * 3 + [after] * 2, camera), "3") is None  # five frames are too few
    assert find_knock(views([before] * 3 + [after] * 3, camera), "3") is not None
    assert find_knock(views([grey] * 10, camera), "3") is None
    # Light that changes is no knock.
    assert find_knock(views([before] * 5 + [np.asarray(0.7 * before, np.uint8)] * 5, camera), "3") is None

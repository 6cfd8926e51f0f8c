"""Cameras that see light otherwise than most are found by colours of common points, and their photographs undone."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from splashbench.scene import Camera
from splashbench.selfcalibration.exposure import Response, responses, standard_of
from splashbench.selfcalibration.features import Tracks

from .conftest import NAMES, light, plate_of

Images = dict[str, NDArray[np.uint8]]


def found(tracks: Tracks, cameras: dict[str, Camera], images: Images) -> dict[str, Response]:
    """Responses of the cameras that differ."""
    every = responses(tracks, {name: plate_of(cameras[name], image) for name, image in images.items()})
    assert tuple(every) == NAMES
    return {name: response for name, response in every.items() if not response.is_standard}


def levels_off(response: Response, taken: NDArray[np.uint8], meant: NDArray[np.uint8]) -> float:
    """Of 20 pixels that are not clipped, 19 are undone to within so many levels."""
    whole = (taken > 3) & (taken < 251)
    return float(np.percentile(np.abs(response.undone(taken).astype(int) - meant)[whole], 95))


@pytest.mark.parametrize("stops", [0.5, -0.5])
def test_an_exposure_is_found_and_undone(
    tracks: Tracks, cameras: dict[str, Camera], images: Images, stops: float
) -> None:
    taken = images | {"2": light(images["2"], stops)}
    (name, response), *others = found(tracks, cameras, taken).items()
    assert (name, others) == ("2", [])
    np.testing.assert_allclose(response.stops, stops, atol=0.02)
    assert response.contrast == 1
    assert levels_off(Response(np.zeros(3)), taken["2"], images["2"]) > 10
    assert levels_off(response, taken["2"], images["2"]) <= 2


def test_cameras_that_all_differ_are_brought_to_their_mean(
    tracks: Tracks, cameras: dict[str, Camera], images: Images
) -> None:
    stops = dict(zip(NAMES, (-0.4, -0.2, 0.05, 0.2, 0.35)))
    taken = {name: light(image, stops[name]) for name, image in images.items()}
    every = found(tracks, cameras, taken)
    assert every.keys() >= {"1", "2", "4", "5"}
    for name, response in every.items():
        np.testing.assert_allclose(response.stops, stops[name], atol=0.03)
        assert levels_off(response, taken[name], images[name]) <= 2


def test_a_white_balance_is_found_by_channel(tracks: Tracks, cameras: dict[str, Camera], images: Images) -> None:
    taken = images | {"3": light(images["3"], (0.2, 0, -0.25))}
    every = found(tracks, cameras, taken)
    assert every.keys() == {"3"}
    np.testing.assert_allclose(every["3"].stops, (0.2, 0, -0.25), atol=0.02)
    assert levels_off(every["3"], taken["3"], images["3"]) <= 2


@pytest.mark.parametrize(("stops", "contrast"), [(0.0, 1.4), (0.3, 1.4), (0.0, 0.7)])
def test_a_contrast_is_found(
    tracks: Tracks, cameras: dict[str, Camera], images: Images, stops: float, contrast: float
) -> None:
    taken = images | {"4": light(images["4"], stops, contrast)}
    every = found(tracks, cameras, taken)
    assert every.keys() == {"4"}
    assert every["4"].contrast == pytest.approx(contrast, rel=0.03)
    np.testing.assert_allclose(every["4"].stops, stops, atol=0.06)
    assert levels_off(every["4"], taken["4"], images["4"]) <= 4


def test_cameras_that_agree_are_standard(tracks: Tracks, cameras: dict[str, Camera], images: Images) -> None:
    assert found(tracks, cameras, images) == {}


def test_few_points_say_nothing(tracks: Tracks, cameras: dict[str, Camera], images: Images) -> None:
    taken = images | {"2": light(images["2"], 0.5)}
    assert found(tracks.kept(np.arange(20)), cameras, taken) == {}
    assert found(tracks.kept(np.arange(0)), cameras, taken) == {}
    assert found(tracks, cameras, taken) != {}


def test_points_that_are_clipped_say_nothing(tracks: Tracks, cameras: dict[str, Camera], images: Images) -> None:
    taken = images | {"2": np.full_like(images["2"], 255)}
    assert found(tracks, cameras, taken) == {}


def test_undoing_keeps_black_and_knows_channels() -> None:
    colors = np.array([[0, 0, 0], [100, 100, 100]], np.uint8)
    brighter = Response(np.array([-1.0, 0, 1.0])).undone(colors)
    assert brighter[0].tolist() == [0, 0, 0]
    assert brighter[1, 0] > 130
    assert brighter[1, 1] == 100
    assert brighter[1, 2] < 75


def test_the_standard_is_what_most_are_near() -> None:
    assert standard_of(np.array([0.0, 0.001, -0.001, 0.002, 5.0])) == pytest.approx(0, abs=0.01)
    assert standard_of(np.array([-0.4, -0.2, 0.05, 0.2, 0.35])) == pytest.approx(0, abs=0.03)

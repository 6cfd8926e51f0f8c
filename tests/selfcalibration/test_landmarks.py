"""Sparse points make planes where they lie on surfaces, and say nothing elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from splashbench.selfcalibration.landmarks import Landmarks


def plane(count: int, seed: int = 0) -> NDArray[np.float64]:
    """Points [count, 7] on y = 2, as files have them: places, colours and a segment."""
    points = np.random.default_rng(seed).uniform(-1, 1, (count, 7))
    points[:, 1] = 2.0
    return points


def test_points_are_off_a_plane_by_their_distance_from_it() -> None:
    landmarks = Landmarks.of(plane(500))
    assert landmarks is not None
    asked = np.array([[0.1, 2.3, -0.2], [0.0, 1.9, 0.5], [np.nan, 0.0, 0.0]])
    planes = landmarks.nearest(asked)
    assert planes[2] == -1
    np.testing.assert_allclose(np.abs(landmarks.off(asked, planes)), [0.3, 0.1, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    "points",
    [
        None,
        plane(50),
        np.repeat(plane(1), 500, axis=0),
        np.full((500, 7), np.nan),
        np.random.default_rng(1).uniform(-1, 1, (500, 7)),
        np.zeros((0, 7)),
    ],
    ids=["none", "few", "one place", "no numbers", "a cloud", "empty"],
)
def test_what_lies_on_no_surface_says_nothing(points: NDArray[np.float64] | None) -> None:
    assert Landmarks.of(points) is None


@pytest.mark.parametrize("value", [np.inf, np.nan, 3e38])
def test_what_is_no_number_is_left_out(value: float) -> None:
    """Or what no file can mean: the largest number of single precision."""
    points = plane(500)
    points[::7, 0] = value
    landmarks = Landmarks.of(points)
    assert landmarks is not None
    assert np.isfinite(landmarks.places).all()
    assert np.isfinite(landmarks.normals).all()


def test_of_very_many_an_even_share_is_kept() -> None:
    landmarks = Landmarks.of(plane(200_000)[:, :3])
    assert landmarks is not None
    assert 40_000 < len(landmarks.places) <= 50_000
    assert abs(landmarks.places[:, 0].mean()) < 0.01

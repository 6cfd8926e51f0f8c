"""A cut shows liquid where there is some, at its place in the scene."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from splashbench.scene import SignedDistance
from splashbench.viewer.cuts import Cut, cut
from splashbench.viewer.units import length_text, measure_text, round_down

CENTER, RADIUS, VOXEL = np.array([0.1, 0.25, -0.05]), 0.12, 0.04


@pytest.fixture
def ball() -> SignedDistance:
    nodes = np.stack(np.meshgrid(np.arange(15), np.arange(20), np.arange(11), indexing="ij"), axis=-1)
    origin = np.array([-0.2, -0.1, -0.25])
    phi = np.linalg.norm(origin + VOXEL * nodes - CENTER, axis=-1) - RADIUS
    return SignedDistance.of(phi[None] / VOXEL, origin, VOXEL)


def places(made: Cut) -> NDArray[np.float64]:
    """Where each pixel lies in the scene [h, w, 3]."""
    height, width = made.image.shape[:2]
    u = (np.arange(width) + 0.5) / width - 0.5
    v = (np.arange(height) + 0.5) / height - 0.5
    across = u[None, :, None] * made.width * made.right
    return np.asarray(made.center + across + v[:, None, None] * made.height * made.down)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("share", [0.0, 0.37, 0.5, 1.0])
def test_pixels_are_blue_exactly_where_the_liquid_is(ball: SignedDistance, axis: int, share: float) -> None:
    made = cut(ball, axis, share)
    here = places(made)
    extent = (np.array(ball.phi.shape[1:]) - 1) * VOXEL
    np.testing.assert_allclose(here[..., axis], ball.origin[axis] + share * extent[axis])
    inside = RADIUS - np.linalg.norm(here - CENTER, axis=-1)
    rgb, alpha = made.image[..., :3].astype(int), made.image[..., 3]
    blue = rgb[..., 2] > rgb[..., 0] + 60
    assert blue[inside > 0.4 * VOXEL].all()
    assert not blue[inside < -0.4 * VOXEL].any()
    assert set(np.unique(alpha)) <= {110, 230}


def test_the_outline_is_dark(ball: SignedDistance) -> None:
    made = cut(ball, 2, 0.5)
    inside = np.abs(RADIUS - np.linalg.norm(places(made) - CENTER, axis=-1))
    assert (made.image[inside < 0.1 * VOXEL][:, :3].max(axis=1) < 80).all()


def test_beyond_the_ends_it_is_at_the_ends(ball: SignedDistance) -> None:
    np.testing.assert_array_equal(cut(ball, 1, 7.0).image, cut(ball, 1, 1.0).image)


def test_lengths_in_words() -> None:
    assert length_text(0.1, None) == "0.1 units"
    assert length_text(1.0, 2.0) == "1 unit = 2 m"
    assert length_text(0.5, 0.1) == "0.5 units = 5 cm"
    assert length_text(0.02, 0.01) == "0.02 units = 0.2 mm"
    assert measure_text("speed", 3.0, None) == "3 units/s"
    assert measure_text("speed", 3.0, 0.5) == "1.5 m/s"
    assert measure_text("height", 3.0, 0.5) == "1.5 m"
    assert measure_text("age", 0.25, 0.5) == "0.25 s"


@pytest.mark.parametrize(("number", "step"), [(0.07, 0.05), (1.0, 1.0), (999, 500), (0.2, 0.2), (3e-7, 2e-7)])
def test_steps_are_1_2_and_5(number: float, step: float) -> None:
    assert round_down(number) == pytest.approx(step)

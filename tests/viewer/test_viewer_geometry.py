"""Views are the cameras' own: what viser is told shows what the camera saw."""

from __future__ import annotations

import math

import numpy as np
import pytest

from splashbench.scene import Camera, look_at
from splashbench.viewer.geometry import (
    View,
    overview,
    quaternion,
    turned_to,
    vertical_fov,
    view_of,
)

UP = np.array([0.0, 1.0, 0.0])
K = np.array([[300.0, 0, 150], [0, 300, 100], [0, 0, 1]])


def camera(eye: tuple[float, float, float] = (1.0, 0.8, 2.0), roll: float = 0.0) -> Camera:
    w2c = look_at(eye)
    turn = np.eye(4)
    turn[:2, :2] = [[math.cos(roll), -math.sin(roll)], [math.sin(roll), math.cos(roll)]]
    return Camera("1", 300, 200, K, turn @ w2c)


@pytest.mark.parametrize("roll", [0.0, 0.3, -2.0])
def test_a_view_through_a_camera_sees_the_same_pixels(roll: float) -> None:
    filmed = camera(roll=roll)
    view = view_of(filmed, np.zeros(3), UP, aspect=1.5)
    again = view.camera("again", 300, 200)
    points = np.random.default_rng(0).normal(0, 0.3, (20, 3))
    np.testing.assert_allclose(again.project(points)[0], filmed.project(points)[0], atol=1e-6)
    assert np.linalg.norm(view.look_at) < 1e-9  # it turns about what it looks at


def test_a_level_camera_has_the_scenes_up() -> None:
    assert (view_of(camera(), np.zeros(3), UP, 1.5).up == UP).all()
    assert not (view_of(camera(roll=0.3), np.zeros(3), UP, 1.5).up == UP).all()


@pytest.mark.parametrize(("aspect", "fits"), [(3.0, "height"), (1.5, "height"), (0.75, "width")])
def test_the_whole_image_fits_into_the_window(aspect: float, fits: str) -> None:
    view = view_of(camera(), np.zeros(3), UP, aspect)
    tall = 2 * math.atan(100 / 300)
    if fits == "height":
        assert view.fov == pytest.approx(tall)
    else:
        assert math.tan(view.fov / 2) * aspect == pytest.approx(150 / 300)
    assert vertical_fov(camera()) == pytest.approx(tall)


def test_what_lies_behind_a_camera_does_not_turn_the_view_round() -> None:
    filmed = camera()
    behind = filmed.center - 3 * filmed.w2c[2, :3]
    view = view_of(filmed, behind, UP, 1.5)
    assert (view.look_at - view.position) @ filmed.w2c[2, :3] > 0


def test_a_quaternion_begins_with_w() -> None:
    assert quaternion(np.eye(3)).tolist() == [1, 0, 0, 0]


@pytest.mark.parametrize("up", [[0, 1, 0], [0, 0, -2], [0.3, 0.4, -0.5]])
def test_the_ground_lies_across_up(up: list[float]) -> None:
    axes = turned_to(up)
    np.testing.assert_allclose(axes[:, 2], np.array(up) / np.linalg.norm(up))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)


def test_an_overview_looks_at_the_liquid_from_the_cameras_side() -> None:
    cameras = [camera((x, 0.5, 2.0)) for x in (-1.0, 0.0, 1.0)]
    middle = np.array([0.0, 0.1, 0.0])
    view = overview(cameras, middle, 0.3, UP)
    assert (view.look_at == middle).all()
    assert view.position[2] > 0
    assert view.position[1] > 0.1
    assert np.linalg.norm(view.position - middle) < min(np.linalg.norm(c.center - middle) for c in cameras)


def test_an_overview_of_cameras_all_around_or_right_above() -> None:
    around = [camera((math.cos(a), 0.5, math.sin(a))) for a in np.linspace(0, 2 * np.pi, 7)[:-1]]
    above = [Camera("1", 300, 200, K, look_at((0, 2, 0), up=(0, 0, 1)))]
    for cameras in (around, above):
        view = overview(cameras, np.zeros(3), 0.3, UP)
        assert np.isfinite(view.position).all()
        assert np.linalg.norm(view.position) > 0.1


def test_views_that_a_screen_cannot_tell_apart_are_one() -> None:
    view = View(np.array([0.0, 0, 2]), np.zeros(3), UP, 0.8)
    assert view.near(View(np.array([0.0, 1e-5, 2]), np.zeros(3), 2 * UP, 0.8))
    assert not view.near(View(np.array([0.0, 0.01, 2]), np.zeros(3), UP, 0.8))
    assert not view.near(View(view.position, view.look_at, UP, 0.81))

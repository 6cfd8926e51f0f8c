"""Cameras: the OpenCV convention with pixel centres at +0.5."""

import numpy as np
import pytest

from splashbench.scene import Camera, look_at

K = np.array([[100.0, 0, 50], [0, 100.0, 40], [0, 0, 1]])


def test_a_point_on_the_axis_falls_on_the_principal_point() -> None:
    uv, depth = Camera("1", 100, 80, K, np.eye(4)).project([[0, 0, 2.0]])
    assert uv.tolist() == [[50.0, 40.0]]
    assert depth.tolist() == [2.0]


def test_x_is_right_and_y_is_down() -> None:
    uv, _ = Camera("1", 100, 80, K, np.eye(4)).project([[1.0, 0.5, 2.0]])
    assert uv.tolist() == [[100.0, 65.0]]


def test_a_crop_moves_only_the_principal_point() -> None:
    camera = Camera("1", 100, 80, K, np.eye(4))
    crop = camera.cropped(10, 20, 30, 40)
    point = [[0.1, 0.2, 1.5]]
    assert (crop.width, crop.height) == (30, 40)
    np.testing.assert_allclose(crop.project(point)[0], camera.project(point)[0] - [10, 20], atol=1e-12)
    assert crop.K[0, 0] == camera.K[0, 0]


def test_scaling_scales_pixels() -> None:
    camera = Camera("1", 100, 80, K, np.eye(4))
    point = [[0.1, 0.2, 1.5]]
    np.testing.assert_allclose(camera.scaled(0.5).project(point)[0], camera.project(point)[0] / 2, atol=1e-12)


def test_the_centre_is_where_the_camera_stands() -> None:
    w2c = np.eye(4)
    w2c[:3, 3] = [0, 0, 5]
    np.testing.assert_allclose(Camera("1", 100, 80, K, w2c).center, [0, 0, -5])


@pytest.mark.parametrize(
    "bad", [np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([2.0, 2.0, 2.0, 1.0]), np.full((4, 4), np.nan)]
)
def test_what_is_no_rigid_pose_is_refused(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="camera 3"):
        Camera("3", 100, 80, K, bad)


def test_a_camera_that_looks_at_a_point_has_it_in_the_middle_and_up_is_up():
    eye, target = np.array([1.0, 2.0, -3.0]), np.array([0.2, 0.5, 0.1])
    camera = Camera("1", 200, 100, np.array([[150.0, 0, 100], [0, 150, 50], [0, 0, 1]]), look_at(eye, target))
    np.testing.assert_allclose(camera.center, eye, atol=1e-12)
    pixels, depth = camera.project([target, target + np.array([0, 0.1, 0])])
    np.testing.assert_allclose(pixels[0], [100, 50], atol=1e-9)
    assert depth[0] == pytest.approx(np.linalg.norm(target - eye))
    assert pixels[1, 1] < 50  # rows count downwards
    assert pixels[1, 0] == pytest.approx(100)
    with pytest.raises(ValueError, match="another up"):
        look_at(eye, eye + np.array([0, 1, 0]))

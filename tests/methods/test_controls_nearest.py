"""The control that copies the nearest training view."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splashbench.harness.contract import MethodConfig, Run
from splashbench.scene import Camera, Scene
from splashbench_methods.controls.nearest_camera import NearestCamera, NearestView, homography


@pytest.fixture
def fitted(balls: Scene) -> NearestView:
    model = NearestCamera().fit(balls.training(), MethodConfig(), Run())
    assert isinstance(model, NearestView)
    return model


def test_the_homography_is_exact_for_points_of_its_plane(balls: Scene):
    target, source = balls.cameras[balls.test[0]], balls.cameras[balls.train[3]]
    point = np.array([0.05, 0.2, -0.1])
    rng = np.random.default_rng(0)
    right, down = target.w2c[0, :3], target.w2c[1, :3]
    on_plane = point + rng.uniform(-0.3, 0.3, (20, 2)) @ np.stack([right, down])
    uv, _ = target.project(on_plane)
    mapped = np.concatenate([uv, np.ones((20, 1))], axis=1) @ homography(target, source, point).T
    np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], source.project(on_plane)[0], atol=1e-6)


def test_a_training_view_is_returned_as_it_is(balls: Scene, fitted: NearestView):
    for t in (0, 5):
        result = fitted.render(balls.cameras["2"], float(balls.camera_times["2"][t]))
        np.testing.assert_allclose(result.rgb, balls.image("2", t) / 255, atol=2e-3)
        np.testing.assert_allclose(result.alpha, balls.mask("2", t), atol=5e-3)


def test_the_source_is_the_neighbour_on_the_arc(balls: Scene, fitted: NearestView):
    for name in balls.test:
        camera = balls.cameras[name]
        distances = {n: np.linalg.norm(balls.cameras[n].center - camera.center) for n in balls.train}
        assert distances[fitted.source(camera).name] == pytest.approx(min(distances.values()), rel=1e-6)


def test_a_test_view_shows_liquid_about_where_it_is(balls: Scene, fitted: NearestView):
    name, t = balls.test[0], balls.n_frames // 2
    result = fitted.render(balls.cameras[name], float(balls.times[t]))
    assert result.rgb.shape == (*balls.mask(name, t).shape, 3)
    assert result.rgb.dtype == result.alpha.dtype == np.float32
    assert (result.rgb >= 0).all()
    assert (result.rgb <= 1).all()
    rows, columns = np.nonzero(balls.mask(name, t))
    weights = result.alpha / result.alpha.sum()
    v, u = np.mgrid[: weights.shape[0], : weights.shape[1]]
    assert abs((weights * u).sum() - columns.mean()) < 0.1 * weights.shape[1]
    assert abs((weights * v).sum() - rows.mean()) < 0.1 * weights.shape[0]


def test_the_time_is_the_source_cameras_own(balls: Scene):
    training = balls.training()
    training.camera_times = {**balls.camera_times, "2": balls.camera_times["2"] + 10.0}
    model = NearestView(training)
    result = model.render(balls.cameras["2"], 10.0 + float(balls.times[3]))
    np.testing.assert_allclose(result.alpha, balls.mask("2", 3), atol=5e-3)


def test_a_camera_that_looks_away_gets_the_plane_at_infinity(balls: Scene, fitted: NearestView):
    camera = balls.cameras["1"]
    turned = camera.w2c.copy()
    turned[:3] = np.diag([-1.0, 1, -1]) @ turned[:3]
    result = fitted.render(Camera("away", 40, 30, camera.K, turned), 0.0)
    assert np.isfinite(result.rgb).all()
    assert result.rgb.shape == (30, 40, 3)


def test_it_survives_saving_and_loading(balls: Scene, fitted: NearestView, tmp_path: Path):
    fitted.save(tmp_path)
    loaded = NearestCamera().load(tmp_path, balls.training())
    camera = balls.cameras[balls.test[1]]
    np.testing.assert_array_equal(loaded.render(camera, 0.1).rgb, fitted.render(camera, 0.1).rgb)
    assert loaded.particles() is None
    assert NearestCamera.control

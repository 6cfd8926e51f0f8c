"""The photographs of a fit, and the points from which it starts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.gaussians.initialization import hull_points, joined, plain_color, static_points
from splashbench.gaussians.photographs import Photographs, unit_time
from splashbench.harness.contract import Run
from splashbench.harness.discovery import load_method
from splashbench.scene import Scene, TrainingScene
from splashbench.synth.balls import ball_centers, write_balls_scene


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A scene two of whose cameras are late and early, by which balls move as far as they are large."""
    return write_balls_scene(tmp_path_factory.mktemp("late") / "balls", n_frames=4, delays={"2": 0.06, "4": -0.06})


class TestPhotographs:
    def test_each_comes_once_before_any_comes_again_and_a_step_has_one_time(self, balls: Scene) -> None:
        scene = balls.training()
        photographs = Photographs(scene, 1000, 2, np.random.default_rng(0))
        seen: list[tuple[str, float]] = []
        while len(seen) < len(photographs):
            step = photographs.next()
            assert len({view.time for view in step}) == 1
            seen += [(view.camera.name, view.time) for view in step]
        assert len(set(seen)) == len(seen) == 5 * scene.n_frames
        assert {time for _, time in seen} >= {0.0, 1.0}

    def test_they_are_shrunk_with_their_cameras(self, balls: Scene) -> None:
        scene = balls.training()
        photograph = Photographs(scene, 48, 1, np.random.default_rng(0)).photograph(scene.train[0], 0)
        assert photograph.image.shape == (32, 48, 3) == (photograph.camera.height, photograph.camera.width, 3)
        assert photograph.camera.K[0, 0] == pytest.approx(scene.cameras[scene.train[0]].K[0, 0] / 2)
        assert photograph.image.mean() == pytest.approx(scene.image(scene.train[0], 0).mean(), abs=1)

    def test_times_are_true_ones(self, balls: Scene) -> None:
        scene = balls.training()
        shares = [unit_time(scene, t) for t in scene.times]
        np.testing.assert_allclose(np.diff(shares) / np.diff(scene.times), 1 / (scene.times[-1] - scene.times[0]))
        assert np.ptp(np.diff(shares)) > 0.01  # the steps of this scene are uneven

    def test_a_photograph_has_its_cameras_own_time(self, late: Scene) -> None:
        photographs = Photographs(late.training(), 1000, 1, np.random.default_rng(0))
        for name, delay in (("1", 0.0), ("2", 0.06), ("4", -0.06)):
            wanted = (late.times[2] + delay - late.times[0]) / (late.times[-1] - late.times[0])
            assert photographs.photograph(name, 2).time == pytest.approx(wanted)


class TestStart:
    def test_hull_points_lie_on_the_balls_of_their_frame(self, balls: Scene) -> None:
        scene = balls.training()
        start = hull_points(scene, 60 * scene.n_frames)
        for t in range(scene.n_frames):
            points = start.positions[start.frame == t]
            assert 0 < len(points) <= 60
            distance = np.linalg.norm(points[:, None] - ball_centers(scene.times[t])[None], axis=2).min(axis=1)
            assert np.median(distance) < 0.12  # radii are .06 to .10 m, and hulls of five views a little larger

    def test_the_fullest_frame_alone_may_give_them(self, balls: Scene) -> None:
        start = hull_points(balls.training(), 100, largest_only=True)
        assert len(start) == 100
        assert len(set(start.frame.tolist())) == 1

    def test_static_points_have_the_colours_and_places_of_the_floor(self, balls: Scene) -> None:
        start = static_points(balls.training(), 300, "pixels", np.random.default_rng(0), Run())
        assert 100 < len(start) <= 300
        assert (start.frame == -1).all()
        both = joined(start, hull_points(balls.training(), 40))
        assert len(both) > len(start)

    def test_who_asks_for_sparse_points_is_told_that_there_are_none(self, balls: Scene) -> None:
        scene, said = balls.training(), list[str]()
        run = Run(_report=lambda fraction, message: said.append(message))
        corners = np.array([[x, y, z] for x in range(4) for y in range(4) for z in range(3)], np.float32)
        sparse = np.hstack([corners, np.full((len(corners), 4), 0.5, np.float32)])
        scene.initial_points = lambda: sparse  # type: ignore[method-assign]
        start = static_points(scene, 300, "points", np.random.default_rng(0), run)
        np.testing.assert_array_equal(start.positions, corners)
        assert said == []
        scene.initial_points = lambda: None  # type: ignore[method-assign]
        lifted = static_points(scene, 300, "points", np.random.default_rng(0), run)
        assert "no sparse points" in said[0]
        same = static_points(scene, 300, "pixels", np.random.default_rng(0), run)
        np.testing.assert_array_equal(lifted.positions, same.positions)
        assert len(said) == 1

    def test_colours_are_those_of_the_photographs(self, balls: Scene) -> None:
        colors = hull_points(balls.training(), 400).colors
        assert np.median(colors[:, 2] - colors[:, 0]) > 0.2  # the balls are blue


FLOOR = (0.1, 0.12, 0.25)


class TestPlainViews:
    """Liquid over one colour, as in synthetic recordings: no point has a depth there, so there are none."""

    @pytest.fixture
    def plain(self, balls: Scene) -> TrainingScene:
        training = balls.training()
        noise = np.random.default_rng(0).integers(-2, 3, (64, 96, 3))
        pictures = {
            (name, t): np.where(balls.mask(name, t)[..., None], balls.image(name, t), 240 + noise).astype(np.uint8)
            for name in balls.train
            for t in range(balls.n_frames)
        }
        training.image = lambda name, t: pictures[name, t]  # type: ignore[method-assign]
        training.initial_points = lambda: None  # type: ignore[method-assign]
        return training

    def test_the_colour_lies_behind_everything(self, plain: TrainingScene) -> None:
        said = list[str]()
        run = Run(_report=lambda fraction, message: said.append(message))
        start = static_points(plain, 300, "points", np.random.default_rng(0), run)
        assert said == []  # nothing is lifted here
        assert len(start) == 0
        assert start.backdrop is not None
        np.testing.assert_allclose(start.backdrop, 240 / 255, atol=1e-6)
        both = joined(start, hull_points(plain, 100))
        assert len(both) >= 100
        assert both.backdrop is start.backdrop

    def test_a_scene_with_something_in_it_has_none(self, balls: Scene) -> None:
        assert static_points(balls.training(), 300, "pixels", np.random.default_rng(0), Run()).backdrop is None
        gray = np.full((100, 3), 200, np.uint8)
        assert plain_color([gray, gray - 3]) is not None
        assert plain_color([gray, gray - 4]) is None
        gray[7, 1] += 4
        assert plain_color([gray]) is None

    @pytest.mark.parametrize(
        "name", ["deformable_3dgs", "spacetime_gaussians", "spacetime_gaussians_lite", "scaffold_4d"]
    )
    def test_it_is_drawn_and_kept(self, name: str, plain: TrainingScene, balls: Scene, tmp_path: Path) -> None:
        method = load_method(name)
        limit = "max_anchors" if name == "scaffold_4d" else "max_gaussians"
        small = {"iterations": 3, "hull_points": 60, limit: 100}
        fitted = method.fit(plain, method.Config.preset("quick", small), Run(directory=tmp_path))
        camera = balls.cameras["6"]
        image = fitted.render(camera, 0.1).rgb
        np.testing.assert_allclose(image[:3, :3], 240 / 255, atol=1 / 255)
        (tmp_path / "model").mkdir()
        fitted.save(tmp_path / "model")
        np.testing.assert_array_equal(method.load(tmp_path / "model", plain).render(camera, 0.1).rgb, image)

    def test_nothing_at_all_is_an_error(self, plain: TrainingScene, tmp_path: Path) -> None:
        plain.image = lambda name, t: np.full((64, 96, 3), 9, np.uint8)  # type: ignore[method-assign]
        plain.mask = lambda name, t: np.zeros((64, 96), bool)  # type: ignore[method-assign]
        method = load_method("scaffold_4d")
        with pytest.raises(SplashbenchError, match=r"there is nothing to start from, .*; correct the masks"):
            method.fit(plain, method.Config.preset("quick", {}), Run(directory=tmp_path))
        with pytest.raises(SplashbenchError, match="raise hull_points"):
            method.fit(plain, method.Config.preset("quick", {"hull_points": 0}), Run(directory=tmp_path))

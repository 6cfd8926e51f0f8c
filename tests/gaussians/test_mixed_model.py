"""The liquid among Gaussians that hold background and liquid: by the silhouettes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from still_gaussians import StillGaussians

from splashbench.gaussians.dynamic_model import Splats
from splashbench.gaussians.fitting import FitHistory
from splashbench.gaussians.mixed_model import MixedFitted
from splashbench.scene import Camera, Scene
from splashbench.synth.balls import ball_centers, write_balls_scene


class Flying(StillGaussians):
    """Gaussians in the middle of the balls, at any time."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(ball_centers(scene.times[0]))
        self.first, self.length = float(scene.times[0]), float(scene.times[-1] - scene.times[0])

    def means(self, time: float) -> torch.Tensor:
        return torch.tensor(ball_centers(self.first + time * self.length), dtype=torch.float32)


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A scene two of whose cameras are late and early, by which balls move as far as they are large."""
    return write_balls_scene(tmp_path_factory.mktemp("late") / "balls", n_frames=4, delays={"2": 0.06, "4": -0.06})


FLOOR = (0.1, 0.12, 0.25)


class TestLiquid:
    @pytest.fixture
    def fitted(self, balls: Scene) -> MixedFitted:
        """Gaussians at the balls of the first frame, and some beside and below them."""
        balls_, floor = ball_centers(balls.times[0]), np.array([FLOOR, [-0.4, -0.3, 0.2]])
        return MixedFitted(StillGaussians(np.concatenate([balls_, floor]), opacity=0.95), balls.training())

    def test_it_is_what_lies_inside_all_silhouettes(self, fitted: MixedFitted) -> None:
        assert fitted.liquid(0).tolist() == [True, True, True, False, False]
        particles = fitted.particles()
        assert particles is not None
        assert particles.active[0].all()
        assert particles.active.shape[1] == 3  # what is never liquid is no particle

    def test_opacity_is_of_the_liquid_alone(self, fitted: MixedFitted, balls: Scene) -> None:
        camera = balls.cameras[balls.test[0]]
        render = fitted.render(camera, float(balls.times[0]))
        (floor,), _ = camera.project(np.array([FLOOR]))
        column, row = floor.astype(int)
        assert 2 <= column < camera.width - 2
        assert 2 <= row < camera.height - 2
        assert render.rgb[row, column].mean() > 0.2  # it is drawn
        assert render.alpha[row, column] < 0.05
        (ball,), _ = camera.project(ball_centers(balls.times[0])[:1])
        assert render.alpha[int(ball[1]), int(ball[0])] > 0.8

    def test_opacity_is_of_the_drawn_liquid_in_whatever_order_it_is_drawn(
        self, fitted: MixedFitted, balls: Scene, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        rows, draw = torch.tensor([4, 2, 1]), fitted.model.splats

        def some(state: object, camera: Camera) -> Splats:
            all_ = draw(state, camera)
            return Splats(all_.means[rows], all_.factors[rows], all_.opacities[rows], all_.colors[rows], rows=rows)

        monkeypatch.setattr(fitted.model, "splats", some)
        camera = balls.cameras[balls.test[0]]
        alpha = fitted.render(camera, float(balls.times[0])).alpha
        pixels, _ = camera.project(ball_centers(balls.times[0]))
        first, second, third = (alpha[int(v), int(u)] for u, v in pixels)
        assert first < 0.05  # left out
        assert min(second, third) > 0.8

    def test_silhouettes_are_of_their_cameras_own_times(self, late: Scene) -> None:
        training = late.training()
        assert MixedFitted(Flying(late), training).liquid(2).all()
        training.camera_times = dict.fromkeys(late.cameras, late.times)  # as if all had exposed together
        assert not MixedFitted(Flying(late), training).liquid(2).all()


def test_the_gain_of_the_last_quarter_is_told() -> None:
    assert FitHistory(np.linspace(10, 18, 801, dtype=np.float32)).gained_in_last_quarter() == pytest.approx(2, abs=0.02)
    assert FitHistory(np.full(3, 20, np.float32)).gained_in_last_quarter() == 0

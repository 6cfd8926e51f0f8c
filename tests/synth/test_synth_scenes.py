"""A made-up scene is a whole scene, and its particles lie in its masks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("embreex")

from splashbench.cli import synth as command
from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.scene import Scene
from splashbench.synth.scenes import RECIPES, make_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    out = tmp_path_factory.mktemp("scenes") / "bowl"
    return make_scene("opaque_bowl", out, size=(128, 72), timesteps=4, particle_radius=0.005)


def test_it_is_a_whole_scene(scene: Scene) -> None:
    assert scene.train == ("1", "2", "3", "4", "5")
    assert scene.test == ("6", "7")
    assert scene.metres_per_unit == 1.0
    assert scene.gravity is not None
    assert np.allclose(scene.gravity, [0, -1, 0])
    points = scene.initial_points()
    assert points is not None
    assert len(points) > 5000
    assert points[:, 1].min() > -0.01  # nothing below the table
    for camera in scene.cameras:
        assert scene.container_mask(camera) is not None


def test_the_particles_lie_in_every_views_masks(scene: Scene) -> None:
    particles = scene.truth_particles()
    assert particles is not None
    for camera, view in scene.cameras.items():
        for t in range(scene.n_frames):
            points = particles.at(t).astype(np.float64)
            uv, _ = view.project(points[points[:, 1] > 0.11])
            pixel = np.floor(uv).astype(int)
            pixel = pixel[((pixel >= 1) & (pixel < [view.width - 1, view.height - 1])).all(axis=1)]
            mask = scene.mask(camera, t)
            near = [mask[v - 1 : v + 2, u - 1 : u + 2].any() for u, v in pixel]
            assert len(near) >= 20
            assert np.mean(near) > 0.95


def test_the_command_knows_every_recipe() -> None:
    assert {*RECIPES, "balls"} == set(command._SCENES)


def test_the_scene_that_needs_no_simulation_is_made_by_the_command(tmp_path: Path) -> None:
    arguments = ["synth", "scene", "balls", str(tmp_path / "balls"), "--timesteps", "3", "--size", "60x40"]
    assert main(arguments) == 0
    scene = Scene.open(tmp_path / "balls")
    assert scene.n_frames == 3
    assert (scene.cameras["1"].width, scene.cameras["1"].height) == (60, 40)


def test_an_unknown_scene_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SplashbenchError, match="opaque_bowl"):
        make_scene("volcano", tmp_path / "out")
    assert not (tmp_path / "out").exists()

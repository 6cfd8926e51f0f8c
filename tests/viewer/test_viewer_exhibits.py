"""Scenes and submissions as the viewer's layers ask for them, and what cannot be looked at."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import splashbench
from splashbench.errors import SplashbenchError
from splashbench.harness.runner import run_method
from splashbench.scene import Camera, Scene, look_at
from splashbench.synth.balls import ball_centers
from splashbench.viewer.exhibit import SceneExhibit, SubmissionExhibit, open_exhibit, require_same_rig

from .conftest import MadeUp


@pytest.fixture(scope="module")
def points(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """hull_points' submission of the balls; not to be changed."""
    out = tmp_path_factory.mktemp("points") / "points"
    run_method("hull_points", balls_directory, out, overrides={"points": 300, "cells": 32}, timing_frames=0)
    return out


def test_a_scene_has_its_truth_and_a_coarse_hull(balls_directory: Path) -> None:
    exhibit = open_exhibit(balls_directory)
    assert isinstance(exhibit, SceneExhibit)
    assert exhibit.has_particles
    assert exhibit.has_points
    assert exhibit.real_times
    assert not exhibit.has_gaussians
    assert exhibit.up.tolist() == [0, 1, 0]
    t = 3
    hull = exhibit.distance(t)
    assert 64 <= max(hull.phi.shape[1:]) <= 66
    centers = ball_centers(float(exhibit.times[t]))
    nodes = np.rint((centers - hull.origin) / hull.voxel).astype(int)
    assert (hull.phi[0][tuple(nodes.T)] < 0).all()
    assert "64 cells" in exhibit.coarse
    extent = exhibit.extent
    assert ((extent.low < centers) & (centers < extent.high)).all()


def test_particles_of_the_scene_are_fast_and_old(balls_directory: Path) -> None:
    tracks = open_exhibit(balls_directory).tracks
    assert tracks is not None
    assert tracks.has("speed")
    speeds = tracks.values("speed", 0, np.array([0.0, 1, 0]))
    assert 0.7 < speeds.min() < speeds.max() < 2.2
    assert tracks.ages[-1].max() > 0.3


@pytest.mark.parametrize("with_scene", [True, False])
def test_a_submission_shows_what_its_method_hands_out(points: Path, balls: Scene, with_scene: bool) -> None:
    exhibit = open_exhibit(points, balls.directory if with_scene else None)
    assert isinstance(exhibit, SubmissionExhibit)
    assert exhibit.name == "hull_points (best)"
    has = (exhibit.has_gaussians, exhibit.has_background, exhibit.has_particles, exhibit.has_picture)
    assert has == (False, False, True, True)
    picture = exhibit.picture(exhibit.cameras["6"], 2)
    assert picture is not None
    np.testing.assert_array_equal(picture, exhibit.reconstruction.submission.rendering("6", 2))
    photograph = exhibit.photograph("1", 2)
    if with_scene:
        np.testing.assert_array_equal(photograph, balls.image("1", 2))
    else:
        assert photograph is None
    tracks = exhibit.tracks
    assert tracks is not None
    assert not tracks.followed


def test_a_method_that_withheld_timesteps_shows_the_photographs_of_its_own(
    balls_directory: Path, tmp_path: Path, balls: Scene
) -> None:
    out = tmp_path / "withheld"
    run_method(
        "hull_points",
        balls_directory,
        out,
        overrides={"points": 50, "cells": 16},
        timing_frames=0,
        withheld="keep_1_of_3",
    )
    exhibit = open_exhibit(out, balls_directory)
    assert exhibit.n_frames < balls.n_frames
    for t, time in enumerate(exhibit.times):
        at = int(np.flatnonzero(balls.times == time)[0])
        np.testing.assert_array_equal(exhibit.photograph("1", t), balls.image("1", at))


@pytest.mark.parametrize("what", ["gaussians", "velocity", "_some_points"])
def test_a_model_that_fails_at_opening_is_one_line(points: Path, monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("one\ntwo")

    monkeypatch.setattr(SubmissionExhibit, what, broken)
    with pytest.raises(
        SplashbenchError, match=r"points: its model fails \(RuntimeError: one two\); run the method again"
    ):
        open_exhibit(points)


def test_particles_of_another_number_of_timesteps_are_refused(points: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exhibit = SubmissionExhibit(splashbench.load(points))
    particles = exhibit.reconstruction.submission.particles()
    assert particles is not None
    particles.positions, particles.active = particles.positions[:-1], particles.active[:-1]
    monkeypatch.setattr(exhibit.reconstruction.submission, "particles", lambda: particles)
    with pytest.raises(SplashbenchError, match=r"particles\.npz has 7 instants, and its scene 8 timesteps"):
        _ = exhibit.tracks


def test_without_gravity_up_is_the_cameras(made_up: MadeUp) -> None:
    made_up.gravity = None
    assert made_up.up @ np.array([0, 1, 0]) > 0.95


def test_without_any_liquid_the_cameras_say_where_it_would_be(made_up: MadeUp, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(made_up, "_some_points", lambda: None)
    assert np.linalg.norm(made_up.extent.middle) < 1e-6  # where both look
    assert 0.3 < made_up.extent.size < 1


def test_a_rig_of_test_cameras_alone_has_a_middle(made_up: MadeUp) -> None:
    made_up.train = ()
    assert np.isfinite(made_up.eye).all()


def test_an_unknown_camera_is_one_line(made_up: MadeUp) -> None:
    with pytest.raises(SplashbenchError, match="made_up has no camera '9'; choose one of 1, 2"):
        made_up.camera("9")


def test_two_of_one_scene_go_together_and_others_do_not(balls_directory: Path, points: Path, made_up: MadeUp) -> None:
    scene = open_exhibit(balls_directory)
    require_same_rig(scene, open_exhibit(points))
    with pytest.raises(SplashbenchError, match="of different cameras, and one view cannot show both"):
        require_same_rig(scene, made_up)
    other = MadeUp()
    other.cameras = {"8": Camera("8", 300, 200, other.cameras["1"].K, look_at((0, 0, 3)))}
    with pytest.raises(SplashbenchError, match="of different cameras"):
        require_same_rig(made_up, other)


def test_what_is_neither_is_told(tmp_path: Path) -> None:
    with pytest.raises(
        SplashbenchError, match="nowhere is not a folder; give the folder of a scene or of a submission"
    ):
        open_exhibit(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(SplashbenchError, match=r"\(as a scene; a submission would have submission.toml\)"):
        open_exhibit(tmp_path / "empty")


def test_a_damaged_scene_is_told(balls_copy: Path) -> None:
    (balls_copy / "scene.json").write_text(json.dumps({"schema_version": 1, "times": [0.0]}))
    with pytest.raises(SplashbenchError, match=r"scene\.json"):
        open_exhibit(balls_copy)

"""Submissions opened again: from the scene or without it, with a model or without, and only where they are sound."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import splashbench
from splashbench.errors import SplashbenchError
from splashbench.harness.oracle import write_oracle
from splashbench.harness.runner import run_method
from splashbench.scene import Particles, Scene, SignedDistance
from splashbench.submission import Record, Status, Submission, seal, to_8bit
from splashbench.submission.cameras import CAMERAS

FEW = {"hull_cells": 48, "transport_cells": 32, "control_cells": 8, "iterations": 30}


@pytest.fixture(scope="module")
def fit(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("fit") / "splashsplat"
    run_method("splashsplat", balls_directory, out, preset="quick", overrides=FEW, timing_frames=0)
    return out


@pytest.fixture(scope="module")
def points(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("points") / "hull_points"
    run_method("hull_points", balls_directory, out, preset="quick", timing_frames=0)
    return out


@pytest.fixture
def copy(fit: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(fit, tmp_path / "copy"))


def resealed(directory: Path, **changes: object) -> Path:
    """`directory` with another identity or record, its digests made anew."""
    submission = Submission.open(directory, verify=False)
    names = set(type(submission.identity).model_fields)
    identity = submission.identity.model_copy(update={k: v for k, v in changes.items() if k in names})
    record = submission.record.model_copy(update={k: v for k, v in changes.items() if k in Record.model_fields})
    seal(directory, identity, record)
    return directory


@pytest.mark.parametrize("whole", [True, False])
def test_a_model_renders_what_the_submission_holds(fit: Path, balls: Scene, whole: bool) -> None:
    opened = splashbench.load(fit, scene=balls.directory if whole else None)
    assert list(opened.cameras) == list(balls.cameras)
    np.testing.assert_array_equal(opened.times, balls.times)
    for name in balls.test:
        np.testing.assert_allclose(opened.cameras[name].K, balls.cameras[name].K)
        render = opened.render(name, float(balls.camera_times[name][3]))
        np.testing.assert_array_equal(to_8bit(render.rgb), opened.submission.rendering(name, 3))
    assert "splashsplat (quick)" in repr(opened)
    assert f"{balls.n_frames} timesteps" in repr(opened)


def test_a_model_gives_gaussians_surface_and_velocity_at_any_time(fit: Path, balls: Scene) -> None:
    from splashbench.render import rasterize_arrays

    opened = splashbench.load(fit)
    time = float(balls.times[3] + balls.times[4]) / 2
    camera = opened.camera(balls.test[0])
    liquid, behind = opened.gaussians(time, camera.center), opened.static_gaussians(camera.center)
    assert liquid is not None
    assert behind is not None
    # No container hides anything here: the Gaussians over the empty view are the view.
    empty = opened.empty_view(camera)
    rgb, _ = rasterize_arrays(liquid.means, liquid.factors, liquid.opacities, liquid.colors, camera, background=empty)
    np.testing.assert_allclose(np.clip(rgb, 0, 1), opened.render(camera, time).rgb, atol=2e-5)
    surface, velocity = opened.surface(time), opened.velocity(time)
    assert surface is not None
    assert velocity is not None
    assert surface.n_frames == 1
    assert velocity.liquid.any()
    # The Gaussians that are drawn most lie within the liquid's surface or a few voxels from it.
    where = np.rint((liquid.means[liquid.opacities > 0.1] - surface.origin) / surface.voxel).astype(int)
    phi = surface.phi[0][tuple(np.clip(where, 0, np.array(surface.phi.shape[1:]) - 1).T)]
    assert (phi < 16 * 3).mean() > 0.9


def test_a_method_without_a_surface_of_its_own_has_the_mean_of_two_timesteps(points: Path, balls: Scene) -> None:
    opened = splashbench.load(points, scene=balls.directory)
    assert opened.surface(0.1) is None  # it hands in no signed distance
    assert opened.gaussians(0.1) is None
    assert opened.velocity(0.1) is None
    assert opened.empty_view("1") is None


def test_the_mean_of_two_timesteps(fit: Path, balls: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = splashbench.load(fit)
    monkeypatch.setattr(opened.fitted, "surface", lambda time: None)
    geometry = opened.submission.geometry()
    assert geometry is not None
    at = opened.surface(float(balls.times[2]))
    between = opened.surface(float(0.25 * balls.times[2] + 0.75 * balls.times[3]))
    beyond = opened.surface(float(balls.times[-1]) + 0.01)
    assert at is not None
    assert between is not None
    assert beyond is not None
    np.testing.assert_array_equal(at.phi[0], geometry.phi[2])
    np.testing.assert_array_equal(beyond.phi[0], geometry.phi[-1])
    expected = 0.25 * geometry.phi[2].astype(float) + 0.75 * geometry.phi[3]
    assert np.abs(between.phi[0] - expected).max() <= 1
    sure = np.abs(expected) > 1e-6
    assert ((between.phi[0] < 0) == (expected < 0))[sure].all()


@pytest.mark.parametrize("time", [-9.0, 99.0, float("nan"), float("inf")])
def test_a_time_that_is_not_of_the_recording_is_told(fit: Path, time: float) -> None:
    opened = splashbench.load(fit)
    asks = (lambda: opened.render("6", time), lambda: opened.gaussians(time), lambda: opened.surface(time))
    for ask in (*asks, lambda: opened.velocity(time)):
        with pytest.raises(SplashbenchError, match="is not of the recording, which lasts from"):
            ask()


def test_without_a_model_there_are_the_stored_views(balls: Scene, tmp_path: Path) -> None:
    opened = splashbench.load(write_oracle(balls, tmp_path / "oracle").directory)
    assert not opened.has_model
    name = balls.test[0]
    render = opened.render(name, float(balls.camera_times[name][5]))
    np.testing.assert_array_equal(to_8bit(render.rgb), balls.image(name, 5))
    for view, time in ((balls.train[0], balls.times[5]), (name, balls.times[5] + 0.013)):
        with pytest.raises(SplashbenchError, match="keeps no model"):
            opened.render(view, float(time))


def test_a_method_that_is_not_installed_shows_its_stored_views(copy: Path, balls: Scene) -> None:
    resealed(copy, method="somebodys")
    opened = splashbench.load(copy)
    assert opened.render(balls.test[0], 0.0).rgb.shape == (64, 96, 3)
    with pytest.raises(SplashbenchError, match="somebodys, which is not installed"):
        opened.render(balls.train[0], 0.0)
    with pytest.raises(SplashbenchError, match="is of method somebodys"):
        splashbench.load(copy, method="splashsplat")


def test_stored_views_of_a_run_that_withheld_timesteps_are_of_the_time_asked_for(
    balls: Scene, balls_directory: Path, tmp_path: Path
) -> None:
    """Renders bear the numbers of all timesteps, and what the method saw are every second one."""
    out = write_oracle(balls, tmp_path / "oracle").directory
    resealed(out, withheld="odd")
    opened = splashbench.load(out, scene=balls_directory)
    name = balls.test[0]
    np.testing.assert_allclose(opened.times, balls.times[::2])
    for t in (0, 2, 4):
        render = opened.render(name, float(balls.camera_times[name][t]))
        np.testing.assert_array_equal(to_8bit(render.rgb), balls.image(name, t))


def test_a_model_that_fails_is_told_in_one_line(fit: Path) -> None:
    opened = splashbench.load(fit)

    def fails(*given: object) -> None:
        raise IndexError("index 9 is out of bounds")

    time = float(opened.times[1])
    asked = {
        "gaussians": lambda: opened.gaussians(time),
        "static_gaussians": opened.static_gaussians,
        "surface": lambda: opened.surface(time),
        "velocity": lambda: opened.velocity(time),
        "render": lambda: opened.render(opened.train[0], time),
        "empty_view": lambda: opened.empty_view(opened.train[0]),
    }
    for name, ask in asked.items():
        setattr(opened.fitted, name, fails)
        with pytest.raises(SplashbenchError, match=r"method splashsplat cannot give .*IndexError: index 9 is out of"):
            ask()


@pytest.mark.slow
def test_a_fit_to_some_timesteps_is_opened_with_those(balls_directory: Path, tmp_path: Path, balls: Scene) -> None:
    out = tmp_path / "withheld"
    run_method("splashsplat", balls_directory, out, preset="quick", overrides=FEW, timing_frames=0, withheld="odd")
    for scene in (None, balls_directory):
        opened = splashbench.load(out, scene=scene)
        np.testing.assert_allclose(opened.times, balls.times[::2])
        render = opened.render(balls.test[0], float(balls.camera_times[balls.test[0]][3]))
        np.testing.assert_array_equal(to_8bit(render.rgb), opened.submission.rendering(balls.test[0], 3))


def test_what_cannot_be_opened_is_told_in_one_line(copy: Path, balls: Scene, tmp_path: Path) -> None:
    with pytest.raises(SplashbenchError, match="is no submission"):
        splashbench.load(tmp_path)
    other = tmp_path / "other"
    shutil.copytree(balls.directory, other)
    meta = json.loads((other / "scene.json").read_text())
    (other / "scene.json").write_text(json.dumps(meta | {"times": [2 * t for t in meta["times"]]}))
    with pytest.raises(SplashbenchError, match="another version of scene"):
        splashbench.load(copy, scene=other)
    with pytest.raises(SplashbenchError, match="there is no camera '42'"):
        splashbench.load(copy).render("42", 0.0)
    (copy / "model" / "liquid.json").write_text("{}")
    with pytest.raises(SplashbenchError, match="does not match its digest"):
        splashbench.load(copy)
    with pytest.raises(SplashbenchError, match=r"liquid\.json"):
        splashbench.load(copy, verify=False)
    with pytest.raises(SplashbenchError, match="status crashed"):
        splashbench.load(resealed(copy, status=Status.CRASHED))


def test_a_submission_of_before_needs_its_scene(copy: Path, balls: Scene) -> None:
    (copy / CAMERAS).unlink()
    resealed(copy)
    with pytest.raises(SplashbenchError, match=r"has no cameras\.json.*give its scene"):
        splashbench.load(copy)
    assert splashbench.load(copy, scene=balls.directory).render(balls.test[0], 0.0).rgb.shape == (64, 96, 3)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("times", [0.0, 0.0]),
        ("times", [1e300]),
        ("times", "soon"),
        ("cameras", []),
        ("metres_per_unit", -1),
        ("gravity", [0, 1]),
        ("schema_version", 9),
        ("more", 1),
    ],
)
def test_hostile_cameras_are_one_line(copy: Path, key: str, value: object) -> None:
    facts = json.loads((copy / CAMERAS).read_text())
    (copy / CAMERAS).write_text(json.dumps(facts | {key: value}))
    with pytest.raises(SplashbenchError, match=r"cameras\.json") as caught:
        splashbench.load(copy, verify=False)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("w2c", [[0, 0, 0, 0]] * 4),
        ("w2c", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]]),
        ("K", [[-5, 0, 0], [0, 5, 0], [0, 0, 1]]),
        ("width", 10**9),
        ("name", "../../etc"),
        ("times", [0.0]),
    ],
)
def test_a_hostile_camera_is_one_line(copy: Path, key: str, value: object) -> None:
    facts = json.loads((copy / CAMERAS).read_text())
    facts["cameras"][0][key] = value
    (copy / CAMERAS).write_text(json.dumps(facts))
    with pytest.raises(SplashbenchError, match=r"cameras\.json") as caught:
        splashbench.load(copy, verify=False)
    assert "\n" not in str(caught.value)


def test_what_a_submission_does_not_hold_is_asked_for(fit: Path) -> None:
    known = splashbench.load(fit)._known
    for ask in (
        lambda: known.image("1", 0),
        lambda: known.mask("1", 0),
        lambda: known.container_mask("1"),
        known.container_mesh,
        known.initial_points,
    ):
        with pytest.raises(SplashbenchError, match="give the scene"):
            ask()


@pytest.mark.parametrize(
    ("method", "few"),
    [
        pytest.param("spacetime_gaussians_lite", {"iterations": 20}, marks=pytest.mark.slow),
        ("spacetime_gaussians", {"iterations": 20}),
        pytest.param("deformable_3dgs", {"iterations": 20}, marks=pytest.mark.slow),
        pytest.param("scaffold_4d", {"iterations": 20}, marks=pytest.mark.slow),
    ],
)
def test_methods_of_one_set_of_gaussians_tell_their_liquid_apart(
    balls_directory: Path, balls: Scene, tmp_path: Path, method: str, few: dict
) -> None:
    from splashbench.render import rasterize_arrays

    run_method(method, balls_directory, tmp_path / method, preset="quick", overrides=few, timing_frames=0)
    opened = splashbench.load(tmp_path / method, scene=balls_directory)
    camera, time = opened.camera(balls.test[0]), float(balls.times[3])
    liquid, rest = opened.gaussians(time, camera.center), opened.static_gaussians(camera.center)
    assert liquid is not None
    assert rest is not None
    assert len(rest) > 0
    _, alpha = rasterize_arrays(liquid.means, liquid.factors, liquid.opacities, None, camera)
    np.testing.assert_allclose(alpha, opened.render(camera, time).alpha, atol=1e-4)
    with pytest.raises(SplashbenchError, match="masks of scene"):
        splashbench.load(tmp_path / method).render(camera, time)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda facts: [view.update(test=True) for view in facts["cameras"]], "no training camera"),
        (lambda facts: [view.update(test=False) for view in facts["cameras"]], "no test camera"),
        (lambda facts: [view.update(name="1") for view in facts["cameras"]], "one name"),
        (lambda facts: facts["cameras"][0]["K"][0].__setitem__(1, 5.0), "without skew"),
        (lambda facts: facts["cameras"][0]["K"].__setitem__(2, [7, 7, 0]), "without skew"),
        (lambda facts: facts["cameras"][0]["w2c"].__setitem__(3, [5, 5, 5, 0]), "0 0 0 1"),
        (lambda facts: facts.update(gravity=[0, 0, 0]), "gravity"),
        (lambda facts: facts["cameras"][0].update(times=facts["times"][::-1]), "do not rise"),
        (lambda facts: facts.update(metres_per_unit=1e-300), "metres_per_unit"),
    ],
)
def test_cameras_that_make_no_sense_together_are_told(copy: Path, change: object, fault: str) -> None:
    facts = json.loads((copy / CAMERAS).read_text())
    change(facts)  # type: ignore[operator]
    (copy / CAMERAS).write_text(json.dumps(facts))
    with pytest.raises(SplashbenchError, match=fault) as caught:
        splashbench.load(copy, verify=False)
    assert "cameras.json" in str(caught.value)


def test_particles_of_other_timesteps_are_told(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = splashbench.load(copy)
    few = Particles(np.zeros((3, 1, 3), np.float32), np.ones((3, 1), bool))
    monkeypatch.setattr(opened.submission, "particles", lambda: few)
    with pytest.raises(SplashbenchError, match=r"particles\.npz has 3 instants, and its scene 8"):
        opened.particles()


def test_geometry_of_other_timesteps_is_told(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = splashbench.load(copy)
    geometry = opened.submission.geometry()
    assert geometry is not None
    short = SignedDistance(geometry.phi[:1], geometry.origin, geometry.voxel)
    monkeypatch.setattr(opened.fitted, "surface", lambda time: None)
    monkeypatch.setattr(opened.submission, "geometry", lambda: short)
    with pytest.raises(SplashbenchError, match=r"geometry\.npz has 1 instants, and its scene 8"):
        opened.surface(0.1)

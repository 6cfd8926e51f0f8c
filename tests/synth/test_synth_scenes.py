"""A synthetic scene is a whole scene, and its particles lie in its masks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("embreex")

from splashbench.cli.main import main
from splashbench.cli.synth import scene as command
from splashbench.errors import SplashbenchError
from splashbench.scene import Scene
from splashbench.synth.recording.plan import RecordingOptions, make_plan
from splashbench.synth.scenes import RECIPES, make_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    out = tmp_path_factory.mktemp("scenes") / "bowl"
    return make_scene("opaque_bowl", out, size=(120, 80), timesteps=4, particle_radius=0.0045, step_ms=200)


@pytest.fixture(scope="module")
def tank(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    out = tmp_path_factory.mktemp("scenes") / "tank"
    return make_scene("glass_tank", out, size=(96, 64), timesteps=4, particle_radius=0.006)


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
    assert scene.container_transparent is False
    assert np.allclose(np.diff(scene.times), 0.2)


def test_told_the_times_alone_it_is_the_same_footage(scene: Scene, tmp_path: Path) -> None:
    options = {"size": (120, 80), "timesteps": 4, "particle_radius": 0.0045, "step_ms": 200}
    bare = make_scene("opaque_bowl", tmp_path / "bare", times_alone=True, **options)
    known = (bare.metres_per_unit, bare.gravity, bare.container_mesh(), bare.container_transparent)
    assert known == (None, None, None, None)
    np.testing.assert_array_equal(bare.times, scene.times)
    for place in ("ims/1/000003.png", "seg/6/000002.png", "train_meta.json"):
        assert (bare.directory / place).read_bytes() == (scene.directory / place).read_bytes()


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


@pytest.mark.parametrize(
    ("name", "milliseconds"),
    [("opaque_bowl", 33), ("thin_stream", 40), ("still_pool", 100), ("glossy_bowl", 33), ("clear_liquid", 40)],
)
def test_steps_are_as_real_scenes_have_them(name: str, milliseconds: float) -> None:
    times = RECIPES[name].times(50)
    assert len(times) == 50
    assert np.allclose(np.diff(times), milliseconds / 1000)


def test_the_tanks_steps_are_uneven_multiples_of_a_source_frame() -> None:
    frames = np.diff(RECIPES["glass_tank"].times(50)) * 60
    assert np.allclose(frames, np.round(frames))
    assert set(np.round(frames)) == {3, 4, 5}  # 50 to 83 ms
    assert frames.mean() == pytest.approx(4, abs=0.1)


def test_a_step_of_ones_own_replaces_uneven_ones() -> None:
    times = RECIPES["glass_tank"].times(9, step_ms=20)
    assert np.allclose(np.diff(times), 0.02)
    assert times[0] == RECIPES["glass_tank"].start


def test_a_tank_is_a_transparent_container(tank: Scene) -> None:
    assert tank.container_transparent is True
    assert tank.training().container_transparent is True
    assert np.allclose(np.diff(tank.times), np.array([4, 3, 5]) / 60)
    mesh = tank.container_mesh()
    assert mesh is not None
    assert np.allclose(np.ptp(mesh.vertices, axis=0), [0.22, 0.14, 0.16])
    for camera, view in tank.cameras.items():
        mask = tank.container_mask(camera)
        assert mask is not None
        rows, columns = np.nonzero(mask)
        uv, _ = view.project(mesh.vertices)
        assert [columns.min(), rows.min()] == pytest.approx(uv.min(axis=0), abs=1)
        assert [columns.max() + 1, rows.max() + 1] == pytest.approx(uv.max(axis=0), abs=1)


def test_liquid_in_the_tank_is_in_the_masks(tank: Scene) -> None:
    particles = tank.truth_particles()
    assert particles is not None
    last = tank.n_frames - 1
    points = particles.at(last).astype(np.float64)
    inside = points[points[:, 1] < 0.13]
    assert len(inside) > 30
    for camera, view in tank.cameras.items():
        column, row = np.floor(view.project(inside)[0]).astype(int).T
        assert tank.mask(camera, last)[row, column].mean() > 0.8


@pytest.mark.parametrize("size", [(480, 320), (1200, 1800), (320, 320)])
@pytest.mark.parametrize("name", RECIPES)
def test_no_camera_sees_where_liquid_comes_from(name: str, size: tuple[int, int]) -> None:
    if RECIPES[name].pour.emit_until < RECIPES[name].start:
        return  # it has all come before the first frame
    plan = make_plan(RecordingOptions(size=size))
    pour = replace(RECIPES[name].pour, azimuth_degrees=plan.pour.azimuth_degrees)
    nozzle, _ = pour.placed()
    for recorder in plan.recorders.values():
        uv, depth = recorder.camera.project(nozzle[None].astype(np.float64))
        radius = pour.stream_diameter / 2 * recorder.camera.K[0, 0] / depth[0]
        # The opening is seen from the side, foreshortened.
        assert uv[0, 1] + 0.6 * radius < 0


def test_the_command_knows_every_recipe() -> None:
    assert {*RECIPES, "balls"} == set(command._SCENES)


def test_the_scene_that_needs_no_simulation_is_made_by_the_command(tmp_path: Path) -> None:
    arguments = ["synth", "scene", "balls", str(tmp_path / "balls"), "--timesteps", "3", "--size", "60x40"]
    assert main(arguments) == 0
    scene = Scene.open(tmp_path / "balls")
    assert scene.n_frames == 3
    assert (scene.cameras["1"].width, scene.cameras["1"].height) == (60, 40)


@pytest.mark.parametrize("step", ["0", "-5", "nan", "inf", "soon"])
def test_an_impossible_step_is_wrong_usage(step: str, tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["synth", "scene", "glass_tank", str(tmp_path / "out"), f"--step={step}"])
    assert stop.value.code == 2


def test_options_of_the_simulation_are_refused_where_nothing_is_simulated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["synth", "scene", "balls", str(tmp_path / "out"), "--step", "20"]) == 1
    assert "--step is for simulated scenes" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("step", "message"), [(300.0, "14.7 s.*--step"), (0.0, "--step 0")])
def test_a_step_that_will_not_do_is_refused(step: float, message: str, tmp_path: Path) -> None:
    with pytest.raises(SplashbenchError, match=message):
        make_scene("still_pool", tmp_path / "out", step_ms=step)


def test_an_unknown_scene_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SplashbenchError, match="opaque_bowl"):
        make_scene("volcano", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_dye_changes_the_liquids_color_and_nothing_else(tank: Scene, tmp_path: Path) -> None:
    green = make_scene("glass_tank", tmp_path / "g", size=(96, 64), timesteps=4, particle_radius=0.006, dye="green")
    assert green.name == "synthetic_glass_tank_green"
    assert green.meta is not None
    assert green.meta.provenance["dye"] == "green"
    np.testing.assert_array_equal(green.truth_particles().positions, tank.truth_particles().positions)
    mask = tank.mask("1", 3)
    np.testing.assert_array_equal(green.mask("1", 3), mask)
    assert green.image("1", 3)[mask].mean(axis=0).argmax() == 1
    assert tank.image("1", 3)[mask].mean(axis=0).argmax() == 2
    # Far from the liquid and its shadow not a bit differs.
    np.testing.assert_array_equal(green.image("1", 3)[:8, :20], tank.image("1", 3)[:8, :20])


def test_a_dye_that_is_none_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["synth", "scene", "glass_tank", str(tmp_path / "x"), "--dye", "purple"]) == 1
    assert "there is no dye 'purple'" in capsys.readouterr().err
    assert main(["synth", "scene", "balls", str(tmp_path / "x"), "--dye", "green"]) == 1
    assert "--dye is for simulated scenes" in capsys.readouterr().err

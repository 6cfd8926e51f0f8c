"""Particles, velocities and captures for nerfstudio; when, where and of what an export is."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from splashbench.errors import SplashbenchError
from splashbench.export import (
    MANIFEST,
    Manifest,
    Placement,
    export_meshes,
    export_nerfstudio,
    export_particles,
    export_times,
    export_velocity,
    place,
)
from splashbench.export.placement import UPS
from splashbench.harness.contract import Fitted
from splashbench.harness.runner import run_method
from splashbench.replay import Reconstruction, load
from splashbench.scene import Particles, Scene, VelocityField

from .conftest import METHOD, columns, read_points, showing
from .exact_balls import ORIGIN, PER_BALL, SHAPE, VOXEL, ExactBalls, exact_velocity, nodes

#: Known points about the liquid, on no axis of anything.
POINTS = np.random.default_rng(5).uniform((-0.4, 0.0, -0.3), (0.5, 0.6, 0.3), (50, 3))


class TestParticles:
    def test_files_have_every_particle_where_it_is(self, known: Reconstruction, tmp_path: Path) -> None:
        placement = Placement(place(known, up="z").rotation, 2.0, "metres", "z")
        export_particles(known, tmp_path / "out", known.times[::3], placement)
        truth = known.particles()
        assert truth is not None
        assert truth.velocities is not None
        with np.load(tmp_path / "out" / "particles.npz", allow_pickle=False) as stored:
            together = {name: stored[name] for name in stored.files}
        np.testing.assert_array_equal(together["times"], known.times[::3])
        for frame, t in enumerate(range(0, len(known.times), 3)):
            points = read_points(tmp_path / "out" / "frames" / f"frame{frame + 1:04d}.ply")
            np.testing.assert_array_equal(points["id"], np.arange(3 * PER_BALL))
            rows = slice(together["start"][frame], together["start"][frame + 1])
            for names, key, array in (
                ("xyz", "positions", truth.positions),
                (("vx", "vy", "vz"), "velocities", truth.velocities),
            ):
                x, y, z = array[t].T
                np.testing.assert_allclose(columns(points, *names), 2 * np.stack([x, -z, y], axis=1), atol=1e-5)
                np.testing.assert_array_equal(together[key][rows], columns(points, *names).astype(np.float32))
            np.testing.assert_array_equal(together["ids"][rows], points["id"])

    def test_a_particle_is_followed_by_its_id(self, known: Reconstruction, tmp_path: Path) -> None:
        class Some(ExactBalls):
            pass

        opened = showing(known, Some(known.times))
        positions = np.arange(8 * 5 * 3, dtype=np.float32).reshape(8, 5, 3)
        active = np.random.default_rng(0).random((8, 5)) < 0.6
        active[3] = False
        opened.__dict__["_particles"] = Particles(positions, active)
        manifest = export_particles(opened, tmp_path / "out")
        assert manifest.counts["particles"] == active.sum(axis=1).tolist()
        assert any("no velocities" in note for note in manifest.notes)
        with np.load(tmp_path / "out" / "particles.npz") as stored:
            assert sorted(stored.files) == ["ids", "positions", "start", "times"]
            frames = np.repeat(np.arange(8), np.diff(stored["start"]))
            rows = stored["ids"] == 2
            np.testing.assert_array_equal(frames[rows], np.flatnonzero(active[:, 2]))
            np.testing.assert_array_equal(stored["positions"][rows], positions[active[:, 2], 2])
        assert b"element vertex 0\n" in (tmp_path / "out" / "frames" / "frame0004.ply").read_bytes()

    def test_the_truths_particles_come_out_without_a_model(self, oracle: Path, balls: Scene, tmp_path: Path) -> None:
        export_particles(load(oracle), tmp_path / "out")
        truth = balls.truth_particles()
        assert truth is not None
        points = read_points(tmp_path / "out" / "frames" / "frame0008.ply")
        np.testing.assert_array_equal(columns(points, "x", "y", "z"), truth.at(7))

    def test_there_are_none_between_timesteps_and_none_of_some_methods(
        self, known: Reconstruction, tmp_path: Path
    ) -> None:
        with pytest.raises(SplashbenchError, match="particles are known at the timesteps alone"):
            export_particles(known, tmp_path / "out", export_times(known.times, fps=100))
        opened = showing(known, known.fitted)
        opened.__dict__["_particles"] = None
        with pytest.raises(SplashbenchError, match="has no particles: method exact hands out none; export its mesh"):
            export_particles(opened, tmp_path / "out")
        opened.__dict__["_particles"] = Particles(np.zeros((3, 1, 3)), np.ones((3, 1), bool))
        with pytest.raises(SplashbenchError, match=r"particles.npz has 3 instants, and its scene 8"):
            export_particles(opened, tmp_path / "out")
        assert not (tmp_path / "out").exists()


class TestVelocity:
    def test_nodes_have_the_liquids_velocity(self, known: Reconstruction, tmp_path: Path) -> None:
        manifest = export_velocity(known, tmp_path / "out", known.times[2:4])
        with np.load(tmp_path / "out" / "velocity.npz", allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        assert sorted(arrays) == ["axes", "liquid", "origin", "spacing", "times", "values"]
        np.testing.assert_allclose(arrays["origin"], ORIGIN)
        np.testing.assert_allclose(arrays["spacing"], VOXEL)
        assert arrays["values"].shape == (2, *SHAPE, 3)
        np.testing.assert_allclose(
            arrays["values"][1].reshape(-1, 3), exact_velocity(nodes().reshape(-1, 3), known.times[3]), atol=1e-6
        )
        assert manifest.counts["liquid_nodes"] == arrays["liquid"].sum(axis=(1, 2, 3)).tolist()

    def test_a_turned_grid_says_where_its_nodes_are(self, known: Reconstruction, tmp_path: Path) -> None:
        placement = Placement(place(known, up="z", gravity=(0.2, -1, 0.1)).rotation, 3.0, "metres", "z")
        export_velocity(known, tmp_path / "out", known.times[2:3], placement)
        with np.load(tmp_path / "out" / "velocity.npz") as stored:
            index = (5, 17, 8)
            where = stored["origin"] + index @ stored["axes"]
            np.testing.assert_allclose(where, placement.points(nodes()[index]), atol=1e-12)
            expected = placement.points(exact_velocity(nodes()[index][None], known.times[2])[0])
            np.testing.assert_allclose(stored["values"][0][index], expected, atol=1e-5)
            np.testing.assert_allclose(np.linalg.norm(stored["axes"], axis=1), stored["spacing"])

    def test_a_field_that_is_none_or_wild_or_changes(self, known: Reconstruction, tmp_path: Path) -> None:
        class Field(ExactBalls):
            what = "none"

            def velocity(self, time: float) -> VelocityField | None:  # type: ignore[override]
                field = super().velocity(time)
                if self.what == "wild":
                    field.values[0, 0, 0, 0] = np.nan
                if self.what == "changes":
                    field.origin = field.origin + time
                return None if self.what == "none" else field

        for what, message in (
            ("none", "no velocity field"),
            ("wild", "are not finite"),
            ("changes", "changes over time"),
        ):
            fitted = Field(known.times)
            fitted.what = what
            with pytest.raises(SplashbenchError, match=message):
                export_velocity(showing(known, fitted), tmp_path / "out")
        assert list(tmp_path.iterdir()) == []


class TestNerfstudio:
    def test_known_points_fall_on_the_same_pixels(self, known: Reconstruction, tmp_path: Path) -> None:
        placement = Placement(place(known, up="z").rotation, 2.0, "metres", "z")
        manifest = export_nerfstudio(known, tmp_path / "out", known.times[2:5], placement)
        assert any("no photographs" in note for note in manifest.notes)
        assert not (tmp_path / "out" / "images").exists()
        content = json.loads((tmp_path / "out" / "transforms.json").read_text())
        assert len(content["frames"]) == 3 * len(known.train)
        poses = json.loads((tmp_path / "out" / "transforms_test.json").read_text())["frames"]
        assert {frame["camera"] for frame in poses} == set(known.test)
        moved = placement.points(POINTS)
        for frame in content["frames"] + poses:
            matrix = np.linalg.inv(np.array(frame["transform_matrix"]))
            x, y, z = matrix[:3, :3] @ moved.T + matrix[:3, 3:]
            assert (z < 0).all()  # OpenGL looks along -z
            found = np.stack([frame["cx"] - frame["fl_x"] * x / z, frame["cy"] + frame["fl_y"] * y / z], axis=1)
            np.testing.assert_allclose(found, known.cameras[frame["camera"]].project(POINTS)[0], atol=1e-6)
            assert frame["time_seconds"] == pytest.approx(known.times[2 + frame["frame"]])

    def test_points_are_those_of_liquid_and_background_at_the_first_instant(
        self, known: Reconstruction, tmp_path: Path
    ) -> None:
        manifest = export_nerfstudio(known, tmp_path / "out", known.times[4:], points=100)
        assert manifest.counts == {"liquid_points": [100], "background_points": [100]}
        cloud = trimesh.load(
            tmp_path / "out" / json.loads((tmp_path / "out/transforms.json").read_text())["ply_file_path"]
        )
        liquid = known.gaussians(known.times[4])
        assert liquid is not None
        nearest = np.linalg.norm(cloud.vertices[100:, None] - liquid.means, axis=-1)
        assert nearest.min(axis=1).max() < 1e-5
        np.testing.assert_allclose(cloud.colors[100:, :3] / 255, liquid.colors[nearest.argmin(axis=1)], atol=0.003)
        assert (np.abs(cloud.vertices[:100, 1]) < 1e-6).all()  # the floor

    def test_photographs_come_from_the_scene(self, exact: Path, balls: Scene, tmp_path: Path) -> None:
        opened = load(exact, scene=balls.directory, method=METHOD)
        manifest = export_nerfstudio(opened, tmp_path / "out", opened.times[3:7:3])
        assert manifest.notes == []
        content = json.loads((tmp_path / "out" / "transforms.json").read_text())
        assert len(content["frames"]) == 2 * len(balls.train) == len(list((tmp_path / "out" / "images").iterdir()))
        for frame in content["frames"]:
            image = np.asarray(Image.open(tmp_path / "out" / frame["file_path"]))
            np.testing.assert_array_equal(image, balls.image(frame["camera"], 3 + 3 * frame["frame"]))
        assert set(content["train_filenames"]) == {frame["file_path"] for frame in content["frames"]}

    def test_withheld_timesteps_are_left_out(self, balls: Scene, tmp_path: Path) -> None:
        run_method(METHOD, balls.directory, tmp_path / "odd", timing_frames=0, withheld="odd")
        opened = load(tmp_path / "odd", scene=balls.directory, method=METHOD)
        export_nerfstudio(opened, tmp_path / "out", opened.times[1:3])
        frame = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"][1]
        image = np.asarray(Image.open(tmp_path / "out" / frame["file_path"]))
        np.testing.assert_array_equal(image, balls.image(frame["camera"], 4))
        assert frame["time_seconds"] == pytest.approx(balls.times[4])

    def test_points_of_methods_without_gaussians(self, oracle: Path, balls: Scene, tmp_path: Path) -> None:
        manifest = export_nerfstudio(load(oracle, scene=balls.directory), tmp_path / "out", points=50)
        assert manifest.counts == {"liquid_points": [50], "background_points": [50]}  # particles, the scene's points

        class Dry(Fitted):
            render = particles = save = None  # type: ignore[assignment]

        Dry.__abstractmethods__ = frozenset()
        opened = showing(load(oracle), Dry())  # type: ignore[abstract]
        opened.__dict__["_particles"] = None
        with pytest.raises(SplashbenchError, match="no points to start from"):
            export_nerfstudio(opened, tmp_path / "dry")


class TestTimes:
    RECORDED = np.array([0.0, 0.1, 0.2, 0.35, 0.4])

    @pytest.mark.parametrize(
        ("options", "expected"),
        [
            ({}, [0.0, 0.1, 0.2, 0.35, 0.4]),
            ({"every": 2}, [0.0, 0.2, 0.4]),
            ({"between": (0.1, 0.35)}, [0.1, 0.2, 0.35]),
            ({"between": (0.1000001, None), "every": 3}, [0.1, 0.4]),
            ({"between": (None, 0.15)}, [0.0, 0.1]),
            ({"between": (0.2, 0.2)}, [0.2]),
            ({"fps": 10.0}, [0.0, 0.1, 0.2, 0.3, 0.4]),
            ({"fps": 20.0, "between": (0.05, 0.2)}, [0.05, 0.1, 0.15, 0.2]),
            ({"fps": 4.0, "between": (-1.0, 9.0)}, [0.0, 0.25]),
        ],
    )
    def test_instants(self, options: dict, expected: list[float]) -> None:
        np.testing.assert_allclose(export_times(self.RECORDED, **options), expected)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"between": (0.3, 0.2)}, "give the earlier one first"),
            ({"between": (float("nan"), 0.2)}, "is no time"),
            ({"between": (0.5, 0.6)}, "the recording has no instant from 0.5 to 0.6 s; it has 5 from 0 to 0.4 s"),
            ({"between": (0.5, 0.6), "fps": 10}, "no instant"),
            ({"between": (0.22, 0.3)}, "no instant"),
            ({"fps": 1e9}, "more than 100000"),
            ({"fps": float("nan")}, "above 0"),
            ({"fps": 10, "every": 2}, "give one of them"),
            ({"every": 0}, "above 0"),
        ],
    )
    def test_times_that_are_none(self, options: dict, message: str) -> None:
        with pytest.raises(SplashbenchError, match=message):
            export_times(self.RECORDED, **options)

    def test_a_recording_of_one_instant(self) -> None:
        for options in ({}, {"fps": 30.0}, {"every": 5}):
            np.testing.assert_array_equal(export_times(np.array([2.0]), **options), [2.0])

    @pytest.mark.parametrize("times", [[], [[0.1]], [0.2, 0.1], [0.1, 0.1], [np.nan]])
    def test_arrays_that_are_no_times(self, known: Reconstruction, tmp_path: Path, times: list) -> None:
        with pytest.raises(SplashbenchError, match="must be seconds that rise"):
            export_meshes(known, tmp_path / "out", np.array(times))


class TestPlacement:
    @pytest.mark.parametrize("up", UPS)
    @pytest.mark.parametrize("gravity", [(0, -1, 0), (0, 1, 0), (0, 0, -3), (0, 0, 1), (1, -2, 0.5), (-1, 0, 0)])
    def test_gravity_points_against_up(self, known: Reconstruction, up: str, gravity: tuple) -> None:
        placement = place(known, up=up, gravity=gravity)  # type: ignore[arg-type]
        down = placement.directions(np.array(gravity) / np.linalg.norm(gravity))
        np.testing.assert_allclose(down, -np.array(UPS[up]), atol=1e-12)  # type: ignore[index]
        np.testing.assert_allclose(placement.rotation @ placement.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(placement.rotation) == pytest.approx(1)

    def test_y_up_to_z_up_is_the_usual_turn(self, known: Reconstruction) -> None:
        np.testing.assert_allclose(place(known, up="z").points([1.0, 2.0, 3.0]), [1, -3, 2], atol=1e-12)
        np.testing.assert_allclose(place(known, up="y").rotation, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(place(known).matrix, np.eye(4))

    def test_cameras_see_the_same(self, known: Reconstruction) -> None:
        placement = Placement(place(known, up="z", gravity=(1, -1, 0.4)).rotation, 0.01, "metres", "z")
        camera = known.cameras["2"]
        pixels, depths = placement.camera(camera).project(placement.points(POINTS))
        np.testing.assert_allclose(pixels, camera.project(POINTS)[0], atol=1e-9)
        np.testing.assert_allclose(depths, 0.01 * camera.project(POINTS)[1], atol=1e-12)

    def test_what_a_scene_does_not_say(self, known: Reconstruction) -> None:
        opened = showing(known, known.fitted)
        opened.gravity, opened.metres_per_unit = None, None
        with pytest.raises(SplashbenchError, match="scene balls states no metres_per_unit"):
            place(opened, metres=True)
        with pytest.raises(SplashbenchError, match="does not say where gravity points; leave out --up, or give"):
            place(opened, up="z")
        assert place(opened, up="z", gravity=(0, -1, 0)).up == "z"
        opened.metres_per_unit = 0.5
        assert place(opened, metres=True).scale == 0.5

    @pytest.mark.parametrize("gravity", [(0, 0, 0), (np.nan, 0, 1), (1, 2), (np.inf, 0, 0)])
    def test_a_gravity_that_is_no_direction(self, known: Reconstruction, gravity: tuple) -> None:
        with pytest.raises(SplashbenchError, match="three numbers that give a direction"):
            place(known, up="y", gravity=gravity)


class TestManifest:
    def test_it_says_what_when_and_in_which_units(self, known: Reconstruction, tmp_path: Path) -> None:
        written = export_particles(known, tmp_path / "out", known.times[1:3], place(known, metres=True, up="y-down"))
        stored = Manifest.model_validate_json((tmp_path / "out" / MANIFEST).read_text())
        assert stored == written
        assert stored.submission.digest == known.submission.digest
        assert (stored.submission.method, stored.submission.scene) == ("exact", "balls")
        assert stored.times == known.times[1:3].tolist()
        assert (stored.units, stored.up, stored.metres_per_unit) == ("metres", "y-down", 1.0)
        assert stored.files == ["frames/frame0001.ply", "frames/frame0002.ply", "particles.npz"]
        assert all((tmp_path / "out" / name).is_file() for name in stored.files)
        # Viewers take a folder for a sequence only where it holds nothing else.
        assert len(list((tmp_path / "out" / "frames").iterdir())) == 2

    def test_an_order_that_is_no_time_is_told(self, known: Reconstruction, tmp_path: Path) -> None:
        opened = showing(known, known.fitted)
        opened.times_source = "nominal"
        assert "order, not seconds" in export_particles(opened, tmp_path / "out").notes[-1]

    def test_an_earlier_export_is_replaced_and_nothing_else(self, known: Reconstruction, tmp_path: Path) -> None:
        out = tmp_path / "out"
        export_particles(known, out, known.times[:1])
        with pytest.raises(SplashbenchError, match="exists already"):
            export_meshes(known, out)
        export_meshes(known, out, known.times[:2], replace=True)
        assert not (out / "particles.npz").exists()
        (tmp_path / "app").mkdir()
        (tmp_path / "app" / MANIFEST).write_text('{"manifest_version": 3}')
        with pytest.raises(SplashbenchError, match=r"its manifest.json is of something else"):
            export_meshes(known, tmp_path / "app", replace=True)
        assert (tmp_path / "app" / MANIFEST).read_text() == '{"manifest_version": 3}'
        submission = known.submission.directory
        for place_, message in (
            (submission, "sealed"),
            (submission / "exports", "sealed"),
            (submission.parent, "holds the input"),
        ):
            with pytest.raises(SplashbenchError, match=message):
                export_meshes(known, place_, replace=True)

    def test_a_long_export_is_numbered_with_more_digits(self) -> None:
        from splashbench.export.manifest import frame_files

        names = frame_files(12_000, "ply")
        assert (names[0], names[-1]) == ("frames/frame00001.ply", "frames/frame12000.ply")
        assert names == sorted(names)


@pytest.mark.parametrize(
    ("units", "remedy"), [("metres", "leave --metres out, or fit again"), ("scene units", "fit again")]
)
def test_places_beyond_all_bounds_are_one_line(units: str, remedy: str) -> None:
    placement = Placement(scale=1e9, units=units)  # type: ignore[arg-type]
    assert placement.points(np.full((2, 3), 1e20)).max() == pytest.approx(1e29)
    assert placement.points(np.zeros((0, 3))).shape == (0, 3)
    for value in (1e22, 1e305, np.inf, np.nan):
        with pytest.raises(SplashbenchError, match=f"beyond 1e\\+30 {units}, or NaN; {remedy}$"):
            placement.points(np.array([[0.0, value, 0.0]]))

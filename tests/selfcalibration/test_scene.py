"""A scene that is not as it says: what is found, what a method sees of it then, and the corrected copy on disk."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splashbench.cli.main import main
from splashbench.files import read_json, write_json
from splashbench.harness.contract import Run
from splashbench.scene import Camera, Scene, TrainingScene
from splashbench.scene.inspection import check_scene
from splashbench.selfcalibration import CalibratedScene, SelfCalibration, self_calibration
from splashbench.selfcalibration.cameras import FittedCameras
from splashbench.selfcalibration.clocks import Offset
from splashbench.selfcalibration.exposure import Response
from splashbench.selfcalibration.outlines import Outlines, PackedMasks
from splashbench.selfcalibration.stance import Knock

from .conftest import KNOCKED_AT, KNOCKED_BY, LATE, STOPS, photograph, turned

BRIGHTER = Response(np.array([0.5, 0.5, 0.5]))
LATER = Offset(0.25, 99.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def found(wrong: Scene) -> SelfCalibration:
    return self_calibration(wrong.training())


@pytest.fixture(scope="module")
def copied(found: SelfCalibration, wrong_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The corrected copy, as the command writes it."""
    out = tmp_path_factory.mktemp("copies") / "copy"
    with pytest.MonkeyPatch.context() as patch:  # it need not be found twice
        patch.setattr("splashbench.selfcalibration.self_calibration", lambda scene, told: found)
        assert main(["scene", "self-calibrate", str(wrong_directory), "--out", str(out)]) == 0
    return out


def fitted(cameras: dict[str, Camera], k1: float = 0.0) -> FittedCameras:
    return FittedCameras(cameras, k1, ("turned",), 1.0, 0.1, 200)


def error(words: list[object], capsys: pytest.CaptureFixture[str]) -> str:
    """The one error line of `splashbench scene self-calibrate`, which has to fail."""
    assert main(["scene", "self-calibrate", *map(str, words)]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if line.startswith("error: ")] == lines[-1:]
    return lines[-1]


def test_what_is_wrong_is_found_and_nothing_else(found: SelfCalibration, wrong: Scene) -> None:
    assert found.offsets.keys() == {"5"}
    assert found.seconds_per_step * found.offsets["5"].timesteps == pytest.approx(LATE, abs=0.001)
    assert found.knocks.keys() == {"4"}
    assert found.knocks["4"].frame == KNOCKED_AT
    assert found.cameras is None
    assert found.responses.keys() == {"2"}
    np.testing.assert_allclose(found.responses["2"].stops, STOPS, atol=0.02)
    clock, knock, light = found.lines(wrong.training().cameras)
    assert clock.startswith("camera 5 takes its photographs ")
    assert clock.endswith(" ms later than told")
    assert knock == f"camera 4 was knocked before timestep {KNOCKED_AT}, and turned by {KNOCKED_BY:.2f} deg"
    assert light == "camera 2 sees light otherwise than most: +0.50 EV"


def test_a_method_sees_it_as_it_was_recorded(found: SelfCalibration, wrong: Scene) -> None:
    told = wrong.training()
    right = found.scene(told)
    t = KNOCKED_AT + 3
    dry = {name: ~right.mask(name, t) for name in told.train}
    for name in told.train:
        # Interpolation blurs, and a knock hides a strip at the edge; a photograph that is as it was, is untouched.
        off = np.abs(right.image(name, t).astype(float) - photograph(told.cameras[name]))[dry[name]]
        assert np.median(off) <= {"2": 1, "4": 3}.get(name, 0)
    before, after = (
        np.abs(scene.image("4", t) - photograph(told.cameras["4"]).astype(float)) for scene in (told, right)
    )
    assert np.median(after) < 0.3 * np.median(before)
    np.testing.assert_array_equal(right.image("4", KNOCKED_AT - 1), told.image("4", KNOCKED_AT - 1))
    # Masks move with the photographs, before the knock and of other cameras not at all.
    assert (right.mask("4", t) != told.mask("4", t)).any()
    np.testing.assert_array_equal(right.mask("4", KNOCKED_AT - 1), told.mask("4", KNOCKED_AT - 1))
    np.testing.assert_array_equal(right.mask("2", t), told.mask("2", t))
    np.testing.assert_allclose(right.camera_times["5"] - told.times, LATE, atol=0.001)
    np.testing.assert_array_equal(right.camera_times["1"], told.times)
    assert right.test_cameras == told.test_cameras
    assert right.cameras == told.cameras


def test_masks_go_back_to_where_the_camera_would_have_seen_them(wrong: Scene) -> None:
    class Block(TrainingScene):
        def mask(self, camera: str, t: int) -> Any:
            mask = np.zeros((160, 240), bool)
            mask[70:90, 111:131] = True  # about the principal point
            return mask

        def container_mask(self, camera: str) -> Any:
            return np.ones((160, 240), bool)

    told = Block(wrong)
    turn = Rotation.from_rotvec([0, np.radians(5), 0]).as_matrix()
    away = np.tan(np.radians(5)) * told.cameras["3"].K[0, 0]  # to the right, 20 pixels
    right = SelfCalibration(knocks={"3": Knock(2, turn)}).scene(told)
    np.testing.assert_array_equal(right.mask("3", 1), told.mask("3", 1))
    back = right.mask("3", 2)
    assert back.dtype == bool
    assert back.sum() == pytest.approx(400, abs=40)
    assert np.argwhere(back).mean(axis=0) == pytest.approx([79.5, 120.5 - away], abs=0.6)
    # The container was seen before the knock.
    container = right.container_mask("3")
    assert container is not None
    assert container.all()


def test_masks_that_were_found_stand_for_those_told(balls: Scene) -> None:
    told = balls.training()
    shape = told.mask("1", 0).shape
    mended = np.zeros(shape, bool)
    mended[3:9, 5:7] = True
    found = SelfCalibration(outlines={"1": Outlines(PackedMasks.of(shape, [(2, mended)]), told.n_frames, -1.5)})
    right = found.scene(told)
    np.testing.assert_array_equal(right.mask("1", 2), mended)
    np.testing.assert_array_equal(right.mask("1", 1), told.mask("1", 1))
    np.testing.assert_array_equal(right.mask("2", 2), told.mask("2", 2))
    np.testing.assert_array_equal(right.image("1", 2), told.image("1", 2))
    (line,) = found.lines(told.cameras)
    assert line.startswith(f"camera 1: 1 of {told.n_frames} masks are not what its photographs show (timesteps 2)")


def test_where_nothing_was_found_a_scene_is_itself(balls: Scene) -> None:
    training = balls.training()
    found = self_calibration(training)
    assert not found
    assert found.lines(training.cameras) == []
    assert found.scene(training) is training


def test_cameras_are_those_fitted_and_test_cameras_stay(balls: Scene) -> None:
    told = balls.training()
    other = {name: turned(camera, 1.0) for name, camera in told.cameras.items()}
    right = SelfCalibration(cameras=fitted(other)).scene(told)
    assert right.cameras == other
    assert right.test_cameras == told.test_cameras
    np.testing.assert_array_equal(right.image("1", 0), told.image("1", 0))
    np.testing.assert_array_equal(right.mask("1", 0), told.mask("1", 0))


def test_photographs_and_masks_are_straightened(cameras: dict[str, Camera], wrong: Scene) -> None:
    class Bent(TrainingScene):
        def image(self, camera: str, t: int) -> Any:
            return photograph(self.cameras[camera], k1=-0.2)

    right = SelfCalibration(cameras=fitted(dict(cameras), -0.2)).scene(Bent(wrong))
    straight = photograph(cameras["1"]).astype(float)
    inner = slice(12, -12), slice(18, -18)
    bent = np.abs(photograph(cameras["1"], k1=-0.2) - straight)[inner]
    assert np.median(np.abs(right.image("1", 0) - straight)[inner]) < 0.4 * np.median(bent)
    assert right.mask("1", 9).dtype == bool
    assert right.mask("1", 9).any()


def test_a_variation_tells_scenes_apart(balls: Scene) -> None:
    told = balls.training()
    turn = Rotation.from_rotvec([0, 0.01, 0]).as_matrix()
    other = {name: turned(camera, 1.0) for name, camera in told.cameras.items()}
    several = [
        SelfCalibration(offsets={"1": LATER}),
        SelfCalibration(offsets={"2": LATER}),
        SelfCalibration(offsets={"1": LATER}, seconds_per_step=0.5),
        SelfCalibration(knocks={"1": Knock(3, turn)}),
        SelfCalibration(knocks={"1": Knock(4, turn)}),
        SelfCalibration(cameras=fitted(dict(told.cameras))),
        SelfCalibration(cameras=fitted(dict(told.cameras), 0.1)),
        SelfCalibration(cameras=fitted(other)),
        SelfCalibration(responses={"1": BRIGHTER}),
        SelfCalibration(responses={"1": replace(BRIGHTER, contrast=1.2)}),
    ]
    variations = [found.scene(told).variation for found in several]
    assert told.variation == ""
    assert "" not in variations
    assert len(set(variations)) == len(several)
    assert [found.scene(told).variation for found in several] == variations


def test_parts_of_fits_are_not_shared_between_a_scene_and_its_correction(balls: Scene, tmp_path: Path) -> None:
    told = balls.training()
    fits: list[str] = []

    def save(text: str, place: Path) -> None:
        (place / "text").write_text(text)

    def asked(scene: TrainingScene) -> str:
        def fit() -> str:
            fits.append(scene.variation)
            return f"fit {len(fits)}"

        run = Run(seed=1, cache=tmp_path / "parts")
        return run.reuse(
            "part",
            scene,
            {},
            fit,
            save,
            lambda place: (place / "text").read_text(),
        )

    right = SelfCalibration(responses={"1": BRIGHTER}).scene(told)
    assert isinstance(right, CalibratedScene)
    assert [asked(told), asked(right), asked(told), asked(right)] == ["fit 1", "fit 2", "fit 1", "fit 2"]


def test_the_copy_is_a_scene_as_found(found: SelfCalibration, wrong: Scene, copied: Path) -> None:
    right, copy = found.scene(wrong.training()), Scene.open(copied)
    assert check_scene(copied) == []
    assert (copy.name, copy.train, copy.test) == (wrong.name, wrong.train, wrong.test)
    assert copy.digest != wrong.digest
    for t in (0, KNOCKED_AT):
        for name in copy.train:
            np.testing.assert_array_equal(copy.image(name, t), right.image(name, t))
            np.testing.assert_array_equal(copy.mask(name, t), right.mask(name, t))
        np.testing.assert_array_equal(copy.image("6", t), wrong.image("6", t))
        np.testing.assert_array_equal(copy.mask("6", t), wrong.mask("6", t))
    for name, camera in copy.cameras.items():
        np.testing.assert_array_equal(camera.projection, wrong.cameras[name].projection)
        np.testing.assert_allclose(copy.camera_times[name] - wrong.times, LATE if name == "5" else 0, atol=0.001)
        mask = copy.container_mask(name)
        assert mask is not None
        assert mask.all()
    assert copy.gravity is not None
    np.testing.assert_array_equal(copy.times, wrong.times)


def test_the_command_tells_what_it_finds_in_json(
    found: SelfCalibration, wrong_directory: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splashbench.selfcalibration.self_calibration", lambda scene, told: found)
    assert main(["scene", "self-calibrate", str(wrong_directory), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["clocks"] == {"5": pytest.approx(LATE, abs=0.001)}
    assert facts["knocks"]["4"]["timestep"] == KNOCKED_AT
    assert facts["exposures"]["2"]["stops"] == pytest.approx([STOPS] * 3, abs=0.02)
    assert (facts["cameras"], facts["written"], len(facts["lines"])) == (None, None, 3)
    told = Scene.open(wrong_directory).training().cameras
    other = SelfCalibration(cameras=fitted({name: turned(camera, 0.5) for name, camera in told.items()}))
    monkeypatch.setattr("splashbench.selfcalibration.self_calibration", lambda scene, told: other)
    assert main(["scene", "self-calibrate", str(wrong_directory), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["cameras"]["corrections"]["1"]["turned"] == pytest.approx(0.5)
    noisy = SelfCalibration(noisy={"2": 31.0})
    monkeypatch.setattr("splashbench.selfcalibration.self_calibration", lambda scene, told: noisy)
    assert main(["scene", "self-calibrate", str(wrong_directory), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["noise"] == {"2": 31.0}
    assert facts["lines"] == ["camera 2: photographs have 31 levels of noise, too much to hold masks against them"]


def test_a_right_scene_is_said_to_be_and_still_copied(
    balls: Scene, balls_directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "copy"
    assert main(["scene", "self-calibrate", str(balls_directory), "--out", str(out)]) == 0
    captured = capsys.readouterr()
    assert captured.out == "cameras, clocks and masks are as told\n"
    assert "nothing was found" in captured.err
    copy = Scene.open(out)
    assert copy.digest == balls.digest
    assert copy.stated == balls.stated
    assert copy.truth_particles() is not None
    np.testing.assert_array_equal(copy.truth_particles().positions, balls.truth_particles().positions)  # type: ignore[union-attr]
    np.testing.assert_array_equal(copy.initial_points(), balls.initial_points())


def test_what_scene_json_does_not_say_is_not_made_up(balls_copy: Path, tmp_path: Path) -> None:
    (balls_copy / "scene.json").unlink()
    told = balls_copy.rename(balls_copy.with_name("my pour"))
    assert main(["scene", "self-calibrate", str(told), "--out", str(tmp_path / "copy")]) == 0
    copy = Scene.open(tmp_path / "copy")
    assert (copy.times_source, copy.gravity, copy.metres_per_unit) == ("nominal", None, None)
    assert copy.name == "my_pour"


def test_the_containers_mesh_is_copied_and_a_missing_one_leaves_nothing_behind(
    balls_copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stated = read_json(balls_copy / "scene.json")
    write_json(balls_copy / "scene.json", {**stated, "container_mesh": "meshes/bowl.obj"})
    out = tmp_path / "copy"
    assert "bowl.obj" in error([balls_copy, "--out", out], capsys)
    assert not out.exists()
    assert not list(tmp_path.glob(".tmp-*"))
    (balls_copy / "meshes").mkdir()
    (balls_copy / "meshes" / "bowl.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert main(["scene", "self-calibrate", str(balls_copy), "--out", str(out)]) == 0
    mesh = Scene.open(out).container_mesh()
    assert mesh is not None
    assert len(mesh.faces) == 1


def test_an_earlier_copy_is_replaced_when_asked(
    balls_directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "copy"
    out.mkdir()
    (out / "train_meta.json").write_text("an earlier copy")
    assert "exists already" in error([balls_directory, "--out", out], capsys)
    assert (out / "train_meta.json").read_text() == "an earlier copy"
    assert main(["scene", "self-calibrate", str(balls_directory), "--out", str(out), "--replace"]) == 0
    assert Scene.open(out).n_frames == 8
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "holiday.jpg").touch()
    assert "is no earlier output" in error([balls_directory, "--out", tmp_path / "photos", "--replace"], capsys)
    assert (tmp_path / "photos" / "holiday.jpg").exists()


def test_wrong_places_and_scenes_are_one_line(
    balls_copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "is not a folder" in error([tmp_path / "nowhere"], capsys)
    (tmp_path / "empty").mkdir()
    assert "train_meta.json is missing" in error([tmp_path / "empty"], capsys)
    files = sorted(balls_copy.rglob("*"))
    for out in (balls_copy, balls_copy / "copy", balls_copy / "ims" / ".." / "copy"):
        for flags in ([], ["--replace"]):
            assert "is within the scene" in error([balls_copy, "--out", out, *flags], capsys)
    (tmp_path / "link").symlink_to(balls_copy)
    assert "is within the scene" in error([balls_copy, "--out", tmp_path / "link" / "copy"], capsys)
    assert "holds the input" in error([balls_copy, "--out", balls_copy.parent, "--replace"], capsys)
    assert sorted(balls_copy.rglob("*")) == files
    (balls_copy / "ims" / "2" / "000003.png").write_bytes(b"no image")
    assert "ims/2/000003.png" in error([balls_copy, "--out", tmp_path / "copy"], capsys)
    assert not (tmp_path / "copy").exists()


def test_a_scene_with_one_training_view_is_one_line(
    balls_copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    meta = read_json(balls_copy / "train_meta.json")
    alone = {key: [row[:1] for row in meta[key]] for key in ("k", "w2c", "fn")}
    write_json(balls_copy / "train_meta.json", {**meta, **alone})
    stated = read_json(balls_copy / "scene.json")
    write_json(balls_copy / "scene.json", {**stated, "sizes": None})
    for camera in "2345":
        shutil.rmtree(balls_copy / "ims" / camera)
    assert "has one training view" in error([balls_copy, "--out", tmp_path / "copy"], capsys)
    assert not (tmp_path / "copy").exists()

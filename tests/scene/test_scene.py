"""Scenes on disk: the released layout with and without scene.json, and what is said when something is wrong."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splashbench.errors import SplashbenchError
from splashbench.harness.training_copy import make_training_copy
from splashbench.scene import Scene
from splashbench.scene.inspection import check_scene, describe_scene
from splashbench.selfcalibration import SelfCalibration
from splashbench.selfcalibration.writing import write_calibrated
from splashbench.synth.balls import ball_centers


def test_a_scene_reads_back_what_was_written(balls: Scene) -> None:
    assert balls.train == ("1", "2", "3", "4", "5")
    assert balls.test == ("6", "7")
    assert balls.n_frames == 8
    assert balls.times_source == "scene.json"
    assert balls.gravity is not None
    assert balls.gravity.tolist() == [0, -1, 0]
    assert balls.image("1", 0).shape == (64, 96, 3)
    assert balls.mask("6", 3).any()
    points = balls.initial_points()
    assert points is not None
    assert points.shape == (576, 7)


def test_masks_lie_where_the_balls_project(balls: Scene) -> None:
    for name, camera in balls.cameras.items():
        uv, _ = camera.project(ball_centers(balls.times[2]))
        mask = balls.mask(name, 2)
        inside = (uv >= 0).all(1) & (uv < [camera.width, camera.height]).all(1)
        assert inside.any()
        columns, rows = uv[inside].astype(int).T
        assert mask[rows, columns].all()


def test_the_released_layout_alone_is_a_whole_scene(balls_copy: Path) -> None:
    (balls_copy / "scene.json").unlink()
    scene = Scene.open(balls_copy)
    assert scene.times_source == "nominal"
    assert scene.gravity is None
    assert scene.metres_per_unit is None
    assert scene.cameras["1"].width == 96
    assert check_scene(balls_copy) == []


def test_a_released_scene_gets_its_times_from_the_manifest(balls_copy: Path) -> None:
    (balls_copy / "scene.json").unlink()
    renamed = balls_copy.rename(balls_copy.with_name("bowl_004"))
    scene = Scene.open(renamed)
    assert scene.times_source == "manifest"
    assert scene.is_released
    # Table S1: 50 timesteps, 93.3 ms apart on average.
    np.testing.assert_allclose(np.diff(scene.times), 0.0933, rtol=2e-3)


def test_a_training_scene_gives_no_test_image_away(balls: Scene) -> None:
    training = balls.training()
    assert set(training.cameras) == {"1", "2", "3", "4", "5"}
    assert set(training.test_cameras) == {"6", "7"}
    for read in (training.image, training.mask):
        with pytest.raises(SplashbenchError, match=r"camera 6 .* no training view"):
            read("6", 0)


def test_a_mask_of_the_wrong_size_is_named(balls_copy: Path) -> None:
    path = balls_copy / "seg" / "3" / "000002.png"
    Image.new("L", (10, 20)).save(path)
    with pytest.raises(SplashbenchError, match=r"seg/3/000002.png is 10x20, but camera 3's images are 96x64"):
        Scene.open(balls_copy).mask("3", 2)
    assert any("000002.png is 10x20" in fault for fault in check_scene(balls_copy))


def test_every_fault_is_listed_at_once(balls_copy: Path) -> None:
    (balls_copy / "ims" / "1" / "000000.png").write_bytes(b"no image")
    (balls_copy / "seg" / "2" / "000001.png").unlink()
    faults = check_scene(balls_copy)
    assert len(faults) == 2
    assert "ims/1/000000.png" in faults[0]
    assert "seg/2/000001.png does not exist" in faults[1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda meta: meta.update(k=[[matrix[:2] for matrix in frame] for frame in meta["k"]]), "k is"),
        (lambda meta: meta["k"][0].pop(), "k is ragged"),
        (lambda meta: meta["w2c"][3][0][0].__setitem__(3, 7.0), "moving cameras are not supported"),
        (lambda meta: meta["fn"][0].__setitem__(0, "../../etc/passwd"), "not CAMERA/FRAME.jpg"),
        (lambda meta: meta["fn"][0].__setitem__(0, "/1/000000.png"), "not CAMERA/FRAME.jpg"),
        (lambda meta: meta.pop("w"), "w: Field required"),
        (lambda meta: meta["k"][0][0][0].__setitem__(0, "wide"), "k.0.0.0.0"),
        (lambda meta: meta["fn"].pop(), "k is 8x5x3x3"),
        (lambda meta: meta["w2c"][0][0][0].__setitem__(0, 1e9), "moving cameras|rotation"),
    ],
)
def test_json_of_wrong_shape_is_one_line_naming_the_file(balls_copy: Path, change, message: str) -> None:
    path = balls_copy / "train_meta.json"
    meta = json.loads(path.read_text())
    # write_scene repeats one list; make the frames independent before damaging one.
    meta = json.loads(json.dumps(meta))
    change(meta)
    path.write_text(json.dumps(meta))
    with pytest.raises(SplashbenchError, match=message) as caught:
        Scene.open(balls_copy)
    assert "train_meta.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_scene_json_is_checked(balls_copy: Path) -> None:
    path = balls_copy / "scene.json"
    meta = json.loads(path.read_text())
    path.write_text(json.dumps(meta | {"times": meta["times"][::-1]}))
    with pytest.raises(SplashbenchError, match="times must be finite and strictly increasing"):
        Scene.open(balls_copy)
    path.write_text(json.dumps(meta | {"times": meta["times"][:-1]}))
    with pytest.raises(SplashbenchError, match="times has 7 entries for 8 frames"):
        Scene.open(balls_copy)
    path.write_text(json.dumps(meta | {"surprise": 1}))
    with pytest.raises(SplashbenchError, match="surprise"):
        Scene.open(balls_copy)


def test_the_digest_covers_every_pixel_and_no_truth(balls_copy: Path) -> None:
    before = Scene.open(balls_copy).digest
    (balls_copy / "truth" / "particles.npz").unlink()
    assert Scene.open(balls_copy).digest == before
    path = balls_copy / "seg" / "7" / "000003.png"
    mask = np.array(Image.open(path))
    mask[0, 0] = 255
    Image.fromarray(mask).save(path)
    assert Scene.open(balls_copy).digest != before


def test_the_digest_covers_what_a_released_name_decides(balls_copy: Path) -> None:
    (balls_copy / "scene.json").unlink()
    before = Scene.open(balls_copy).digest
    assert Scene.open(balls_copy.rename(balls_copy.with_name("bowl_004"))).digest != before


def test_a_missing_scene_is_told(tmp_path: Path) -> None:
    with pytest.raises(SplashbenchError, match="is not a folder"):
        Scene.open(tmp_path / "nowhere")
    with pytest.raises(SplashbenchError, match=r"train_meta.json is missing"):
        Scene.open(tmp_path)


def test_info_tells_what_is_known(balls: Scene) -> None:
    facts = describe_scene(balls)
    assert facts["frames"] == 8
    assert facts["truth_particles"] is True
    assert facts["sizes"]["7"] == [96, 64]


def test_a_scene_without_masks_is_told_how_to_get_some(balls_copy: Path) -> None:
    scene = Scene.open(balls_copy)
    for name in scene.train:
        for t in range(scene.n_frames):
            Image.fromarray(np.zeros((64, 96), np.uint8)).save(scene.mask_path(name, t))
        faults = check_scene(balls_copy)
        assert any(f"{name}: every mask is empty" in fault for fault in faults)
        assert any("self-calibrate" in fault for fault in faults) == (name == scene.train[-1])


def _without_masks(scene: Path, *cameras: str) -> None:
    for name in cameras:
        shutil.rmtree(scene / "seg" / name)


def test_training_cameras_without_any_folder_of_masks_have_none(balls_copy: Path, tmp_path: Path) -> None:
    told = Scene.open(balls_copy)
    digest = told.digest
    _without_masks(balls_copy, *told.train)
    scene = Scene.open(balls_copy)
    assert scene.unmasked == set(scene.train)
    assert scene.mask(scene.train[0], 1).shape == (64, 96)
    assert not scene.training().mask(scene.train[0], 1).any()
    assert np.array_equal(scene.mask(scene.test[0], 1), told.mask(scene.test[0], 1))
    assert scene.digest != digest
    faults = check_scene(balls_copy)
    assert len(faults) == 1
    assert "seg: there are no masks of the training cameras" in faults[0]
    assert "self-calibrate" in faults[0]
    assert describe_scene(scene)["mask_coverage"].keys() == set(scene.test)
    copy = Scene.open(make_training_copy(scene, tmp_path / "copy"))
    assert not copy.mask(scene.train[0], 1).any()
    assert copy.mask_path(scene.train[0], 1).is_file()


def test_without_any_masks_a_scene_reads_and_says_what_scoring_needs(balls_copy: Path, tmp_path: Path) -> None:
    shutil.rmtree(balls_copy / "seg")
    scene = Scene.open(balls_copy)
    assert scene.unmasked == set(scene.cameras)
    assert len(scene.digest) == 64
    faults = check_scene(balls_copy)
    assert len(faults) == 2
    assert "no masks of test cameras" in faults[1]
    with pytest.raises(SplashbenchError, match=rf"seg/{scene.test[0]} is missing; test views are scored within masks"):
        scene.mask(scene.test[0], 0)
    write_calibrated(scene, SelfCalibration(), tmp_path / "copy")
    copy = Scene.open(tmp_path / "copy")
    assert copy.unmasked == set(scene.test)
    assert len(copy.digest) == 64


def test_a_folder_of_masks_with_another_name_is_a_mistake_and_not_taken_for_none(balls_copy: Path) -> None:
    scene = Scene.open(balls_copy)
    first = scene.train[0]
    _without_masks(balls_copy, *scene.train[1:])
    assert not Scene.open(balls_copy).unmasked
    (balls_copy / "seg" / first).rename(balls_copy / "seg" / f"camera_{first}")
    mistaken = Scene.open(balls_copy)
    assert not mistaken.unmasked
    with pytest.raises(SplashbenchError, match=rf"seg/{first}/000000.png"):
        mistaken.mask(first, 0)


@pytest.mark.parametrize("what", ["link to nowhere", "file"])
def test_something_else_in_place_of_seg_is_not_taken_for_no_masks(balls_copy: Path, what: str) -> None:
    shutil.rmtree(balls_copy / "seg")
    if what == "file":
        (balls_copy / "seg").write_text("masks.zip")
    else:
        (balls_copy / "seg").symlink_to(balls_copy / "unmounted")
    scene = Scene.open(balls_copy)
    assert not scene.unmasked
    with pytest.raises(SplashbenchError, match="seg/"):
        scene.mask(scene.train[0], 0)


def test_what_a_file_browser_leaves_in_seg_is_no_camera(balls_copy: Path) -> None:
    scene = Scene.open(balls_copy)
    _without_masks(balls_copy, *scene.train)
    (balls_copy / "seg" / ".DS_Store").write_bytes(b"x")
    assert Scene.open(balls_copy).unmasked == set(scene.train)


def test_a_broken_link_in_place_of_masks_is_not_taken_for_none(balls_copy: Path) -> None:
    scene = Scene.open(balls_copy)
    _without_masks(balls_copy, *scene.train)
    (balls_copy / "seg" / scene.train[0]).symlink_to(balls_copy / "nowhere")
    with pytest.raises(SplashbenchError, match=r"000000\.png"):
        Scene.open(balls_copy).mask(scene.train[1], 0)

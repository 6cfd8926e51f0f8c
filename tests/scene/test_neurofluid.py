"""NeuroFluid's scenes as downloaded: cameras, colours and masks, times, truth, and what hostile files are told."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splashbench.errors import SplashbenchError
from splashbench.harness.training_copy import make_training_copy
from splashbench.scene import Scene
from splashbench.scene.inspection import check_scene, describe_scene
from splashbench.study.scenes import changed_scene
from splashbench.study.spec import StudyVariant

RADIUS, STEP = 0.5, 0.02


def _start(t: int) -> np.ndarray:
    """Centre of the ball at timestep t."""
    time = t * STEP
    return np.array([0.45, -0.2, 1.0]) + np.array([0.6, 0.3, 1.5]) * time + np.array([0, 0, -9.81]) * time**2 / 2


def _edit(path: Path, change: Callable[[dict], object]) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def test_the_last_view_is_the_test_view_and_the_frames_are_those_of_all_views(watersphere: Path) -> None:
    scene = Scene.open(watersphere)
    assert (scene.name, scene.layout) == ("WaterSphere", "neurofluid")
    assert scene.train == ("view_1", "view_2", "view_3", "view_4")
    assert scene.test == ("view_5",)
    # Seven frames in the training views, six in the test view.
    assert scene.n_frames == 6
    assert not scene.is_released
    assert describe_scene(scene)["truth_particles"] is True


def test_any_folder_name_gives_a_scene_that_runs(watersphere_copy: Path, tmp_path: Path) -> None:
    for name, known in (("Water Sphere (1)", "Water_Sphere_1_"), ("-x", "_x"), ("bowl_001", "bowl_001")):
        folder = watersphere_copy.rename(tmp_path / name)
        scene = Scene.open(folder)
        assert scene.name == known
        # Not the released scene of that name: neither its times nor its units.
        assert (scene.times_source, scene.is_released) == ("neurofluid", False)
        make_training_copy(scene, tmp_path / f"view of {known}")
        watersphere_copy = folder


def test_times_gravity_and_scale_are_those_of_the_simulation(watersphere: Path) -> None:
    scene = Scene.open(watersphere)
    np.testing.assert_allclose(scene.times, np.arange(6) * 0.02)
    assert scene.times_source == "neurofluid"
    assert scene.gravity is not None
    assert scene.gravity.tolist() == [0, 0, -1]
    assert scene.metres_per_unit == 1.0


def test_the_true_particles_project_into_the_masks(watersphere: Path) -> None:
    scene = Scene.open(watersphere)
    true = scene.truth_particles()
    assert true is not None
    for name, camera in scene.cameras.items():
        for t in range(scene.n_frames):
            uv, depth = camera.project(true.at(t))
            assert (depth > 9).all()
            assert (depth < 13).all()
            columns, rows = uv.astype(int).T
            assert scene.mask(name, t)[rows, columns].mean() > 0.995


def test_masks_are_centred_on_the_projected_ball_and_as_large(watersphere: Path) -> None:
    scene = Scene.open(watersphere)
    for name, camera in scene.cameras.items():
        for t in (0, 5):
            mask = scene.mask(name, t)
            (center,), (depth,) = camera.project(_start(t)[None])
            middle = np.argwhere(mask).mean(axis=0)[::-1] + 0.5
            # Half a pixel of a flipped axis or of a shifted principal point would show.
            np.testing.assert_allclose(middle, center, atol=0.2)
            np.testing.assert_allclose(np.sqrt(mask.sum() / np.pi), camera.K[0, 0] * RADIUS / depth, rtol=0.03)


def test_colours_are_over_white(watersphere: Path) -> None:
    scene = Scene.open(watersphere)
    image, mask = scene.image("view_2", 3), scene.mask("view_2", 3)
    with Image.open(watersphere / "view_2" / "train" / "r_003.png") as file:
        rgba = np.asarray(file).astype(float) / 255
    np.testing.assert_allclose(image / 255, rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:], atol=0.51 / 255)
    assert (image[rgba[..., 3] == 0] == 255).all()
    assert (mask == (rgba[..., 3] > 0.5)).all()
    partial = (rgba[..., 3] > 0) & (rgba[..., 3] < 1)
    assert partial.any()


def test_the_truth_is_the_simulation(watersphere: Path) -> None:
    true = Scene.open(watersphere).truth_particles()
    assert true is not None
    assert true.n_frames == 6
    assert true.velocities is not None
    for t in range(6):
        np.testing.assert_allclose(np.median(true.positions[t], axis=0), _start(t), atol=1e-6)
        np.testing.assert_allclose(true.velocities[t] - [0.6, 0.3, 1.5 - 9.81 * t * STEP], 0, atol=1e-6)


def test_a_whole_scene_has_no_fault_and_its_pickle_stays_shut(
    watersphere: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert check_scene(watersphere) == []
    assert list(tmp_path.iterdir()) == []


def test_views_are_matched_by_the_simulations_frames(watersphere_copy: Path) -> None:
    # As HoneyCone may be: the test view begins at a later frame, and its images count from 0.
    def later(data: dict) -> None:
        data["frames"] = data["frames"][2:]
        for i, frame in enumerate(data["frames"]):
            source = watersphere_copy / "view_5" / f"{frame['file_path']}.png"
            frame["file_path"] = f"./test/begun_{i}"
            source.rename(watersphere_copy / "view_5" / "test" / f"begun_{i}.png")

    _edit(watersphere_copy / "view_5" / "transforms_test.json", later)
    scene = Scene.open(watersphere_copy)
    assert scene.n_frames == 4
    assert [scene.image_path("view_1", t).name for t in range(4)] == [f"r_{n:03d}.png" for n in (2, 3, 4, 5)]
    assert check_scene(watersphere_copy) == []


def test_views_of_other_instants_are_a_fault(watersphere_copy: Path) -> None:
    particles = watersphere_copy / "view_5" / "test" / "particles"
    for number in range(6):
        later = watersphere_copy / "view_1" / "train" / "particles" / f"{number + 1:04d}.npz"
        shutil.copy(later, particles / f"{number:04d}.npz")
    faults = check_scene(watersphere_copy)
    assert len(faults) == 4
    assert "view_1/train/particles/0000.npz" in faults[0]
    assert "view_5/test/particles/0000.npz hold other particles" in faults[0]


def test_times_that_the_velocities_contradict_are_a_fault(watersphere_copy: Path) -> None:
    times = [0.04 * t for t in range(6)]
    (watersphere_copy / "scene.json").write_text(json.dumps({"name": "slow", "times": times}))
    scene = Scene.open(watersphere_copy)
    assert (scene.name, scene.times_source) == ("slow", "scene.json")
    np.testing.assert_allclose(scene.times, times)
    assert scene.metres_per_unit == 1.0
    (fault,) = check_scene(watersphere_copy)
    assert "move 0.5 times as far as their velocities tell" in fault


def test_without_particles_it_is_a_scene_without_truth(watersphere_copy: Path) -> None:
    digest = Scene.open(watersphere_copy).digest
    for folder in watersphere_copy.glob("view_*/*/particles"):
        shutil.rmtree(folder)
    scene = Scene.open(watersphere_copy)
    assert scene.truth_particles() is None
    assert scene.truth_digest is None
    assert scene.digest == digest
    assert check_scene(watersphere_copy) == []


def test_the_digest_covers_pixels_and_poses(watersphere_copy: Path) -> None:
    digests = {Scene.open(watersphere_copy).digest}
    image = watersphere_copy / "view_5" / "test" / "r_004.png"
    rgba = np.array(Image.open(image))
    rgba[0, 0, 3] = 255
    Image.fromarray(rgba).save(image)
    digests.add(Scene.open(watersphere_copy).digest)
    _edit(watersphere_copy / "view_1" / "transforms_train.json", lambda data: data.update(camera_angle_x=0.33))
    digests.add(Scene.open(watersphere_copy).digest)
    assert len(digests) == 3


def test_the_digest_of_the_truth_covers_every_frame(watersphere_copy: Path) -> None:
    before = Scene.open(watersphere_copy).truth_digest
    path = watersphere_copy / "view_5" / "test" / "particles" / "0003.npz"
    state = dict(np.load(path))
    np.savez(path, **{name: array + 1e-4 for name, array in state.items()})
    assert Scene.open(watersphere_copy).truth_digest != before


def test_a_methods_copy_has_the_training_views_alone(watersphere: Path, tmp_path: Path) -> None:
    scene = Scene.open(watersphere)
    shown = Scene.open(make_training_copy(scene, tmp_path / "view"))
    assert shown.layout == "released"
    for t in range(scene.n_frames):
        for name in scene.train:
            assert (shown.image(name, t) == scene.image(name, t)).all()
            assert (shown.mask(name, t) == scene.mask(name, t)).all()
    for name, camera in scene.cameras.items():
        np.testing.assert_allclose(shown.cameras[name].projection, camera.projection)
        assert (shown.cameras[name].width, shown.cameras[name].height) == (64, 64)
    np.testing.assert_allclose(shown.times, scene.times)
    assert shown.gravity is not None
    assert shown.truth_particles() is None
    for read, says in ((shown.image, r"view_5/000000\.png does not exist"), (shown.mask, "seg/view_5 is missing")):
        with pytest.raises(SplashbenchError, match=says):
            read("view_5", 0)
    # Neither the truth nor a way to the folder that has it.
    files = [path.relative_to(tmp_path / "view") for path in (tmp_path / "view").rglob("*") if not path.is_dir()]
    assert not any((tmp_path / "view" / path).is_symlink() for path in files)
    assert {path.parts[:2] for path in files if len(path.parts) > 1} == {
        (folder, name) for folder in ("ims", "seg") for name in scene.train
    }
    assert {str(path) for path in files if len(path.parts) == 1} == {
        "train_meta.json",
        "test_meta.json",
        "scene.json",
    }
    texts = [(tmp_path / "view" / path).read_text() for path in files if path.suffix == ".json"]
    assert not any(str(watersphere) in text for text in texts)
    assert "radius" not in (tmp_path / "view" / "scene.json").read_text()


def test_a_study_takes_such_a_scene_with_fewer_views_and_worse_masks(watersphere: Path, tmp_path: Path) -> None:
    scene = Scene.open(watersphere)
    damage = {"kind": "empty_masks", "share": 0.5}
    variant = StudyVariant.model_validate({"name": "worse", "train_views": 3, "perturbation": [damage]})
    changed = changed_scene(scene, variant, 0, tmp_path)
    assert len(changed.train) == 3
    assert changed.test == ("view_5",)
    empty = [not changed.mask(name, t).any() for name in changed.train for t in range(6)]
    assert sum(empty) == 9
    assert (changed.mask("view_5", 2) == scene.mask("view_5", 2)).all()
    ours, theirs = changed.truth_particles(), scene.truth_particles()
    assert ours is not None
    assert theirs is not None
    np.testing.assert_array_equal(ours.positions, theirs.positions)


def _frame(data: dict) -> dict:
    return data["frames"][0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: _frame(d).update(file_path="../../../etc/passwd"), "no path of a file below"),
        (lambda d: _frame(d).update(file_path="/etc/passwd"), "no path of a file below"),
        (lambda d: _frame(d).update(file_path="./train/../../r_000"), "no path of a file below"),
        (lambda d: _frame(d).update(file_path="train/a\nb"), "no path of a file below"),
        (lambda d: _frame(d).update(file_path="a" * 2000), "at most 1000"),
        (lambda d: _frame(d).update(particle_path="../../view_5/test/particles/0000.npz"), "no path of a file below"),
        (lambda d: _frame(d)["transform_matrix"][0].__setitem__(3, float("nan")), "not finite"),
        (lambda d: _frame(d)["transform_matrix"][0].__setitem__(3, 1e300), "beyond 1e\\+09"),
        (lambda d: _frame(d)["transform_matrix"].pop(), "ragged"),
        (lambda d: _frame(d).update(transform_matrix=[]), "ragged"),
        (lambda d: [f.update(transform_matrix=[[0.0] * 4] * 4) for f in d["frames"]], "does not hold a rotation"),
        (lambda d: [f["transform_matrix"][0].__setitem__(0, 5.0) for f in d["frames"]], "does not hold a rotation"),
        (lambda d: _frame(d)["transform_matrix"][0].__setitem__(3, 7.0), "moving cameras"),
        (lambda d: d.update(camera_angle_x=float("nan")), "camera_angle_x"),
        (lambda d: d.update(camera_angle_x=4.0), "camera_angle_x"),
        (lambda d: d.update(camera_angle_x=1e-200), "camera_angle_x"),
        (lambda d: d.update(frames=[]), "frames"),
        (lambda d: d.pop("frames"), "frames: Field required"),
        (lambda d: d.update(frames=[_frame(d) | {"particle_path": "particles/0009.npz"}]), "no frame is in all of"),
    ],
)
def test_hostile_json_is_one_line_naming_the_file(
    watersphere_copy: Path, change: Callable[[dict], object], message: str
) -> None:
    _edit(watersphere_copy / "view_2" / "transforms_train.json", change)
    with pytest.raises(SplashbenchError, match=message) as caught:
        Scene.open(watersphere_copy)
    assert "view_2" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_and_damaged_files_are_named(watersphere_copy: Path) -> None:
    (watersphere_copy / "view_3" / "train" / "r_002.png").unlink()
    with Image.open(watersphere_copy / "view_4" / "train" / "r_001.png") as image:
        image.convert("RGB").save(watersphere_copy / "view_4" / "train" / "r_001.png")
    Image.new("RGBA", (30, 20)).save(watersphere_copy / "view_1" / "train" / "r_005.png")
    np.savez(watersphere_copy / "view_5" / "test" / "particles" / "0002.npz", pos=np.zeros((3, 3)))
    faults = check_scene(watersphere_copy)
    for part in (
        "view_3/train/r_002.png does not exist",
        "view_4/train/r_001.png has no alpha channel",
        "view_1/train/r_005.png is 30x20, but camera view_1's images are 64x64",
        "view_5/test/particles/0002.npz has 3 particles",
    ):
        assert sum(part in fault for fault in faults) == 1
    assert len(faults) == 4
    with pytest.raises(SplashbenchError, match=r"r_002.png is missing; restore it"):
        _ = Scene.open(watersphere_copy).digest


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"pos": np.full((4, 3), np.nan)}, "NaN"),
        ({"pos": np.zeros((4, 2))}, r"\[N, 3\]"),
        ({"pos": np.zeros((4, 3)), "vel": np.zeros((5, 3))}, "vel is"),
        ({"pos": np.full((4, 3), 1e30)}, "beyond"),
        ({"location": np.zeros((4, 3))}, "lacks the array 'pos'"),
        ({"pos": np.array([{}], dtype=object)}, "pickle"),
    ],
)
def test_damaged_particles_are_one_line(watersphere_copy: Path, state: dict, message: str) -> None:
    np.savez(watersphere_copy / "view_5" / "test" / "particles" / "0000.npz", **state)
    with pytest.raises(SplashbenchError, match=message) as caught:
        Scene.open(watersphere_copy).truth_particles()
    assert "0000.npz" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_view_without_its_json_is_named(watersphere_copy: Path) -> None:
    (watersphere_copy / "view_2" / "transforms_train.json").unlink()
    with pytest.raises(SplashbenchError, match=r"view_2/transforms_train.json is missing"):
        Scene.open(watersphere_copy)
    for view in ("view_1", "view_2", "view_3", "view_4"):
        shutil.rmtree(watersphere_copy / view)
    with pytest.raises(SplashbenchError, match=r"has the view view_5 alone"):
        Scene.open(watersphere_copy)


def test_frames_without_numbers_are_matched_by_their_place(watersphere_copy: Path) -> None:
    for view in watersphere_copy.iterdir():
        for file in view.glob("transforms_*.json"):

            def rename(data: dict, view: Path = view) -> None:
                for frame, letter in zip(data["frames"], "abcdefg"):
                    del frame["particle_path"]
                    source = view / f"{frame['file_path']}.png"
                    frame["file_path"] = f"frame_{letter}"
                    source.rename(view / f"frame_{letter}.png")

            _edit(file, rename)
    scene = Scene.open(watersphere_copy)
    assert scene.frames == tuple(f"frame_{letter}" for letter in "abcdef")
    assert scene.truth_particles() is None

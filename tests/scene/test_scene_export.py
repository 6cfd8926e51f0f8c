"""Exports are read again by small readers written from the formats' descriptions: the same pixels, times, points."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from splashbench.cli.main import main
from splashbench.colmap import pycolmap
from splashbench.errors import SplashbenchError
from splashbench.files import read_json, write_json
from splashbench.observe import initial_points
from splashbench.scene import Scene
from splashbench.scene.export import FORMATS, InitialPoints, export_scene, remarks
from splashbench.synth.balls import _RADII, ball_centers, write_balls_scene

#: Known points about the liquid, on no axis of anything.
POINTS = np.random.default_rng(5).uniform((-0.4, 0.0, -0.3), (0.5, 0.6, 0.3), (50, 3))

Project = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def points(balls: Scene) -> InitialPoints:
    return initial_points(balls, 300)


def _nerfies(folder: Path) -> dict[str, tuple[Project, Path, float]]:
    """Name of a view -> its projection, image, time; coordinates as Nerfies' readers change them, and back."""
    scene, metadata, dataset = (read_json(folder / f"{name}.json") for name in ("scene", "metadata", "dataset"))
    last = max(metadata[item]["time_id"] for item in dataset["ids"])

    def reader(camera: dict) -> Project:
        position = (np.array(camera["position"]) - scene["center"]) * scene["scale"]

        def project(world: np.ndarray) -> np.ndarray:
            scaled = (world - np.array(scene["center"])) * scene["scale"]
            x, y, z = np.array(camera["orientation"]) @ (scaled - position).T
            assert not any(camera["radial_distortion"] + camera["tangential"] + camera["tangential_distortion"])
            u = camera["focal_length"] * x / z + camera["skew"] * y / z + camera["principal_point"][0]
            v = camera["focal_length"] * camera["pixel_aspect_ratio"] * y / z + camera["principal_point"][1]
            return np.stack([u, v], axis=1)

        return project

    views = {}
    for path in [*(folder / "camera").iterdir(), *(folder / "camera-paths" / "test").iterdir()]:
        image = folder / "rgb" / "1x" / f"{path.stem}.png"
        views[path.stem] = (reader(read_json(path)), image, metadata[path.stem]["time_id"] / last)
    return views


def _transforms(content: dict, folder: Path, ending: str) -> dict[str, tuple[Project, Path, float]]:
    def reader(frame: dict) -> Project:
        matrix = np.linalg.inv(np.array(frame["transform_matrix"]))

        def project(world: np.ndarray) -> np.ndarray:
            x, y, z = matrix[:3, :3] @ world.T + matrix[:3, 3:]
            assert (z < 0).all()  # OpenGL looks along -z
            return np.stack([frame["cx"] - frame["fl_x"] * x / z, frame["cy"] + frame["fl_y"] * y / z], axis=1)

        return project

    return {
        Path(frame["file_path"]).name.removesuffix(".png"): (
            reader(frame),
            folder / (frame["file_path"] + ending),
            frame["time"],
        )
        for frame in content["frames"]
    }


def _blender(folder: Path) -> dict[str, tuple[Project, Path, float]]:
    train, test = (read_json(folder / f"transforms_{split}.json") for split in ("train", "test"))
    return _transforms(train, folder, ".png") | _transforms(test, folder, ".png")


def _nerfstudio(folder: Path) -> dict[str, tuple[Project, Path, float]]:
    test = folder / "transforms_test.json"
    views = _transforms(read_json(folder / "transforms.json"), folder, "")
    return views | (_transforms(read_json(test), folder, "") if test.is_file() else {})


def _colmap(folder: Path) -> dict[str, tuple[Project, Path, float]]:
    def reader(model: pycolmap.Reconstruction, image: pycolmap.Image) -> Project:
        camera = model.cameras[image.camera_id]
        assert camera.model.name == "PINHOLE"
        return lambda world: camera.img_from_cam(
            (image.cam_from_world().matrix() @ np.c_[world, np.ones(len(world))].T).T
        )

    views = {}
    count = len(list(folder.glob("colmap_*")))
    for parent in (folder, folder / "test"):
        for t in range(count):
            place = parent / f"colmap_{t}"
            model = pycolmap.Reconstruction(place / "sparse" / "0")
            for image in model.images.values():
                name = f"{image.name.removesuffix('.png')}_{t:06d}"
                views[name] = (reader(model, image), place / "images" / image.name, t / count)
    return views


READERS = {"nerfies": _nerfies, "blender": _blender, "nerfstudio": _nerfstudio, "colmap": _colmap}


def _views(scene: Scene, names: tuple[str, ...]) -> dict[str, tuple[str, int]]:
    return {f"{name}_{t:06d}": (name, t) for name in names for t in range(scene.n_frames)}


@pytest.mark.parametrize("name", FORMATS)
def test_known_points_fall_on_the_same_pixels_in_every_view(
    balls: Scene, points: InitialPoints, tmp_path: Path, name: str
) -> None:
    export_scene(balls, tmp_path / "out", name, points)
    read = READERS[name](tmp_path / "out")
    wanted = _views(balls, balls.train + balls.test)
    assert sorted(read) == sorted(wanted)
    for view, (camera, _) in wanted.items():
        expected, depth = balls.cameras[camera].project(POINTS)
        assert (depth > 0).all()
        np.testing.assert_allclose(read[view][0](POINTS), expected, atol=1e-3, rtol=0)


@pytest.mark.parametrize("name", FORMATS)
def test_training_images_are_there_and_no_pixel_of_a_test_view(
    balls: Scene, points: InitialPoints, tmp_path: Path, name: str
) -> None:
    export_scene(balls, tmp_path / "out", name, points, masks=True)
    read = READERS[name](tmp_path / "out")
    for view, (camera, t) in _views(balls, balls.train).items():
        np.testing.assert_array_equal(np.asarray(Image.open(read[view][1])), balls.image(camera, t))
    pictures = list((tmp_path / "out").rglob("*.png"))
    # An image and a mask of each training view, nothing else; nor anything of the truth.
    assert len(pictures) == 2 * len(balls.train) * balls.n_frames
    assert not any(read[view][1].exists() for view in _views(balls, balls.test))
    truth = [balls.image(camera, t).tobytes() for camera, t in _views(balls, balls.test).values()]
    assert not any(np.asarray(Image.open(path)).tobytes() in truth for path in pictures)


@pytest.mark.parametrize("name", FORMATS)
def test_test_images_are_black_or_true_as_asked(balls: Scene, points: InitialPoints, tmp_path: Path, name: str) -> None:
    export_scene(balls, tmp_path / "blank", name, points, test_images="blank", masks=True)
    export_scene(balls, tmp_path / "true", name, points, test_images="true", masks=True)
    blank, true = READERS[name](tmp_path / "blank"), READERS[name](tmp_path / "true")
    for view, (camera, t) in _views(balls, balls.test).items():
        picture = np.asarray(Image.open(blank[view][1]))
        assert picture.shape == balls.image(camera, t).shape
        assert not picture.any()
        np.testing.assert_array_equal(np.asarray(Image.open(true[view][1])), balls.image(camera, t))
    trained = len(balls.train) * balls.n_frames
    tested = len(balls.test) * balls.n_frames
    assert len(list((tmp_path / "blank").rglob("*.png"))) == 2 * trained + tested
    assert len(list((tmp_path / "true").rglob("*.png"))) == 2 * (trained + tested)


@pytest.mark.parametrize("name", ["nerfies", "blender", "nerfstudio"])
def test_times_are_those_of_the_photographs(tmp_path: Path, name: str) -> None:
    scene = write_balls_scene(tmp_path / "late", delays={"3": 0.004, "7": 0.02})
    export_scene(scene, tmp_path / "out", name, initial_points(scene, 50), test_images="blank")
    read = READERS[name](tmp_path / "out")
    first, last = scene.times[0], scene.times[-1] + 0.02
    for view, (camera, t) in _views(scene, scene.train + scene.test).items():
        seconds = scene.camera_times[camera][t]
        assert read[view][2] == pytest.approx((seconds - first) / (last - first), abs=4e-6)
    listed = read_json(tmp_path / "out" / "test_views.json")
    for view in listed["views"]:
        assert view["seconds"] == scene.camera_times[view["camera"]][view["frame"]]
        assert listed["time_origin_seconds"] + view["time"] * listed["time_span_seconds"] == pytest.approx(
            view["seconds"], abs=1e-12
        )


def test_the_list_of_test_views_says_how_to_render_them(balls: Scene, points: InitialPoints, tmp_path: Path) -> None:
    export_scene(balls, tmp_path / "out", "blender", points)
    listed = read_json(tmp_path / "out" / "test_views.json")
    assert sorted(listed["cameras"]) == sorted(balls.test)
    for name, camera in listed["cameras"].items():
        x, y, z = (np.array(camera["w2c"])[:3] @ np.c_[POINTS, np.ones(len(POINTS))].T).T.T
        u, v, w = np.array(camera["K"]) @ [x, y, z]
        np.testing.assert_allclose(np.stack([u / w, v / w], axis=1), balls.cameras[name].project(POINTS)[0], atol=1e-9)
        assert (camera["width"], camera["height"]) == (balls.cameras[name].width, balls.cameras[name].height)
    assert [view["render"] for view in listed["views"]][9] == "renders/7/000001.png"
    assert len(listed["views"]) == 2 * balls.n_frames


def _distance_to_balls(positions: np.ndarray, time: float) -> np.ndarray:
    """Distance [N] of `positions` to the nearest ball's surface, negative inside."""
    away = np.linalg.norm(positions[:, None] - ball_centers(time), axis=2) - _RADII
    return away.min(axis=1)


def test_points_of_the_liquid_lie_about_it_in_its_colours(balls: Scene, points: InitialPoints) -> None:
    for t, liquid in enumerate(points.liquid):
        assert len(liquid) == 300
        away = _distance_to_balls(liquid[:, :3], balls.times[t])
        # Outside the balls by what the hull is larger, inside by half a voxel of 96 along a side of about 1.3 m.
        assert away.min() > -0.02
        assert np.median(away) < 0.03
        # Of the next frame's liquid, which has moved by up to 0.1 m, they say less.
        other = (t + 4) % balls.n_frames
        assert np.median(_distance_to_balls(liquid[:, :3], balls.times[other])) > np.median(away)
        assert (liquid[:, 5] > liquid[:, 3]).mean() > 0.7  # the balls are blue, the floor is not


def test_points_are_read_again_from_every_format(balls: Scene, points: InitialPoints, tmp_path: Path) -> None:
    static = balls.initial_points()
    assert static is not None
    for name in FORMATS:
        export_scene(balls, tmp_path / name, name, points)
    whole = points.cloud()
    assert len(whole) == len(static) + 8 * 300
    np.testing.assert_allclose(
        np.load(tmp_path / "nerfies" / "points.npy", allow_pickle=False), whole[:, :3], atol=1e-6
    )
    for name in ("blender", "nerfstudio"):
        cloud = trimesh.load(tmp_path / name / "points3d.ply")
        np.testing.assert_allclose(cloud.vertices, whole[:, :3], atol=1e-6)
        np.testing.assert_allclose(cloud.colors[:, :3] / 255, whole[:, 3:], atol=0.5 / 255 + 1e-6)
        assert b"property float nx" in (tmp_path / name / "points3d.ply").read_bytes()[:400]
    for t in (0, 7):
        model = pycolmap.Reconstruction(tmp_path / "colmap" / f"colmap_{t}" / "sparse" / "0")
        kept = [model.points3D[number] for number in sorted(model.points3D)]
        np.testing.assert_allclose([point.xyz for point in kept], points.frame(t)[:, :3])
        np.testing.assert_allclose([point.color / 255 for point in kept], points.frame(t)[:, 3:], atol=0.5 / 255 + 1e-6)


def test_nerfies_has_a_scene_of_size_one_between_its_planes(
    balls: Scene, points: InitialPoints, tmp_path: Path
) -> None:
    export_scene(balls, tmp_path / "out", "nerfies", points)
    scene = read_json(tmp_path / "out" / "scene.json")
    eyes = (np.stack([camera.center for camera in balls.cameras.values()]) - scene["center"]) * scene["scale"]
    liquid = np.concatenate(points.liquid)[:, :3]
    depths = np.concatenate([camera.project(liquid)[1] for camera in balls.cameras.values()]) * scene["scale"]
    assert np.linalg.norm(eyes, axis=1).max() <= 0.5 + 1e-9
    assert 0 < scene["near"] < depths.min()
    assert depths.max() < scene["far"]
    metadata = read_json(tmp_path / "out" / "metadata.json")
    assert metadata["4_000006"]["warp_id"] == 6
    assert metadata["4_000006"]["camera_id"] == 3
    dataset = read_json(tmp_path / "out" / "dataset.json")
    assert dataset["val_ids"] == []
    assert dataset["count"] == len(dataset["train_ids"]) == 40


def test_nerfstudio_holds_no_training_view_out_and_takes_no_liquid_mask_for_its_own(
    balls: Scene, points: InitialPoints, tmp_path: Path
) -> None:
    export_scene(balls, tmp_path / "out", "nerfstudio", points, masks=True)
    content = read_json(tmp_path / "out" / "transforms.json")
    files = [frame["file_path"] for frame in content["frames"]]
    assert content["train_filenames"] == files
    assert len(files) == 40
    assert content["test_filenames"] == []
    assert not any("mask_path" in frame for frame in content["frames"])
    mask = np.asarray(Image.open(tmp_path / "out" / content["frames"][3]["liquid_mask_path"])) > 127
    np.testing.assert_array_equal(mask, balls.mask("1", 3))


def test_an_export_takes_no_place_of_something_else(balls: Scene, points: InitialPoints, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    with pytest.raises(SplashbenchError, match="no earlier output"):
        export_scene(balls, tmp_path / "mine", "colmap", points, replace=True)
    with pytest.raises(SplashbenchError, match="holds the input"):
        export_scene(balls, balls.directory, "colmap", points, replace=True)
    export_scene(balls, tmp_path / "out", "colmap", points)
    export_scene(balls, tmp_path / "out", "blender", points, replace=True)
    assert not (tmp_path / "out" / "colmap_0").exists()


def test_what_a_format_cannot_say_is_one_line_and_leaves_nothing(
    balls_copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    meta = read_json(balls_copy / "train_meta.json")
    for row in meta["k"]:
        row[1][0][1] = 3.0  # skew
    write_json(balls_copy / "train_meta.json", meta)
    for name in ("colmap", "blender", "nerfstudio"):
        assert main(["scene", "export", str(balls_copy), str(tmp_path / "out"), "--format", name]) == 1
        assert "camera 2: K has more than focal lengths" in capsys.readouterr().err
    assert not [path for path in tmp_path.iterdir() if path != balls_copy]
    scene = Scene.open(balls_copy)
    export_scene(scene, tmp_path / "out", "nerfies", initial_points(scene, 10))
    read = _nerfies(tmp_path / "out")
    np.testing.assert_allclose(read["2_000000"][0](POINTS), scene.cameras["2"].project(POINTS)[0], atol=1e-3)


def test_without_any_points_it_says_what_to_do(balls_copy: Path, tmp_path: Path) -> None:
    (balls_copy / "init_pt_cld.npz").unlink()
    scene = Scene.open(balls_copy)
    with pytest.raises(SplashbenchError, match="no points to start from"):
        export_scene(scene, tmp_path / "out", "blender", initial_points(scene, 0))


def test_the_command_says_what_was_written_and_what_to_know(
    balls_directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["scene", "export", str(balls_directory), str(tmp_path / "plain"), "--points", "20", "--json"]
    assert main([*arguments, "--format", "nerfies"]) == 0
    out, err = capsys.readouterr()
    told = json.loads(out)
    assert (told["format"], told["test_images"], told["liquid_points"]) == ("nerfies", "none", 160)
    assert any("begins with NeRF" in remark for remark in told["remarks"])
    assert any("principal points lie up to 2.7 pixels off" in remark for remark in told["remarks"])
    assert "2 test views without images" in err
    assert main([*arguments[:3], str(tmp_path / "frames"), "--format", "colmap", "--points", "20"]) == 0
    err = capsys.readouterr().err
    assert "note: COLMAP's layout counts frames: steps that are uneven by up to" in err
    assert "simultaneous" not in err
    late = write_balls_scene(tmp_path / "late", delays={"3": 0.004})
    assert main([*arguments[:2], str(late.directory), str(tmp_path / "late_frames"), "--format", "colmap"]) == 0
    assert "cameras that expose up to 4.0 ms apart" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        main([*arguments, "--format", "blender", "--with-test-images", "--blank-test-images"])
    assert stop.value.code == 2


@pytest.mark.parametrize(
    ("layout", "said"),
    [
        ("nerfies", "Deformable-3DGS ignores them"), ("blender", "4D-Scaffold-GS reads them"),
        ("colmap", "its loader colmap puts them in the middle"), ("nerfstudio", None),
    ],
)  # fmt: skip
def test_what_becomes_of_principal_points_is_said_by_format(balls: Scene, layout: str, said: str | None) -> None:
    (told,) = [note for note in remarks(balls, layout, Path("NeRF", "x")) if "principal points" in note] or [None]
    assert (told is None) == (said is None)
    assert said is None or said in told


@pytest.mark.parametrize(("layout", "most"), [("colmap", 10_000), ("nerfstudio", 100_000)])
def test_that_static_points_are_left_out_is_said_and_counted(
    balls: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layout: str, most: int
) -> None:
    many = np.random.default_rng(0).uniform(0, 1, (most + 500, 6))
    monkeypatch.setattr(Scene, "initial_points", lambda self: many)
    assert f"{most} of the {most + 500} static points are written" in " ".join(remarks(balls, layout, Path("x")))
    points = InitialPoints(many, tuple(np.zeros((0, 6)) for _ in range(balls.n_frames)))
    assert export_scene(balls, tmp_path / "out", layout, points).static_points == most
    monkeypatch.setattr(Scene, "initial_points", lambda self: many[:most])
    assert "static points" not in " ".join(remarks(balls, layout, Path("x")))

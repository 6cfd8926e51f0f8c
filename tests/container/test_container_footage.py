"""`splashbench scene reconstruct-container`: the container's surface from the views, where nobody scanned it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splashbench.cli.main import main
from splashbench.files import read_gray, read_image, write_png
from splashbench.observe import Bounds, Grid
from splashbench.observe.container import depth_image, hidden, solid_distance
from splashbench.scene import Scene, SceneMeta, write_scene

from .painted import bowl, write_painted_scene

# Metres: what a pixel covers there, twice over.
NEAR = 0.012


@pytest.fixture(scope="module")
def textured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    texture = np.random.default_rng(0).uniform(40, 220, (48, 48, 48, 3))
    return write_painted_scene(tmp_path_factory.mktemp("bowl") / "bowl", texture)


@pytest.fixture(scope="module")
def done(textured: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The textured scene with its container; read-only."""
    folder = Path(shutil.copytree(textured, tmp_path_factory.mktemp("done") / "bowl"))
    assert main(["scene", "reconstruct-container", str(folder)]) == 0
    return folder


@pytest.fixture
def scene(textured: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(textured, tmp_path / "bowl"))


def reconstruct(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    capsys.readouterr()
    assert main(["scene", "reconstruct-container", *map(str, words), "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    capsys.readouterr()
    assert main(["scene", "reconstruct-container", *map(str, words)]) == 1
    said = capsys.readouterr().err.splitlines()
    said = [line for line in said if not line.startswith("reconstructing")]
    assert len(said) == 1
    return said[0]


def mesh_file(folder: Path) -> Path:
    (path,) = folder.glob("container*.ply")
    return path


def everything(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_the_views_show_where_the_container_is_and_what_it_hides(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = everything(scene)
    said = reconstruct(capsys, scene, "--picture", tmp_path / "p.png")
    found = Scene.open(scene).container_mesh()
    assert found is not None
    assert found.is_closed
    assert found.is_oriented
    assert said["faces"] == len(found.faces)
    inside = np.random.default_rng(1).uniform((-0.3, 0.03, -0.3), (0.3, 0.28, 0.3), (4000, 3))
    for name, camera in Scene.open(scene).cameras.items():
        assert said["overlap"][name] > 0.88
        true, here = depth_image(bowl(), camera), depth_image(found, camera)
        both = np.isfinite(true) & np.isfinite(here)
        error = np.abs(here[both] - true[both])
        assert np.median(error) < NEAR
        assert np.mean(error < 2 * NEAR) > 0.8
        told = hidden(inside, here, camera, NEAR)
        truly = hidden(inside, true, camera, NEAR)
        assert 0.2 < truly.mean() < 0.8
        assert np.mean(told == truly) > 0.9
    # A row a camera, the image beside the surface.
    assert read_image(tmp_path / "p.png").shape == (7 * 160, 2 * 240, 3)
    after = everything(scene)
    assert set(after) == set(before) | {mesh_file(scene).name}
    assert said["mesh"] == str(mesh_file(scene))
    assert [name for name in before if before[name] != after[name]] == ["scene.json"]
    described, was = json.loads(after["scene.json"]), json.loads(before["scene.json"])
    changed = {key for key in described if described[key] != was[key]}
    assert changed == {"container_mesh", "container_pose", "container_transparent"}
    assert (described["container_transparent"], described["times"]) == (False, was["times"])


def test_what_is_free_to_see_is_no_wall(done: Path) -> None:
    mesh = Scene.open(done).container_mesh()
    assert mesh is not None
    grid = Grid.over(Bounds(np.array([-0.36, 0.0, -0.36]), np.array([0.36, 0.28, 0.36])), 72)
    found, true = solid_distance(mesh, grid), solid_distance(bowl(), grid)
    across = np.hypot(grid.nodes()[..., 0], grid.nodes()[..., 2])
    hollow = (true > 2) & (across < 0.13)
    assert hollow.sum() > 5000
    assert np.mean(found[hollow] < 0) < 0.05
    assert np.mean(found[true < -1] < 0) > 0.3


def test_a_released_scene_stays_one(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # A folder with a real scene's name and without a scene.json is taken for the release's.
    released = Path(shutil.copytree(scene, tmp_path / "bowl_001"))
    (released / "scene.json").unlink()
    assert Scene.open(released).is_released
    capsys.readouterr()
    assert main(["scene", "reconstruct-container", str(released)]) == 0
    assert "assumed to be opaque" in capsys.readouterr().err
    assert Scene.open(released).is_released


def test_test_views_take_no_part(scene: Path, done: Path, capsys: pytest.CaptureFixture[str]) -> None:
    noise = np.random.default_rng(2)
    for name in Scene.open(scene).test:
        for path in [*(scene / "ims" / name).iterdir(), scene / "container_mask" / f"{name}.png"]:
            write_png(path, noise.integers(0, 256, read_image(path).shape, dtype=np.uint8)[..., 0])
    said = reconstruct(capsys, scene)
    assert mesh_file(scene).read_bytes() == mesh_file(done).read_bytes()
    assert said["doubtful"] == ["6", "7"]


def test_a_cropped_scene_takes_the_masks_of_the_whole_one(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = Scene.open(scene)
    windows = {name: (20 + i, 10 + 2 * i, 190, 130) for i, name in enumerate(whole.cameras)}
    cropped = tmp_path / "cropped"

    def cut(name: str, pixels: np.ndarray) -> np.ndarray:
        x, y, width, height = windows[name]
        return pixels[y : y + height, x : x + width]

    write_scene(
        cropped,
        cameras={name: camera.cropped(*windows[name]) for name, camera in whole.cameras.items()},
        train=whole.train,
        test=whole.test,
        n_frames=whole.n_frames,
        frames=(
            (name, t, cut(name, whole.image(name, t)), cut(name, whole.mask(name, t)))
            for name in whole.cameras
            for t in range(whole.n_frames)
        ),
        meta=SceneMeta(name="cropped", times=list(whole.times)),
    )
    assert "name the scene before it was cropped by --masks" in refused(capsys, cropped)
    said = reconstruct(capsys, cropped, "--masks", scene)
    assert min(said["overlap"].values()) > 0.85
    mesh = Scene.open(cropped).container_mesh()
    assert mesh is not None
    for camera in whole.cameras.values():
        true, here = depth_image(bowl(), camera), depth_image(mesh, camera)
        both = np.isfinite(true) & np.isfinite(here)
        assert np.median(np.abs(here[both] - true[both])) < NEAR


def test_a_mask_without_outline_is_refused(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = scene / "container_mask" / "3.png"
    for value, word in ((0, "empty"), (255, "full")):
        write_png(path, np.full((160, 240), value, np.uint8))
        assert f"3.png: the mask is {word}" in refused(capsys, scene)
    for name in "2345":
        (scene / "container_mask" / f"{name}.png").unlink()
    assert "1 of the training cameras" in refused(capsys, scene)


def test_what_cannot_be_seen_is_refused_and_nothing_changes(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = write_painted_scene(tmp_path / "plain", None)
    before = everything(plain)
    assert "a container without texture" in refused(capsys, plain)
    assert "ends in .png" in refused(capsys, plain, "--picture", "picture")
    assert everything(plain) == before
    described = json.loads((scene / "scene.json").read_text())
    (scene / "scene.json").write_text(json.dumps(described | {"container_transparent": True}))
    assert "the container is transparent" in refused(capsys, scene)
    (scene / "scene.json").write_text(json.dumps(described))
    reconstruct(capsys, scene)
    first, digest = mesh_file(scene), Scene.open(scene).digest
    assert "has a container already" in refused(capsys, scene)
    mask = read_gray(scene / "container_mask" / "1.png")
    write_png(scene / "container_mask" / "1.png", cv2.dilate(mask, np.ones((5, 5), np.uint8)))
    reconstruct(capsys, scene, "--replace")
    # Another mesh is another scene, and leaves no old file.
    assert mesh_file(scene) != first
    assert Scene.open(scene).digest != digest

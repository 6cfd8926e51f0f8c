"""`splashbench scene place-container`: the scanned container put into a scene that says nothing of it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from splashbench.cli.main import main
from splashbench.container.verification import intersection_over_union, silhouette
from splashbench.files import read_gray, read_image, write_png
from splashbench.scene import Scene
from splashbench.scene.container import ContainerMesh


def mug() -> ContainerMesh:
    """A bowl with a handle, 91 cm wide, in centimetres; +y is up."""
    profile = [[0, 0], [14, 0], [24, 7], [35, 28], [33, 28], [23, 9], [13, 2], [0, 2]]
    body = trimesh.creation.revolve(np.array(profile, np.float64), sections=48)
    handle = trimesh.creation.torus(10, 2)
    vertices = np.concatenate([body.vertices[:, [0, 2, 1]] * [1, 1, -1], handle.vertices + np.array([40.0, 16.0, 0.0])])
    return ContainerMesh(vertices, np.concatenate([body.faces, handle.faces + len(body.vertices)]))


def pose() -> np.ndarray:
    """Centimetres to the scene's metres, turned about the vertical axis."""
    matrix = np.eye(4)
    matrix[:3, :3] = 0.01 * Rotation.from_euler("y", 20, degrees=True).as_matrix()
    matrix[:3, 3] = (0.05, 0.02, 0.1)
    return matrix


@pytest.fixture
def released(balls_copy: Path) -> Path:
    """A scene with container masks and without a scene.json."""
    scene, mesh = Scene.open(balls_copy), mug()
    for name, camera in scene.cameras.items():
        mask = silhouette(mesh, pose(), camera)
        assert 200 < mask.sum() < 0.5 * mask.size
        write_png(balls_copy / "container_mask" / f"{name}.png", np.where(mask, 255, 0).astype(np.uint8))
    (balls_copy / "scene.json").unlink()
    return balls_copy


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    """The mesh's file."""
    mesh = mug()
    path = tmp_path / "scans" / "mug.ply"
    path.parent.mkdir()
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
    return path


def place(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    capsys.readouterr()
    assert main(["scene", "place-container", *map(str, words), "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    capsys.readouterr()
    assert main(["scene", "place-container", *map(str, words)]) == 1
    said = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("placing")]
    assert len(said) == 1
    return said[0]


def everything(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_a_scan_tells_place_gravity_and_scale(
    released: Path, scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = Scene.open(released)
    assert (before.gravity, before.metres_per_unit, before.container_mesh()) == (None, None, None)
    said = place(capsys, released, scan, "--metres-per-unit", "0.01", "--picture", tmp_path / "p.png")
    scene = Scene.open(released)
    assert scene.gravity is not None
    assert scene.metres_per_unit is not None
    assert np.degrees(np.arccos(-scene.gravity[1])) < 1.5
    assert scene.metres_per_unit == pytest.approx(1, rel=0.02)
    mesh = scene.container_mesh()
    assert mesh is not None
    distance, _ = cKDTree(mesh.vertices).query(mug().placed(pose()).vertices)
    assert distance.max() < 0.01  # a pixel is 1.6 cm there
    assert said["turn"] == "determined"
    # Held-out cameras took no part, and see it where it is.
    assert set(said["overlap"]) == set(scene.cameras)
    for name, camera in scene.cameras.items():
        overlap = intersection_over_union(silhouette(mesh, np.eye(4), camera), silhouette(mug(), pose(), camera))
        assert overlap > 0.93
        assert said["overlap"][name] == pytest.approx(overlap, abs=0.01)
    np.testing.assert_array_equal(scene.times, before.times)
    assert scene.name == before.name
    assert (released / "container.ply").read_bytes() == scan.read_bytes()
    assert read_image(tmp_path / "p.png").shape == (4 * 64, 2 * 96, 3)


@pytest.mark.slow
def test_what_scene_json_said_stays_and_a_container_is_replaced_on_demand(
    released: Path, scan: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tilted = [0.0, -0.8, -0.6]  # somebody knew better
    (released / "scene.json").write_text(
        json.dumps({"name": "mine", "times": [i / 20 for i in range(8)], "gravity": tilted})
    )
    said = place(capsys, released, scan, "--metres-per-unit", "0.01", "--transparent")
    assert said["gravity"] == tilted
    assert said["found_gravity"][1] < -0.99
    found = json.loads((released / "scene.json").read_text())
    assert (found["name"], found["times"][2], found["container_transparent"]) == ("mine", 0.1, True)
    assert found["gravity"] == tilted
    assert found["metres_per_unit"] == pytest.approx(1, rel=0.02)
    before = everything(released)
    assert "--replace" in refused(capsys, released, scan)
    stl = Path(shutil.copy(scan, scan.with_suffix(".stl")))
    assert "convert it" in refused(capsys, released, stl, "--replace")
    assert "ends in .png" in refused(capsys, released, scan, "--replace", "--picture", "picture")
    assert everything(released) == before
    monkeypatch.chdir(released)
    place(capsys, ".", scan, "--replace", "--up", "y")  # in metres: a giant's
    again = json.loads((released / "scene.json").read_text())
    assert again["gravity"][1] < -0.99
    assert again["metres_per_unit"] == pytest.approx(100 * found["metres_per_unit"], rel=0.02)
    assert again["container_transparent"] is True


def test_a_cropped_scene_takes_the_masks_of_the_whole_one(
    released: Path, scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cropped = Path(shutil.copytree(released, tmp_path / "cropped", ignore=shutil.ignore_patterns("container_mask")))
    before = everything(cropped)
    assert "name the scene before it was cropped by --masks" in refused(capsys, cropped, scan)
    other = Path(shutil.copytree(released, tmp_path / "other"))
    meta = json.loads((other / "train_meta.json").read_text())
    for frame in meta["w2c"]:
        frame[0][0][3] += 0.1
    (other / "train_meta.json").write_text(json.dumps(meta))
    assert "camera 1 stands elsewhere" in refused(capsys, cropped, scan, "--masks", other)
    assert everything(cropped) == before
    # A held-out camera decides nothing, and is doubted.
    wrong = read_gray(released / "container_mask" / "6.png")
    write_png(released / "container_mask" / "6.png", np.roll(wrong, 40, axis=1))
    assert place(capsys, cropped, scan, "--masks", released, "--metres-per-unit", "0.01")["doubtful"] == ["6"]
    assert Scene.open(cropped).metres_per_unit == pytest.approx(1, rel=0.02)


def test_another_mesh_is_refused_and_nothing_written(
    released: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rod = tmp_path / "rod.ply"
    trimesh.creation.box((3, 0.05, 0.05)).export(rod)
    before = everything(released)
    assert "check that it is this container's" in refused(capsys, released, rod)
    assert "is no file" in refused(capsys, released, tmp_path / "none.glb")
    assert everything(released) == before
    (released / "container.ply").write_bytes(b"somebody's")
    assert "is there already" in refused(capsys, released, rod)
    assert (released / "container.ply").read_bytes() == b"somebody's"

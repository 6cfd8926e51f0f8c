"""Container meshes: PLY, GLB and OBJ files, where they lie, and what is refused."""

from __future__ import annotations

import json
import os
import resource
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from splashbench.errors import SplashbenchError
from splashbench.harness.training_copy import make_training_copy
from splashbench.scene import ContainerMesh, Scene
from splashbench.scene.container import read_mesh
from splashbench.synth.imaging.geometry import bowl_mesh

PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
)


def with_mesh(directory: Path, name: str, pose: list | None = None) -> Path:
    """Name a container mesh in the scene.json of `directory`."""
    path = directory / "scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"container_mesh": name, "container_pose": pose}))
    return directory


@pytest.mark.parametrize("form", ["ascii", "binary"])
def test_a_ply_file_is_read_as_it_was_written(tmp_path: Path, form: str) -> None:
    box = trimesh.creation.box(extents=(1, 2, 3))
    (tmp_path / "box.ply").write_bytes(trimesh.exchange.ply.export_ply(box, encoding=form))
    mesh = read_mesh(tmp_path / "box.ply")
    assert mesh.faces.shape == (12, 3)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [0.5, 1, 1.5])
    assert mesh.is_closed
    assert mesh.is_oriented


def test_every_part_of_a_glb_file_lies_where_its_scene_puts_it(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(), transform=trimesh.transformations.translation_matrix([5, 0, 0]))
    scene.add_geometry(trimesh.creation.box())
    (tmp_path / "boxes.glb").write_bytes(scene.export(file_type="glb"))
    mesh = read_mesh(tmp_path / "boxes.glb")
    assert len(mesh.faces) == 24
    np.testing.assert_allclose([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)], [[-0.5] * 3, [5.5, 0.5, 0.5]])
    assert mesh.is_closed


def test_an_obj_file_opens_no_other_file(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("mtllib /etc/passwd\nusemtl x\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert len(read_mesh(tmp_path / "a.obj").faces) == 1


def test_vertices_that_a_seam_has_split_are_one_again() -> None:
    box = trimesh.creation.box()
    mesh = ContainerMesh(box.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3))
    assert mesh.vertices.shape == (8, 3)
    assert mesh.is_closed
    assert not ContainerMesh(box.vertices, box.faces[:-1]).is_closed
    turned = box.faces.copy()
    turned[0] = turned[0, ::-1]
    assert ContainerMesh(box.vertices, turned).is_closed
    assert not ContainerMesh(box.vertices, turned).is_oriented


@pytest.mark.parametrize(
    ("body", "fault"),
    [
        (PLY + "0 0 0\n1 0 0\n0 nan 0\n3 0 1 2\n", "not finite"),
        (PLY + "0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "vertices which are not there"),
        (PLY + "0 0 0\n1 0 0\n0 1 0\n3 0 1 -1\n", "vertices which are not there"),
        (PLY + "0 0 0\n1 0 0\n0 0 0\n3 0 1 2\n", "no triangle"),
        ("something else", "not a readable mesh"),
    ],
)
def test_a_damaged_mesh_is_one_line_that_names_the_file(tmp_path: Path, body: str, fault: str) -> None:
    path = tmp_path / "bad.ply"
    path.write_text(body)
    with pytest.raises(SplashbenchError, match=fault) as caught:
        read_mesh(path)
    assert str(path) in str(caught.value)


def test_a_mesh_shown_a_million_times_is_refused_before_it_is_written_out(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("splashbench.scene.container.MAX_FACES", 100)
    scene = trimesh.Scene()
    box = trimesh.creation.box()
    for n in range(10):
        scene.add_geometry(box, node_name=str(n), geom_name="box")
    (tmp_path / "many.glb").write_bytes(scene.export(file_type="glb"))
    with pytest.raises(SplashbenchError, match="120 faces, more than 100"):
        read_mesh(tmp_path / "many.glb")


def test_a_scene_places_its_mesh_and_a_method_sees_it(balls_copy: Path, tmp_path: Path) -> None:
    assert Scene.open(balls_copy).container_mesh() is None
    bowl = bowl_mesh()
    (balls_copy / "truth" / "bowl.ply").write_bytes(
        trimesh.exchange.ply.export_ply(trimesh.Trimesh(bowl.vertices, bowl.faces, process=False))
    )
    pose = np.diag([2.0, 2, 2, 1])
    pose[:3, 3] = 1, 2, 3
    scene = Scene.open(with_mesh(balls_copy, "truth/bowl.ply", pose.tolist()))
    mesh = scene.container_mesh()
    assert mesh is not None
    np.testing.assert_allclose(mesh.vertices.max(axis=0), 2 * bowl.vertices.max(axis=0) + [1, 2, 3], rtol=1e-5)
    shown = make_training_copy(scene, tmp_path / "view")
    assert not (shown / "truth").exists()
    seen = Scene.open(shown).training().container_mesh()
    assert seen is not None
    np.testing.assert_array_equal(seen.vertices, mesh.vertices)


@pytest.mark.parametrize("name", ["../outside.ply", "/etc/outside.ply", "a/../../outside.ply", "mesh.stl", ""])
def test_a_mesh_outside_the_scene_or_of_another_kind_is_refused(balls_copy: Path, name: str) -> None:
    with pytest.raises(SplashbenchError, match=r"scene\.json: container_mesh"):
        Scene.open(with_mesh(balls_copy, name)).container_mesh()


def test_a_missing_mesh_is_named(balls_copy: Path) -> None:
    with pytest.raises(SplashbenchError, match=r"gone\.ply does not exist"):
        Scene.open(with_mesh(balls_copy, "gone.ply")).container_mesh()


@pytest.mark.parametrize(
    ("row", "said"), [([1e308, 0, 0, 1e308], "not finite or beyond"), ([1e12, 0, 0, 0], "beyond 1e[+]09")]
)
def test_a_pose_that_leaves_no_mesh_is_one_line(row: list[float], said: str, balls_copy: Path) -> None:
    (balls_copy / "a.ply").write_text(PLY + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    scene = with_mesh(balls_copy, "a.ply")
    meta = json.loads((scene / "scene.json").read_text())
    meta["container_pose"] = [row, [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    (scene / "scene.json").write_text(json.dumps(meta))
    with pytest.raises(SplashbenchError, match=rf"scene\.json: container_pose leaves vertices .*{said}"):
        Scene.open(scene).container_mesh()


def _glb(path: Path, accessors: list[dict], nodes: int = 1, primitives: int = 1) -> Path:
    """A glTF without any data that states `accessors`, and shows the mesh of the first one."""
    header = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": list(range(nodes))}],
        "nodes": [{"mesh": 0}] * nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}] * primitives}],
        "accessors": accessors,
        "bufferViews": [],
        "buffers": [],
    }
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text)) + struct.pack("<I4s", len(text), b"JSON")
    path.write_bytes(head + text)
    return path


def test_a_few_bytes_that_ask_for_gigabytes_are_held_to_the_limit(tmp_path: Path) -> None:
    accessor = {"count": 400_000_000, "componentType": 5126, "type": "VEC3"}
    path = _glb(tmp_path / "huge.glb", [accessor])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(
        SplashbenchError, match=r"huge\.glb is not a readable mesh \(it needs more than 4 GiB or 60 s\)"
    ):
        read_mesh(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # KiB


def test_a_mesh_that_takes_for_ever_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splashbench.scene.mesh_process._MAX_WAIT_SECONDS", 0.05)  # the child has not started by then
    (path := tmp_path / "slow.ply").write_text(PLY + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    with pytest.raises(SplashbenchError, match=r"slow\.ply is not a readable mesh \(it needs more than"):
        read_mesh(path)


def test_a_mesh_that_is_no_plain_file_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "zero.glb").symlink_to("/dev/zero")
    for name in ("pipe.ply", "zero.glb"):
        with pytest.raises(SplashbenchError, match="is a device or pipe"):
            read_mesh(tmp_path / name)
    monkeypatch.setattr("splashbench.scene.mesh_process.MAX_FILE_BYTES", 1 << 20)
    with (tmp_path / "large.obj").open("wb") as stream:
        stream.truncate(2 << 20)
    with pytest.raises(SplashbenchError, match=r"large\.obj is larger than 1 MiB"):
        read_mesh(tmp_path / "large.obj")

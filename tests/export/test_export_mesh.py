"""Meshes as files, read by trimesh: closed, where the masks show liquid, as fast as it, in the units asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from splashbench.errors import SplashbenchError
from splashbench.export import Manifest, Placement, export_meshes, place
from splashbench.export.mesh_files import PlacedMesh, write_ply_mesh
from splashbench.replay import Reconstruction, load
from splashbench.scene import Camera, Scene, SignedDistance, VelocityField
from splashbench.synth.balls import _RADII, ball_centers

from .conftest import columns, read_points, showing
from .exact_balls import VOXEL, ExactBalls, exact_velocity

#: What trilinear interpolation loses of balls of three to five voxels' radius.
LOST = 0.05


@pytest.fixture(scope="module")
def folder(known: Reconstruction, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("exports") / "mesh"
    export_meshes(known, out)
    return out


def shadow(mesh: trimesh.Trimesh, camera: Camera) -> np.ndarray:
    """The pixels [H, W] whose centres a face of `mesh` covers, as `camera` sees it."""
    uv, depth = camera.project(mesh.vertices)
    assert (depth > 0).all()
    found = np.zeros((camera.height, camera.width), bool)
    for a, b, c in uv[mesh.faces]:
        low = np.maximum(np.floor(np.min([a, b, c], axis=0)).astype(int), 0)
        high = np.ceil(np.max([a, b, c], axis=0)).astype(int) + 1
        y, x = np.mgrid[low[1] : min(high[1], camera.height), low[0] : min(high[0], camera.width)]
        centres = np.stack([x, y], axis=-1) + 0.5
        offsets = [(q - p, centres - p) for p, q in ((a, b), (b, c), (c, a))]
        sides = [edge[0] * arm[..., 1] - edge[1] * arm[..., 0] for edge, arm in offsets]
        found[y, x] |= np.all([s >= 0 for s in sides], axis=0) | np.all([s <= 0 for s in sides], axis=0)
    return found


def test_meshes_are_closed_and_lie_where_the_masks_show_liquid(folder: Path, balls: Scene) -> None:
    low, high = np.array([-0.4, -0.1, -0.4]), np.array([0.4, 0.9, 0.4])
    places = low + (high - low) * (np.indices((80, 100, 80)).reshape(3, -1).T + 0.5) / (80, 100, 80)
    for t in range(1, balls.n_frames):
        # The balls pass through one another.
        distances = [np.linalg.norm(places - c, axis=1) - r for c, r in zip(ball_centers(balls.times[t]), _RADII)]
        volume = (np.min(distances, axis=0) < 0).mean() * np.prod(high - low)
        mesh = trimesh.load(folder / "frames" / f"frame{t + 1:04d}.ply")
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert volume * (1 - LOST) < mesh.volume < volume * 1.01
        for name in ("1", "5", "6"):
            mask = balls.mask(name, t)
            covered = shadow(mesh, balls.cameras[name])
            assert (covered & mask).sum() / (covered | mask).sum() > 0.9


def test_an_instant_without_liquid_is_a_file_of_nothing(folder: Path) -> None:
    head, _, body = (folder / "frames" / "frame0001.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 0\n" in head
    assert b"element face 0\n" in head
    assert body == b""


def test_vertices_have_normals_and_the_liquids_velocity(folder: Path, known: Reconstruction) -> None:
    path = folder / "frames" / "frame0002.ply"
    points, mesh = read_points(path), trimesh.load(path, process=False)
    normals = columns(points, "nx", "ny", "nz")
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert ((normals * mesh.vertex_normals).sum(axis=1) > 0.9).mean() > 0.99
    found = columns(points, "vx", "vy", "vz")
    expected = exact_velocity(mesh.vertices, known.times[1])
    # Half way between two balls the grid's velocity is neither's.
    assert (np.linalg.norm(found - expected, axis=1) < 1e-4).mean() > 0.95


def test_placed_meshes_lie_and_move_where_the_placement_says(known: Reconstruction, tmp_path: Path) -> None:
    export_meshes(known, tmp_path / "scene", known.times[5:6])
    placement = Placement(place(known, up="z").rotation, 10.0, "metres", "z")
    manifest = export_meshes(known, tmp_path / "turned", known.times[5:6], placement)
    assert (manifest.units, manifest.up) == ("metres", "z")
    one, other = (tmp_path / name / "frames" / "frame0001.ply" for name in ("scene", "turned"))
    before, after = read_points(one), read_points(other)
    for names, scale in ((("x", "y", "z"), 10), (("vx", "vy", "vz"), 10), (("nx", "ny", "nz"), 1)):
        x, y, z = columns(before, *names).T
        np.testing.assert_allclose(columns(after, *names), scale * np.stack([x, -z, y], axis=1), atol=1e-5)
    matrix = np.array(manifest.scene_to_export)
    np.testing.assert_allclose(
        columns(before, "x", "y", "z") @ matrix[:3, :3].T + matrix[:3, 3], columns(after, "x", "y", "z"), atol=1e-5
    )
    assert trimesh.load(other).volume == pytest.approx(1000 * trimesh.load(one).volume, rel=1e-3)


def test_obj_is_the_same_mesh(folder: Path, known: Reconstruction, tmp_path: Path) -> None:
    manifest = export_meshes(known, tmp_path / "obj", known.times, mesh_format="obj")
    assert manifest.files[5] == "frames/frame0006.obj"
    assert any("no place for velocities" in note for note in manifest.notes)
    mesh = trimesh.load(tmp_path / "obj" / manifest.files[5], process=False)
    stored = trimesh.load(folder / "frames" / "frame0006.ply", process=False)
    assert trimesh.load(tmp_path / "obj" / manifest.files[5]).is_watertight
    np.testing.assert_allclose(mesh.vertices, stored.vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, stored.faces)
    assert (tmp_path / "obj" / manifest.files[0]).read_text() == "# 0 vertices, 0 triangles\n"


def test_between_timesteps_the_liquid_is_on_its_way(known: Reconstruction, tmp_path: Path) -> None:
    between = known.times[3:5].mean(keepdims=True)
    export_meshes(known, tmp_path / "out", between)
    mesh = trimesh.load(tmp_path / "out" / "frames" / "frame0001.ply")
    expected = ExactBalls(known.times).surface(float(between[0]))
    inside = expected.origin + VOXEL * np.argwhere(expected.phi[0] < -16)
    assert mesh.contains(inside).all()


def test_vertices_far_from_the_origin_stay_apart(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.01)
    far = PlacedMesh(ball.vertices + 5000.0, ball.faces.astype(np.int32), ball.vertex_normals, None, 0.001)
    write_ply_mesh(tmp_path / "far.ply", far)
    assert b"property double x" in (tmp_path / "far.ply").read_bytes()[:200]
    assert trimesh.load(tmp_path / "far.ply").is_watertight
    near = PlacedMesh(ball.vertices, ball.faces.astype(np.int32), ball.vertex_normals, None, 0.001)
    write_ply_mesh(tmp_path / "near.ply", near)
    assert b"property float x" in (tmp_path / "near.ply").read_bytes()[:200]


def test_a_method_without_a_velocity_or_without_a_surface(known: Reconstruction, oracle: Path, tmp_path: Path) -> None:
    class Still(ExactBalls):
        def velocity(self, time: float) -> VelocityField | None:  # type: ignore[override]
            return None

    still = showing(known, Still(known.times))
    manifest = export_meshes(still, tmp_path / "still", known.times[3:4])
    assert any("no velocity" in note for note in manifest.notes)
    assert "vx" not in read_points(tmp_path / "still" / "frames" / "frame0001.ply")

    with pytest.raises(SplashbenchError, match=r"no signed distance: it keeps no model .*; export its particles"):
        export_meshes(load(oracle), tmp_path / "none")
    assert not (tmp_path / "none").exists()

    class Wild(ExactBalls):
        def velocity(self, time: float) -> VelocityField:
            field = super().velocity(time)
            field.values[...] = np.inf
            return field

    with pytest.raises(SplashbenchError, match="velocities of method exact are not finite"):
        export_meshes(showing(known, Wild(known.times)), tmp_path / "wild")


def test_all_frames_of_a_stranger_are_closed(known: Reconstruction, tmp_path: Path) -> None:
    """Distances that no liquid has: clipped everywhere, at the border, exactly 0."""

    class Noise(ExactBalls):
        def surface(self, time: float) -> SignedDistance:
            rng = np.random.default_rng(round(1000 * time))
            steps = rng.choice([-127, -1, 0, 1, 127], (1, 6, 7, 8)).astype(np.int8)
            return SignedDistance(steps, np.array([-0.1, 0.2, -0.1]), 0.03)

        def velocity(self, time: float) -> VelocityField | None:  # type: ignore[override]
            return None

    manifest = export_meshes(showing(known, Noise(known.times)), tmp_path / "out")
    for name in manifest.files:
        assert trimesh.load(tmp_path / "out" / name).is_watertight


@pytest.fixture
def usd(known: Reconstruction, tmp_path: Path) -> tuple[Path, Manifest]:
    pytest.importorskip("pxr", reason="needs usd-core, which the extra [usd] installs")
    placement = place(known, metres=True, up="z")
    manifest = export_meshes(known, tmp_path / "usd", known.times, placement, mesh_format="usd")
    return tmp_path / "usd" / "liquid.usdc", manifest


def test_usd_has_every_instant_with_units_and_velocities(
    usd: tuple[Path, Manifest], folder: Path, known: Reconstruction
) -> None:
    from pxr import Usd, UsdGeom

    path, manifest = usd
    assert manifest.files == ["liquid.usdc"]
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim())
    codes = mesh.GetPointsAttr().GetTimeSamples()
    fps = stage.GetTimeCodesPerSecond()
    np.testing.assert_allclose((np.array(codes) - 1) / fps, known.times - known.times[0], atol=1e-4)
    assert len(mesh.GetPointsAttr().Get(codes[0])) == len(mesh.GetVelocitiesAttr().Get(codes[0])) == 0
    stored = read_points(folder / "frames" / "frame0006.ply")
    x, y, z = columns(stored, "x", "y", "z").T
    np.testing.assert_allclose(mesh.GetPointsAttr().Get(codes[5]), np.stack([x, -z, y], axis=1), atol=1e-6)
    x, y, z = columns(stored, "vx", "vy", "vz").T
    np.testing.assert_allclose(mesh.GetVelocitiesAttr().Get(codes[5]), np.stack([x, -z, y], axis=1), atol=1e-5)
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get(codes[5])).reshape(-1, 3)
    closed = trimesh.Trimesh(np.array(mesh.GetPointsAttr().Get(codes[5])), faces)
    assert closed.is_watertight
    assert closed.volume > 0
    assert set(mesh.GetFaceVertexCountsAttr().Get(codes[5])) == {3}


def test_usd_of_a_method_without_a_velocity_says_none(known: Reconstruction, tmp_path: Path) -> None:
    pxr = pytest.importorskip("pxr.Usd", reason="needs usd-core, which the extra [usd] installs")

    class Still(ExactBalls):
        def velocity(self, time: float) -> VelocityField | None:  # type: ignore[override]
            return None

    export_meshes(showing(known, Still(known.times)), tmp_path / "usd", mesh_format="usd")
    stage = pxr.Stage.Open(str(tmp_path / "usd" / "liquid.usdc"))
    assert not stage.GetDefaultPrim().GetAttribute("velocities").HasAuthoredValue()


def test_a_frame_without_liquid_has_the_columns_of_the_others(folder: Path) -> None:
    heads = [(folder / "frames" / name).read_bytes()[:600] for name in ("frame0001.ply", "frame0006.ply")]
    assert b"element vertex 0\n" in heads[0]
    assert [head.count(b"property float v") for head in heads] == [3, 3]


def test_without_usd_core_one_line_names_the_extra(
    known: Reconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pxr", None)
    with pytest.raises(SplashbenchError, match=r"needs the package usd-core; in a checkout: pip install"):
        export_meshes(known, tmp_path / "out", mesh_format="usd")
    assert list(tmp_path.iterdir()) == []

"""A container is found where it was put: by its masks, in spite of jagged edges, a hand and the image's border, and by
clicked points; what silhouettes cannot tell is said; and a wrong mesh shows in the figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.spatial.transform import Rotation

from splashbench import toml
from splashbench.container.clicked_points import ClickedPoint, place_by_points
from splashbench.container.contours import find_contour
from splashbench.container.placement import Placement, place_by_silhouettes, up_from_container
from splashbench.container.stance import CentredMesh
from splashbench.container.verification import overlay, silhouette, verify
from splashbench.errors import SplashbenchError
from splashbench.prepare.session import Session
from splashbench.scene.camera import Camera, look_at
from splashbench.scene.container import ContainerMesh

Masks = dict[str, np.ndarray]
PLACE = (0.01, 0.003, -0.02)


def rig(width: int = 400, height: int = 600, focal: float = 800.0) -> list[Camera]:
    """Seven cameras over 77 degrees, 0.95 m from the origin and 22 degrees above it."""
    cameras = []
    for k, angle in enumerate(np.deg2rad(np.linspace(-38.5, 38.5, 7))):
        pitch = np.deg2rad(22)
        centre = 0.95 * np.array([np.cos(pitch) * np.sin(angle), np.sin(pitch), np.cos(pitch) * np.cos(angle)])
        K = np.array([[focal, 0, width / 2 + 3], [0, focal, height / 2 - 5], [0, 0, 1]])
        cameras.append(Camera(str(k + 1), width, height, K, look_at(centre)))
    return cameras


def bowl() -> ContainerMesh:
    profile = [[0, 0], [0.04, 0], [0.07, 0.02], [0.1, 0.08], [0.096, 0.08], [0.066, 0.024], [0.038, 0.005], [0, 0.005]]
    body = trimesh.creation.revolve(np.array(profile), sections=64)
    return ContainerMesh(body.vertices[:, [0, 2, 1]] * [1, 1, -1], body.faces)


def mug() -> ContainerMesh:
    """The bowl with a handle."""
    body = bowl()
    handle = trimesh.creation.torus(0.03, 0.005)
    vertices = handle.vertices + np.array([0.1, 0.05, 0])
    return ContainerMesh(
        np.concatenate([body.vertices, vertices]), np.concatenate([body.faces, handle.faces + len(body.vertices)])
    )


def tank() -> ContainerMesh:
    """An open box, 30 x 16 cm and 12 cm high."""
    slabs = [((0.3, 0.006, 0.16), (0, 0.003, 0))]
    for side in (-1, 1):
        slabs.append(((0.006, 0.12, 0.16), (side * 0.147, 0.06, 0)))
        slabs.append(((0.3, 0.12, 0.006), (0, 0.06, side * 0.077)))
    parts = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(place)) for size, place in slabs]
    whole = trimesh.util.concatenate(parts)
    return ContainerMesh(whole.vertices, whole.faces)


def pose(yaw: float, tilt: tuple[float, float] = (0.0, 0.0), scale: float = 1.0) -> np.ndarray:
    """Mesh to scene: tilted by degrees about x and z, then turned by `yaw` degrees about y, at PLACE."""
    matrix = np.eye(4)
    tilted = Rotation.from_rotvec(np.deg2rad([tilt[0], 0, tilt[1]]))
    matrix[:3, :3] = scale * (Rotation.from_euler("y", yaw, degrees=True) * tilted).as_matrix()
    matrix[:3, 3] = PLACE
    return matrix


def exact_masks(mesh: ContainerMesh, truth: np.ndarray, cameras: list[Camera]) -> Masks:
    return {camera.name: silhouette(mesh, truth, camera) for camera in cameras}


def drawn_masks(mesh: ContainerMesh, truth: np.ndarray, cameras: list[Camera]) -> Masks:
    """Masks with an edge that jumps by a pixel, and a hand over 15% of the container in camera 3."""
    rng = np.random.default_rng(0)
    found = {}
    for name, mask in exact_masks(mesh, truth, cameras).items():
        edge = binary_dilation(mask) ^ binary_erosion(mask)
        found[name] = mask ^ (edge & (rng.random(mask.shape) < 0.4))
    rows, columns = np.nonzero(found["3"])
    far = np.hypot(rows - np.quantile(rows, 0.05), columns - np.quantile(columns, 0.8))
    hand = np.argsort(far)[: int(0.15 * len(rows))]
    found["3"][rows[hand], columns[hand]] = False
    return found


def errors(mesh: ContainerMesh, found: np.ndarray, truth: np.ndarray) -> tuple[float, float, float]:
    """Metres between the centres, degrees between the rotations, and degrees between the vertical axes."""
    middle = np.append((mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2, 1.0)
    a, b = (matrix[:3, :3] / np.cbrt(np.linalg.det(matrix[:3, :3])) for matrix in (found, truth))
    turn = Rotation.from_matrix(a @ b.T).magnitude()
    tilt = np.arccos(np.clip(a[:, 1] @ b[:, 1], -1, 1))
    return float(np.linalg.norm(((found - truth) @ middle)[:3])), float(np.rad2deg(turn)), float(np.rad2deg(tilt))


def require_overlap(mesh: ContainerMesh, found: Placement, truth: np.ndarray, cameras: list[Camera]) -> None:
    """Also in cameras that took no part."""
    figures = verify(mesh, found.pose, cameras, exact_masks(mesh, truth, cameras))
    assert len(figures) == len(cameras)
    assert min(figure.iou for figure in figures.values()) >= 0.97
    assert max(figure.contour_rms_px or 0.0 for figure in figures.values()) < 0.5


def test_a_bowl_is_found_and_its_free_turn_is_said() -> None:
    mesh, truth, cameras = bowl(), pose(75, tilt=(1.0, 2.0)), rig()
    found = place_by_silhouettes(mesh, cameras[:5], drawn_masks(mesh, truth, cameras), up="y")
    distance, _, tilt = errors(mesh, found.pose, truth)
    assert distance < 1e-3
    assert tilt < 0.3
    assert (found.turn, found.equivalent_turns) == ("free", 0)
    assert found.cameras == ("1", "2", "3", "4", "5")
    # Turned by rule: as the mesh came, but for its tilt.
    assert Rotation.from_matrix(found.pose[:3, :3]).magnitude() < np.deg2rad(3)
    assert found.position_sigma is not None
    assert 1e-6 < found.position_sigma < 1e-3
    require_overlap(mesh, found, truth, cameras)
    np.testing.assert_allclose(up_from_container(found), truth[:3, 1], atol=5e-3)


def test_a_tank_is_found_but_for_half_a_turn() -> None:
    mesh, truth, cameras = tank(), pose(33), rig()
    found = place_by_silhouettes(mesh, cameras[:5], drawn_masks(mesh, truth, cameras), up="y")
    distance, turn, _ = errors(mesh, found.pose, truth)
    assert distance < 1e-3
    assert turn < 0.3  # of the two, the turn that is nearer to none
    assert (found.turn, found.equivalent_turns) == ("repeats", 2)
    require_overlap(mesh, found, truth, cameras)
    # The view with the hand agrees less with its mask, and no other.
    assert found.projections["3"].iou < 0.9
    assert min(figure.iou for name, figure in found.projections.items() if name != "3") > 0.97


def test_a_handle_tells_the_turn_and_a_cut_mask_does_no_harm() -> None:
    mesh, truth, cameras = mug(), pose(-70, tilt=(0.5, -1.0), scale=1.3), rig()
    # Camera 4's image ends amid the container.
    cameras[3] = cameras[3].cropped(0, 0, 215, 600)
    masks = drawn_masks(mesh, truth, cameras)
    assert masks["4"][:, -1].any()
    # In another unit, of unknown scale, and begun 8 cm off and turned by 100 degrees.
    centimetres = ContainerMesh(100 * mesh.vertices, mesh.faces)
    wrong = pose(30, scale=0.01) + np.array([[0, 0, 0, 0.05], [0, 0, 0, 0.02], [0, 0, 0, -0.06], [0, 0, 0, 0]])
    found = place_by_silhouettes(centimetres, cameras, masks, up="y", metres_per_unit=None, initial=wrong)
    assert found.scale == pytest.approx(0.013, rel=2e-3)
    in_metres = found.pose @ np.diag([100.0, 100.0, 100.0, 1.0])
    distance, turn, _ = errors(mesh, in_metres, truth)
    assert distance < 1e-3
    assert turn < 0.3
    assert (found.turn, found.equivalent_turns) == ("determined", 1)
    require_overlap(mesh, replace(found, pose=in_metres), truth, cameras)


def test_a_start_decides_what_silhouettes_leave_open() -> None:
    mesh, truth, cameras = tank(), pose(33), rig()
    masks = exact_masks(mesh, truth, cameras)
    found = place_by_silhouettes(mesh, cameras[:3], masks, up="y", initial=pose(200))
    distance, turn, _ = errors(mesh, found.pose, pose(213))
    assert distance < 1e-3
    assert turn < 0.3


@pytest.mark.slow
def test_neither_gravity_nor_the_upper_side_need_be_known() -> None:
    mesh, cameras = mug(), rig()
    lying = ContainerMesh(mesh.vertices[:, [0, 2, 1]] * [1, -1, 1], mesh.faces)  # +z up
    truth = pose(40, tilt=(2.0, 3.0))
    found = place_by_silhouettes(lying, cameras, drawn_masks(mesh, truth, cameras), gravity=None)
    assert found.up_axis == "z"
    assert not found.up_is_ambiguous
    degrees = np.rad2deg(np.arccos(np.clip(np.array(up_from_container(found)) @ truth[:3, 1], -1, 1)))
    assert degrees < 0.3


def test_a_closed_box_may_stand_on_its_head_and_that_is_reported() -> None:
    box = trimesh.creation.box((0.3, 0.12, 0.16))
    mesh, cameras = ContainerMesh(box.vertices, box.faces), rig(200, 300, 400.0)[:3]
    found = place_by_silhouettes(mesh, cameras, exact_masks(mesh, pose(20), cameras))
    assert found.up_is_ambiguous
    assert found.up_axis == "y"


def test_a_wrong_mesh_shows_in_the_figures() -> None:
    cameras = rig()
    masks = exact_masks(tank(), pose(33), cameras)
    # Even the scale that suits it best does not make a bowl a tank.
    found = place_by_silhouettes(bowl(), cameras[::3], masks, up="y", metres_per_unit=None)
    assert np.median([figure.iou for figure in found.projections.values()]) < 0.9
    assert found.cost_px is not None
    assert found.cost_px > 4


def no_mask(masks: Masks) -> None:
    masks["2"][:] = False


def full_mask(masks: Masks) -> None:
    masks["2"][:] = True


def small_mask(masks: Masks) -> None:
    masks["2"] = masks["2"][:-1]


def one_mask(masks: Masks) -> None:
    del masks["2"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (no_mask, "the mask of camera 2 is empty; draw it"),
        (full_mask, "the mask of camera 2 has no outline"),
        (small_mask, "the mask of camera 2 is 400x599, its images are 400x600"),
        (one_mask, "1 of the cameras to fit has a mask, two are needed"),
    ],
)
def test_unusable_masks_are_one_line(change: Callable[[Masks], None], message: str) -> None:
    cameras = rig()[:2]
    masks = exact_masks(tank(), pose(0), cameras)
    change(masks)
    with pytest.raises(SplashbenchError, match=message) as caught:
        place_by_silhouettes(tank(), cameras, masks, source="session/container_masks")
    assert str(caught.value).startswith("session/container_masks: ")
    assert "\n" not in str(caught.value)


CORNERS = np.array([[x, y, z] for x in (-0.15, 0.15) for y in (0, 0.12) for z in (-0.08, 0.08)])


def clicks(truth: np.ndarray, cameras: list[Camera], corners: np.ndarray = CORNERS) -> list[ClickedPoint]:
    """The corners of the tank, clicked to about half a pixel."""
    rng = np.random.default_rng(1)
    placed = corners @ truth[:3, :3].T + truth[:3, 3]
    return [
        ClickedPoint(
            tuple(corner.tolist()),
            {camera.name: tuple(camera.project(place[None])[0][0] + rng.normal(0, 0.5, 2)) for camera in cameras},
        )
        for corner, place in zip(corners, placed)
    ]


@pytest.mark.parametrize("scale", [1.0, None])
def test_clicked_points_place_the_container(scale: float | None) -> None:
    mesh, truth, cameras = tank(), pose(213, tilt=(1.0, 0.0)), rig()
    clicked = clicks(truth, cameras[:5])
    # One on the wrong corner, which must show and not matter.
    clicked[0].pixels["2"] = clicked[1].pixels["2"]
    masks = exact_masks(mesh, truth, cameras)
    found = place_by_points(mesh, cameras, clicked, metres_per_unit=scale, masks=masks)
    distance, turn, _ = errors(mesh, found.pose, truth)
    assert distance < 1e-3
    assert turn < 0.3
    assert found.scale == pytest.approx(1, rel=5e-3)
    assert found.point_rms_px is not None
    assert found.point_rms_px["2"] > 5
    assert max(rms for name, rms in found.point_rms_px.items() if name != "2") < 1.5
    assert found.projections["5"].iou > 0.97
    # Where to begin with the masks.
    finer = place_by_silhouettes(mesh, cameras[::3], masks, up="y", initial=found.pose)
    assert errors(mesh, finer.pose, truth)[1] < 0.3


def test_clicked_points_take_what_is_up_from_gravity() -> None:
    """Most scans have z up, and clicks say nothing of it."""
    truth, cameras = pose(213), rig()
    clicked = clicks(truth, cameras[:5])
    lying = Rotation.from_euler("x", 90, degrees=True).as_matrix()  # z of the file is what y was
    vertices = tank().vertices @ lying.T
    turned = [replace(click, point=tuple((lying @ click.point).tolist())) for click in clicked]
    mesh = replace(tank(), vertices=vertices)
    found = place_by_points(mesh, cameras, turned, gravity=(0.0, -1.0, 0.0))
    assert found.up_axis == "z"
    assert found.up[1] > 0.999
    assert place_by_points(mesh, cameras, turned, up="y", gravity=(0.0, -1.0, 0.0)).up_axis == "y"
    assert place_by_points(mesh, cameras, turned).up_axis == "y"


def test_four_points_in_one_camera_do_with_the_scale_known() -> None:
    truth, cameras = pose(20), rig()
    found = place_by_points(tank(), cameras, clicks(truth, cameras[:1]), metres_per_unit=1.0)
    distance, turn, _ = errors(tank(), found.pose, truth)
    assert distance < 5e-3
    assert turn < 0.5
    with pytest.raises(SplashbenchError, match="click the same points in more cameras"):
        place_by_points(tank(), cameras, clicks(truth, cameras[:1]), metres_per_unit=None)


def test_too_few_points_are_one_line() -> None:
    cameras = rig()
    with pytest.raises(SplashbenchError, match="toml: 2 points are seen by cameras to fit, three are needed"):
        place_by_points(tank(), cameras, clicks(pose(0), cameras, CORNERS[:2]), source="session.toml")
    with pytest.raises(SplashbenchError, match="all points lie on a line"):
        place_by_points(tank(), cameras, clicks(pose(0), cameras, np.linspace(CORNERS[0], CORNERS[7], 5)))


def test_a_jagged_outline_is_found_without_bias() -> None:
    rows, columns = np.mgrid[0:200, 0:300] + 0.5
    disc = np.hypot(columns - 140.3, rows - 90.8) < 60.25
    edge = binary_dilation(disc) ^ binary_erosion(disc)
    for mask, spread in ((disc, 0.3), (disc ^ (edge & (np.random.default_rng(0).random(disc.shape) < 0.4)), 0.8)):
        contour = find_contour(mask)
        offset = contour.points - [140.3, 90.8]
        radius = np.linalg.norm(offset, axis=1)
        assert abs(radius.mean() - 60.25) < 0.1
        assert radius.std() < spread
        assert np.median(np.einsum("ij,ij->i", contour.normals, offset) / radius) > 0.8
    assert not len(find_contour(np.ones((50, 60), bool)).points)
    # The border of the image is not an edge of the object.
    assert find_contour(columns < 100).points[:, 0] == pytest.approx(100)
    assert find_contour(columns < 100).points[:, 1].min() >= 2


def test_the_overlay_shows_both_outlines() -> None:
    camera, truth = rig()[0], pose(10)
    mask = np.roll(silhouette(tank(), truth, camera), 30, axis=1)
    picture = overlay(tank(), truth, camera, mask, np.full((600, 400, 3), 100, np.uint8), width=200)
    assert picture.shape == (300, 200, 3)
    assert picture.dtype == np.uint8
    for colour in ((255, 176, 0), (0, 190, 255)):
        assert (np.abs(picture.astype(int) - colour).max(axis=-1) < 10).sum() > 100
    assert (picture[0, 0] == 60).all()


def session_with(directory: Path, container: dict[str, Any], **more: Any) -> Path:
    for name in ("1.MP4", "2.MP4", "bowl.ply"):
        (directory / name).touch()
    (directory / "outlines").mkdir()
    data = {
        "schema_version": 1,
        "name": "pour",
        "cameras": ["1", "2"],
        "train": ["1"],
        "test": ["2"],
        "recordings": {"pour": {"1": ["1.MP4"], "2": ["2.MP4"]}},
        "container": container,
    }
    (directory / "session.toml").write_text(toml.dumps(data | more))
    return directory


def test_a_session_names_its_container(tmp_path: Path) -> None:
    session = Session.open(session_with(tmp_path, {"mesh": "bowl.ply", "masks": "outlines", "up": "z"}))
    assert session.container is not None
    assert session.container.scale == 1.0
    assert session.container_mesh == tmp_path / "bowl.ply"
    assert session.container_folder == tmp_path / "outlines"


def test_container_masks_may_stand_under_masks(tmp_path: Path) -> None:
    container = {"mesh": "bowl.ply", "metres_per_unit": "unknown", "transparent": True}
    session = Session.open(session_with(tmp_path, container, masks={"container_folder": "outlines"}))
    assert session.container is not None
    assert session.container.scale is None
    assert session.container_folder == tmp_path / "outlines"


POINT = {"point": [0.0, 0.1, 0.2], "pixels": {"1": [10.0, 20.0]}}


@pytest.mark.parametrize(
    ("container", "message"),
    [
        ({"mesh": "bowl.ply"}, "needs what places its mesh; give masks"),
        ({"mesh": "bowl.stl", "masks": "outlines"}, r"convert it to one of \.ply"),
        ({"mesh": "../bowl.ply", "masks": "outlines"}, "lies outside the session"),
        ({"mesh": "tank.ply", "masks": "outlines"}, r"tank\.ply \(the container's mesh\) does not exist"),
        ({"mesh": "bowl.ply", "masks": "nowhere"}, r"nowhere \(the folder of container masks\) does not exist"),
        ({"mesh": "bowl.ply", "masks": "outlines", "metres_per_unit": 0.0}, "metres_per_unit"),
        ({"mesh": "bowl.ply", "masks": "outlines", "up": "w"}, "up"),
        ({"mesh": "bowl.ply", "points": [POINT]}, "has 1 points, three are needed"),
        ({"mesh": "bowl.ply", "points": [POINT, POINT, POINT | {"pixels": {"9": [1.0, 2.0]}}]}, "name camera 9"),
    ],
)
def test_faults_of_the_description_are_one_line(tmp_path: Path, container: dict[str, Any], message: str) -> None:
    with pytest.raises(SplashbenchError, match=message) as caught:
        Session.open(session_with(tmp_path, container))
    assert "\n" not in str(caught.value)


def test_an_outline_along_the_border_alone_is_none() -> None:
    column = np.zeros((60, 80), bool)
    column[:, 0] = True
    full_but_one_row = np.ones((60, 80), bool)
    full_but_one_row[-1] = False
    for mask in (column, full_but_one_row):
        assert find_contour(mask).points.shape == (0, 2)


def test_a_mesh_without_area_is_one_line() -> None:
    line = ContainerMesh(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]]))
    with pytest.raises(SplashbenchError, match="has no area"):
        CentredMesh.of(line)

"""What is rendered lies where the lens says, and frames without liquid are the room itself."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("embreex")

from splashbench.synth.imaging import rendering
from splashbench.synth.imaging.geometry import LOOK_AT, Mesh, Quad, arc_point, bowl_mesh, look_at, revolve
from splashbench.synth.imaging.lens import LensCamera, distort, undistort
from splashbench.synth.imaging.rendering import RoomView, TracedRoom
from splashbench.synth.imaging.room import CaptureRoom

DISTORTION = np.array([-0.13, 0.04, 5e-4, -6e-4, 0.0])


@pytest.fixture(scope="module")
def camera() -> LensCamera:
    K = np.array([[470.0, 0, 158.0], [0, 471.0, 93.0], [0, 0, 1]])
    return LensCamera(320, 180, K, DISTORTION, look_at(arc_point(0.3), LOOK_AT, 1.0))


@pytest.fixture(scope="module")
def room() -> TracedRoom:
    grey = np.full((8, 8, 3), 0.4, np.float32)
    table = Quad(np.array([-2.0, 0, -2]), np.array([4.0, 0, 0]), np.array([0, 0, 4.0]), grey)
    bowl = bowl_mesh()
    return TracedRoom(CaptureRoom([table], bowl, np.full((len(bowl.vertices), 3), 0.6, np.float32)))


@pytest.fixture(scope="module")
def view(room: TracedRoom, camera: LensCamera) -> RoomView:
    return RoomView(room, camera)


def ball(centre: np.ndarray, radius: float) -> Mesh:
    angle = np.linspace(0, np.pi, 24)
    profile = np.stack([radius * np.sin(angle), radius * np.cos(angle)], axis=1)
    mesh = revolve(profile, 48)
    return Mesh((mesh.vertices + centre).astype(np.float32), mesh.faces, mesh.normals)


def test_undistort_inverts_distort() -> None:
    points = np.random.default_rng(0).uniform(-0.45, 0.45, (200, 2))
    assert np.allclose(undistort(distort(points, DISTORTION), DISTORTION), points, atol=1e-9)


def test_projection_agrees_with_opencv(camera: LensCamera) -> None:
    import cv2

    points = np.random.default_rng(1).uniform(-0.15, 0.15, (50, 3))
    K = camera.K.copy()
    K[:2, 2] -= 0.5  # OpenCV's pixel centres are whole numbers
    rotation, _ = cv2.Rodrigues(camera.w2c[:3, :3])
    expected, _ = cv2.projectPoints(points, rotation, camera.w2c[:3, 3], K, DISTORTION)
    assert np.allclose(camera.project(points)[0], expected.reshape(-1, 2) + 0.5, atol=1e-6)


@pytest.mark.parametrize("centre", [(-0.22, 0.22, -0.1), (0.24, 0.05, 0.1), (0.0, 0.2, 0.0)])
def test_a_ball_is_seen_where_the_distorted_lens_projects_it(
    view: RoomView, camera: LensCamera, centre: tuple[float, float, float]
) -> None:
    place = np.array(centre)
    mask = view.with_liquid(ball(place, 0.006)).mask
    rows, columns = np.nonzero(mask)
    seen = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
    assert seen == pytest.approx(camera.project(place[None])[0][0], abs=0.25)
    depth = camera.project(place[None])[1][0]
    assert mask.sum() == pytest.approx(np.pi * (0.006 * 470 / depth) ** 2, rel=0.25)


def test_the_lens_matters_away_from_the_centre(view: RoomView, camera: LensCamera) -> None:
    """The test above could not tell a pinhole from a lens if the two agreed."""
    place = np.array([[-0.22, 0.22, -0.1]])
    pinhole = LensCamera(camera.width, camera.height, camera.K, np.zeros(5), camera.w2c)
    assert np.linalg.norm(pinhole.project(place)[0] - camera.project(place)[0]) > 1.0


def test_liquid_behind_the_bowl_is_not_in_the_mask(view: RoomView, camera: LensCamera) -> None:
    behind = np.array([0.0, 0.03, 0.0]) - 0.15 * (camera.center - LOOK_AT) * np.array([1, 0, 1])
    assert not view.with_liquid(ball(behind, 0.004)).mask.any()
    assert view.with_liquid(ball(behind + np.array([0, 0.2, 0]), 0.004)).mask.any()


def test_only_the_liquid_and_its_shadow_change_the_image(view: RoomView, camera: LensCamera) -> None:
    frame = view.with_liquid(ball(np.array([-0.2, 0.15, 0.0]), 0.01))
    changed = np.abs(frame.image - view.image).max(axis=2) > 0
    assert (changed | ~frame.mask).all(), "every liquid pixel differs from the room"
    shadow = changed & ~frame.mask
    assert 0 < shadow.sum() < 4 * frame.mask.sum()
    assert (frame.image[shadow] <= 1).all()
    assert view.with_liquid(None).image is view.image


def test_the_container_mask_covers_the_bowl_and_nothing_else(view: RoomView, camera: LensCamera) -> None:
    uv, _ = camera.project(bowl_mesh().vertices.astype(np.float64))
    rows, columns = np.nonzero(view.container_mask)
    assert columns.min() == pytest.approx(uv[:, 0].min(), abs=1)
    assert columns.max() + 1 == pytest.approx(uv[:, 0].max(), abs=1)
    assert rows.min() == pytest.approx(uv[:, 1].min(), abs=1)
    assert rows.max() + 1 == pytest.approx(uv[:, 1].max(), abs=1)


def test_what_is_left_out_for_shadows_changes_no_pixel(view: RoomView, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only what may lie in the liquid's shadow is asked whether it does."""
    drops = [ball(np.array(place), 0.01) for place in ((-0.2, 0.15, 0.0), (0.0, 0.12, 0.05), (0.1, 0.3, 0.0))]
    asked: list[float] = []
    chosen = rendering._may_lie_in_shadow

    def noted(*of: np.ndarray) -> np.ndarray:
        found = chosen(*of)
        asked.append(found.mean())
        return found

    monkeypatch.setattr(rendering, "_may_lie_in_shadow", noted)
    few = [view.with_liquid(drop) for drop in drops]
    assert 0 < max(asked) < 0.5
    monkeypatch.setattr(rendering, "_may_lie_in_shadow", lambda vertices, points, light: np.ones(len(points), bool))
    for frame, drop in zip(few, drops):
        whole = view.with_liquid(drop)
        np.testing.assert_array_equal(frame.image, whole.image)
        np.testing.assert_array_equal(frame.mask, whole.mask)

"""The upright vessel that fills container masks: bowls and tanks are found without a scan, anything else is refused."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from splashbench.container.mask_vessel import MaskedVessel, vessel_from_masks
from splashbench.container.verification import silhouette
from splashbench.observe.container import depth_image
from splashbench.scene.camera import Camera, look_at
from splashbench.scene.container import ContainerMesh

Masks = dict[str, np.ndarray]
UP = np.array([0.0, 1.0, 0.0])
HEIGHT = 0.08


def rig(count: int = 6, arc: float = 77.0, pitch: float = 25.0) -> list[Camera]:
    """Cameras 0.95 m from the origin, over `arc` degrees."""
    cameras = []
    for k, angle in enumerate(np.deg2rad(np.linspace(-arc / 2, arc / 2, count))):
        up = np.deg2rad(pitch)
        eye = 0.95 * np.array([np.cos(up) * np.sin(angle), np.sin(up), np.cos(up) * np.cos(angle)])
        K = np.array([[500.0, 0, 163], [0, 500, 115], [0, 0, 1]])
        cameras.append(Camera(str(k), 320, 240, K, look_at(eye)))
    return cameras


def bowl() -> ContainerMesh:
    """20 cm wide and 8 cm high, with a wall of 4 mm."""
    profile = [[0, 0], [0.04, 0], [0.07, 0.02], [0.1, HEIGHT], [0.096, HEIGHT], [0.066, 0.024], [0.038, 0.005]]
    body = trimesh.creation.revolve(np.array([*profile, [0, 0.005]]), sections=64)
    return ContainerMesh(body.vertices[:, [0, 2, 1]] * [1, 1, -1] + [0.01, 0, -0.02], body.faces)


def tank() -> ContainerMesh:
    """A box of 24 x 14 cm, 10 cm high and turned by 20 degrees: its outside is all that masks show."""
    body = trimesh.creation.box((0.24, 0.1, 0.14))
    body.apply_transform(trimesh.transformations.rotation_matrix(np.deg2rad(20), UP))
    return ContainerMesh(body.vertices + np.array([0, 0.05, 0]), body.faces)


def mug() -> ContainerMesh:
    """The bowl with a handle."""
    handle = trimesh.creation.torus(0.03, 0.008)
    vertices = handle.vertices + np.array([0.12, 0.05, 0])
    body = bowl()
    return ContainerMesh(
        np.concatenate([body.vertices, vertices]), np.concatenate([body.faces, handle.faces + len(body.vertices)])
    )


def masks_of(mesh: ContainerMesh, cameras: list[Camera]) -> Masks:
    return {camera.name: silhouette(mesh, np.eye(4), camera) for camera in cameras}


def found(mesh: ContainerMesh, cameras: list[Camera]) -> MaskedVessel:
    vessel = vessel_from_masks(cameras, masks_of(mesh, cameras))
    assert vessel is not None
    return vessel


def tilt(vessel: MaskedVessel) -> float:
    return float(np.rad2deg(np.arccos(np.clip(vessel.up @ UP, -1, 1))))


@pytest.mark.parametrize("arc", [77.0, 300.0])
def test_a_bowl_is_found_from_a_few_masks_and_hides_what_the_bowl_hides(arc: float) -> None:
    cameras = rig(arc=arc)
    vessel = found(bowl(), cameras[:-1])
    assert vessel.trusted
    assert tilt(vessel) < 1.5
    heights = vessel.mesh.vertices @ UP
    assert heights.max() == pytest.approx(HEIGHT, abs=0.004)
    assert heights.min() == pytest.approx(0, abs=0.006)
    # Seen by a camera that took no part: where the true bowl shows its outside, the vessel is as far.
    held_out = cameras[-1]
    true, depth = depth_image(bowl(), held_out), depth_image(vessel.mesh, held_out)
    both = np.isfinite(true) & np.isfinite(depth)
    assert both.sum() > 0.97 * (np.isfinite(true) | np.isfinite(depth)).sum()
    rows = np.nonzero(both.any(axis=1))[0]
    front = both.copy()
    front[: int(0.6 * rows[0] + 0.4 * rows[-1])] = False  # below the opening
    assert np.median(np.abs(true[front] - depth[front])) < 0.003


def test_the_opening_stays_open() -> None:
    """A point in the bowl is seen from above through it, and hidden from a camera by the near wall."""
    vessel = found(bowl(), rig())
    above = Camera("above", 200, 200, np.array([[300.0, 0, 100], [0, 300, 100], [0, 0, 1]]), look_at((0.02, 0.9, 0.02)))
    depth = depth_image(vessel.mesh, above)
    uv, distance = above.project(np.array([[0.01, 0.02, -0.02]]))
    assert distance[0] < depth[int(uv[0, 1]), int(uv[0, 0])]
    low = rig(3, pitch=8)[1]
    uv, distance = low.project(np.array([[0.01, 0.02, -0.02]]))
    assert distance[0] > depth_image(vessel.mesh, low)[int(uv[0, 1]), int(uv[0, 0])]


def test_a_tank_is_found_as_a_box() -> None:
    vessel = found(tank(), rig())
    assert vessel.trusted
    assert tilt(vessel) < 3
    # No circle has its extents.
    vertices = vessel.mesh.vertices - vessel.mesh.vertices.mean(axis=0)
    spread = np.linalg.svd(vertices - np.outer(vertices @ vessel.up, vessel.up), compute_uv=False)
    assert spread[0] / spread[1] > 1.3


def test_a_direction_that_is_known_helps_cameras_that_are_held_askew() -> None:
    turned = []
    for camera in rig():
        roll = np.deg2rad(70)
        matrix = np.eye(4)
        matrix[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
        turned.append(Camera(camera.name, camera.width, camera.height, camera.K, matrix @ camera.w2c))
    vessel = vessel_from_masks(turned, masks_of(bowl(), turned), [UP])
    assert vessel is not None
    assert vessel.trusted
    assert tilt(vessel) < 2


def test_a_vessel_with_a_handle_is_refused() -> None:
    assert not found(mug(), rig()).trusted


def test_masks_that_do_not_belong_together_are_refused() -> None:
    cameras = rig()
    masks = masks_of(bowl(), cameras)
    masks["2"] = np.roll(masks["2"], 40, axis=1)
    vessel = vessel_from_masks(cameras, masks)
    assert vessel is None or not vessel.trusted
    for name in masks:
        masks[name] = np.zeros((240, 320), bool)
        masks[name][100:110, 300 if int(name) % 2 else 5] = True
    vessel = vessel_from_masks(cameras, masks)
    assert vessel is None or not vessel.trusted


def test_cameras_that_hang_upside_down_do_not_turn_the_vessel_over() -> None:
    cameras = [Camera(c.name, c.width, c.height, c.K, np.diag([-1.0, -1, 1, 1]) @ c.w2c) for c in rig()]
    vessel = found(bowl(), cameras)
    assert vessel.trusted
    assert tilt(vessel) < 1.5


def test_cameras_in_one_place_tell_nothing() -> None:
    first = rig()[0]
    cameras = [Camera(str(k), first.width, first.height, first.K, first.w2c) for k in range(4)]
    assert vessel_from_masks(cameras, masks_of(bowl(), cameras)) is None
    assert vessel_from_masks(rig()[:2], masks_of(bowl(), rig()[:2])) is None


def test_masks_of_dots_tell_nothing() -> None:
    dots = np.zeros((240, 320), bool)
    dots[::12, ::12] = True
    assert vessel_from_masks(rig(), {camera.name: dots for camera in rig()}) is None


def test_masks_that_say_nothing_are_left_out() -> None:
    cameras = rig()
    masks = masks_of(bowl(), cameras)
    for name in ("0", "1", "2"):
        masks[name] = np.full((240, 320), name == "0")
    del masks["3"], masks["4"]
    assert vessel_from_masks(cameras, masks) is None
    assert vessel_from_masks(cameras, {}) is None

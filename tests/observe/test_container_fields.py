"""Containers: their depth, their walls, and carving around what they hide. The answers are known in closed form."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
import pytest
import trimesh

from splashbench.errors import SplashbenchError
from splashbench.observe import (
    Bounds,
    ContainerOcclusion,
    Grid,
    Silhouettes,
    hull,
    sequence_bounds,
    signed_distance_fields,
)
from splashbench.observe.carving import carve_view
from splashbench.observe.container import depth_image, hidden, hidden_share, solid_distance
from splashbench.observe.kernels import fill_blocks
from splashbench.observe.occlusion import CarvingOcclusion
from splashbench.scene import Camera, ContainerMesh, look_at

RADIUS = 0.25


def mesh_of(shape: trimesh.Trimesh) -> ContainerMesh:
    return ContainerMesh(shape.vertices, shape.faces)


def box(low: tuple, high: tuple) -> ContainerMesh:
    return mesh_of(trimesh.creation.box(bounds=(low, high)))


def nodes(grid: Grid) -> np.ndarray:
    return grid.to_scene(np.moveaxis(np.indices(grid.shape), 0, -1))


def camera_at(name: str, eye: np.ndarray) -> Camera:
    """A 240x200 camera at `eye` that looks at the origin with y up."""
    return Camera(name, 240, 200, np.array([[400.0, 0, 120], [0, 400, 100], [0, 0, 1]]), look_at(eye))


class BallBehindAWall:
    """A ball of radius 0.25 about the origin and five cameras; a wall hides its lower half from the three on +x."""

    name = "ball_behind_a_wall"
    n_frames = 1
    WALL = ((0.5, -1.0, -1.0), (0.55, 0.0, 1.0))

    def __init__(self) -> None:
        eyes = [(2.5, 0.3, -0.9), (2.6, 0.5, 0.0), (2.5, 0.3, 0.9), (0.3, 1.6, -2.0), (0.0, 0.4, 2.5)]
        self.cameras = {str(i): camera_at(str(i), np.array(eye)) for i, eye in enumerate(eyes)}
        self.train = tuple(self.cameras)

    def mask(self, camera: str, t: int) -> np.ndarray:
        """Exact: a pixel is liquid where the ray through its centre meets the ball, and the wall not before it."""
        view = self.cameras[camera]
        rows, columns = np.mgrid[: view.height, : view.width] + 0.5
        rays = np.stack([(columns - 120) / 400, (rows - 100) / 400, np.ones_like(rows)], axis=-1) @ view.w2c[:3, :3]
        low, high = ((np.array(corner) - view.center) / rays for corner in self.WALL)
        enter, leave = np.minimum(low, high).max(axis=-1), np.maximum(low, high).min(axis=-1)
        square, middle = (rays**2).sum(axis=-1), rays @ view.center
        root = middle**2 - square * (view.center @ view.center - RADIUS**2)
        to_ball = (-middle - np.sqrt(np.maximum(root, 0))) / square
        return (root > 0) & ((leave < enter) | (enter > to_ball))


@pytest.fixture(scope="module")
def wall() -> ContainerOcclusion:
    return ContainerOcclusion(box(*BallBehindAWall.WALL))


def test_the_depth_of_a_plane_is_exact_in_every_pixel() -> None:
    camera = camera_at("a", np.array([0.5, 1.0, -3.0]))
    depth = depth_image(box((-9, -9, 0), (9, 9, 9)), camera)  # its front face is the plane z = 0
    rows, columns = np.mgrid[:200, :240] + 0.5
    rays = np.stack([(columns - 120) / 400, (rows - 100) / 400, np.ones_like(rows)], axis=-1) @ camera.w2c[:3, :3]
    np.testing.assert_allclose(depth, 3.0 / rays[..., 2], rtol=1e-6)


def test_a_mesh_around_the_camera_is_cut_at_the_near_plane_and_seen_from_inside() -> None:
    camera = camera_at("a", np.array([0.0, 0.0, -3.0]))
    depth = depth_image(box((-9, -9, -9), (9, 9, 4)), camera)
    np.testing.assert_allclose(depth, 7.0, rtol=1e-6)
    behind = depth_image(box((-1, -1, -9), (1, 1, -5)), camera)
    assert behind.shape == (200, 240)
    assert np.isinf(behind).all()


def test_the_distance_to_a_box_is_that_of_its_formula() -> None:
    low, high = np.array([-0.5, -0.3, -0.2]), np.array([0.5, 0.3, 0.2])
    grid = Grid.over(Bounds(np.full(3, -1.0), np.full(3, 1.0)), 50)
    distance = solid_distance(box(tuple(low), tuple(high)), grid)
    beyond = np.abs(nodes(grid)) - high
    true = np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0)
    true = np.clip(true / grid.voxel, -20, 20)
    assert distance.dtype == np.float32
    near = np.abs(true) < 3.99
    np.testing.assert_allclose(distance[near], true[near], atol=1e-4)
    np.testing.assert_allclose(distance, true, atol=2)
    assert np.abs(distance - true).mean() < 0.2


def test_the_space_inside_a_bowl_is_free_and_its_wall_is_not() -> None:
    inner, outer = trimesh.creation.icosphere(4, 0.8), trimesh.creation.icosphere(4, 1.0)
    shell = trimesh.util.concatenate([outer, trimesh.Trimesh(inner.vertices, inner.faces[:, ::-1])])
    grid = Grid.over(Bounds(np.full(3, -1.2), np.full(3, 1.2)), 48)
    radius = np.linalg.norm(nodes(grid), axis=-1)
    clear = np.minimum(np.abs(radius - 0.8), np.abs(radius - 1.0)) > 0.01  # the spheres are polyhedra
    walls = solid_distance(mesh_of(shell), grid) < 0
    np.testing.assert_array_equal(walls[clear], ((radius > 0.8) & (radius < 1.0))[clear])
    # Whichever way the faces are turned.
    odd = np.arange(len(shell.faces))[:, None] % 2
    turned = ContainerMesh(shell.vertices, np.where(odd, shell.faces, shell.faces[:, ::-1]))
    np.testing.assert_array_equal((solid_distance(turned, grid) < 0)[clear], walls[clear])


def test_parts_that_overlap_are_solid_where_they_do() -> None:
    sizes = [((-0.7, -0.3, -0.3), (0.3, 0.3, 0.3)), ((-0.2, -0.2, -0.2), (0.8, 0.2, 0.2))]
    two = trimesh.util.concatenate([trimesh.creation.box(bounds=bounds) for bounds in sizes])
    grid = Grid.over(Bounds(np.full(3, -1.0), np.full(3, 1.0)), 20)
    distance = solid_distance(mesh_of(two), grid)
    assert distance[10, 10, 10] < 0
    assert distance[1, 1, 1] > 0


def test_an_open_mesh_has_no_inside() -> None:
    shape = trimesh.creation.box()
    grid = Grid.over(Bounds(np.full(3, -1.0), np.full(3, 1.0)), 16)
    assert (solid_distance(ContainerMesh(shape.vertices, shape.faces[1:]), grid) >= 0).all()


def test_points_behind_the_wall_are_hidden(wall: ContainerOcclusion) -> None:
    camera = BallBehindAWall().cameras["1"]
    depth = depth_image(wall.mesh, camera)
    points = np.array([[0, -0.2, 0], [0, 0.2, 0], [0.7, -0.2, 0], [0.5, -0.2, 0], [0, -9, 0], [5.0, 0, 0]])
    assert hidden(points, depth, camera, 0.06).tolist() == [True, False, False, False, False, False]


def test_near_an_outline_a_point_is_hidden_by_as_much_of_its_pixel_as_the_wall_covers() -> None:
    camera = BallBehindAWall().cameras["4"]
    depth = np.full((200, 240), np.inf, np.float32)
    depth[:, :100] = 1.0  # a wall up to column 100

    def at(u: float, v: float, z: float) -> list[float]:
        ray = np.linalg.inv(camera.K) @ [u, v, 1.0]
        return (camera.w2c[:3, :3].T @ (z * ray) + camera.center).tolist()

    columns = [90.0, 99.5, 99.75, 100.0, 100.25, 100.5, 150.0]
    shares = hidden_share(np.array([at(u, 80.3, 2.0) for u in columns]), depth, camera, 0.1)
    np.testing.assert_allclose(shares, [1, 1, 0.75, 0.5, 0.25, 0, 0], atol=1e-4)
    # In front of the wall, within its tolerance, behind the camera, beside the image, in its corner pixels.
    places = [(50, 80, 0.5), (50, 80, 1.05), (50, 80, -2.0), (-3, 80, 2.0), (0.1, 0.1, 2.0), (0.1, 199.9, 2.0)]
    others = [at(*place) for place in places]
    assert hidden_share(np.array(others), depth, camera, 0.1).tolist() == [0, 0, 0, 0, 1, 1]


def recall_and_excess(scene: BallBehindAWall, container: ContainerOcclusion | None) -> tuple[float, float]:
    """Share of the ball that the hull holds, and volume of the hull beside the ball in volumes of the ball."""
    fields = signed_distance_fields(scene, 48, container=container)
    grid = Grid.over(Bounds(np.full(3, -0.4), np.full(3, 0.4)), 60)
    points = nodes(grid).reshape(-1, 3)
    inside = np.linalg.norm(points, axis=-1) < RADIUS
    liquid = fields.sample(0, points) < 0
    return liquid[inside].mean(), (liquid & ~inside).sum() / inside.sum()


def test_what_the_wall_hides_is_not_carved_away(wall: ContainerOcclusion) -> None:
    scene = BallBehindAWall()
    blind, _ = recall_and_excess(scene, None)
    aware, excess = recall_and_excess(scene, wall)
    assert blind < 0.75
    assert aware > 0.98
    assert excess < 0.6  # the two views that see the lower half bound it from two sides only
    # Through glass every view sees the ball, so its masks would be evidence again.
    glass, _ = recall_and_excess(scene, ContainerOcclusion(wall.mesh, hides=False))
    assert glass == pytest.approx(blind, abs=0.02)


def test_phi_runs_smoothly_over_the_edge_of_the_shadow(wall: ContainerOcclusion) -> None:
    fields = signed_distance_fields(BallBehindAWall(), 64, container=wall)
    inside = np.linalg.norm(nodes(fields.grid), axis=-1) < 0.6 * RADIUS
    phi = fields.phi[0]
    # Without the union the rim of the wall, as each view sees it, would be a surface through the ball's middle.
    assert phi[inside].max() < -0.2 * RADIUS / fields.voxel


def test_nothing_is_liquid_in_a_wall_or_below_the_foot() -> None:
    scene = BallBehindAWall()
    plate = ContainerOcclusion(box((-1, -0.1, -1), (1, 0.0, 1)), np.array([0.0, -1.0, 0.0]), hides=False)
    fields = signed_distance_fields(scene, 48, container=plate)
    y = nodes(fields.grid)[..., 1]
    assert (fields.phi[0][y < -1e-6] > 0).all()
    assert (fields.phi[0] < 0).any()
    floor = ContainerOcclusion(box((-1, 0.1, -1), (1, 0.2, 1)), np.array([0.0, -1.0, 0.0]), hides=False)
    assert sequence_bounds(scene, floor).low[1] == pytest.approx(0.1, abs=0.01)


def test_droplets_thinner_than_a_voxel_lie_on_the_floor() -> None:
    down = np.array([0.0, -1.0, 0.0])
    grid = Grid.over(Bounds(np.full(3, -0.3), np.full(3, 0.3)), 24)
    y = nodes(grid)[..., 1]
    # Not where nodes are, and some voxels away from them.
    floor = 0.11
    for hides, lowest in ((True, floor - grid.voxel), (False, floor)):
        plate = ContainerOcclusion(box((0.9, floor, 0.9), (1, 0.2, 1)), down, hides)
        forbidden = plate.forbidden(grid)
        near = np.abs(y - lowest) < 4 * grid.voxel
        assert forbidden[near] == pytest.approx((lowest - y[near]) / grid.voxel, abs=1e-4)


def test_walls_that_are_moved_leave_the_floor_to_droplets() -> None:
    scene, down = BallBehindAWall(), np.array([0.0, -1.0, 0.0])
    plate = ContainerOcclusion(box((-1, 0.1, -1), (1, 0.2, 1)), down, hides=False)
    grid = Grid.over(Bounds(np.full(3, -0.3), np.full(3, 0.3)), 24)
    lifted, lowered = (plate.with_mesh(box((-1, y, -1), (1, y + 0.1, 1))) for y in (0.15, 0.02))
    assert lifted.floor == pytest.approx(-0.1)
    assert lowered.floor == pytest.approx(-0.02)
    assert lifted.with_mesh(lowered.mesh).floor == pytest.approx(-0.02)
    y = nodes(grid)[..., 1]
    for moved, low in ((lifted, 0.1), (lowered, 0.02)):
        assert (moved.forbidden(grid)[y < low - 1e-6] > 0).all()
    assert (lifted.forbidden(grid)[(y > 0.1 + 1e-6) & (y < 0.15 - 1e-6)] <= 0).all()
    without = ContainerOcclusion(plate.mesh).with_mesh(box((-1, 0.15, -1), (1, 0.25, 1)))
    assert without.floor is None
    assert sequence_bounds(scene, lifted).low[1] == pytest.approx(0.1, abs=0.01)


def test_a_container_that_is_above_all_liquid_is_named() -> None:
    above = ContainerOcclusion(box((-1, 2, -1), (1, 2.2, 1)), np.array([0.0, -1.0, 0.0]), hides=False)
    with pytest.raises(SplashbenchError, match="that the container is at the liquid"):
        sequence_bounds(BallBehindAWall(), above)


def test_a_view_must_see_a_point_and_two_where_asked_for() -> None:
    scene = BallBehindAWall()
    grid = Grid.over(Bounds(np.full(3, -0.3), np.full(3, 0.3)), 24)

    def seen(*walls: tuple, witnesses: Literal[1, 2] = 1) -> bool:
        shape = trimesh.util.concatenate([trimesh.creation.box(bounds=wall) for wall in walls])
        outside = CarvingOcclusion(ContainerOcclusion(mesh_of(shape)), Silhouettes(scene), grid, witnesses).outside
        assert (outside > 0).all() or (outside < 0).all()
        return bool((outside < 0).all())

    right, front, back = ((0.5, -2, -2), (0.55, 2, 2)), ((-2, -2, -0.55), (2, 2, -0.5)), ((-2, -2, 0.5), (2, 2, 0.55))
    assert seen(right, witnesses=2)  # from cameras 3 and 4
    assert seen(right, front)  # from camera 4 alone
    assert not seen(right, front, witnesses=2)
    assert not seen(right, front, back)


def test_carving_around_a_container_does_not_depend_on_threads(wall: ContainerOcclusion, monkeypatch) -> None:
    from splashbench import parallel

    shared = signed_distance_fields(BallBehindAWall(), 40, container=wall)
    monkeypatch.setattr(parallel, "thread_count", lambda: 1)
    np.testing.assert_array_equal(signed_distance_fields(BallBehindAWall(), 40, container=wall).phi, shared.phi)


@pytest.mark.parametrize("occluded", [False, True])
def test_blocks_that_are_far_outside_are_told_from_their_middles(
    wall: ContainerOcclusion, monkeypatch: pytest.MonkeyPatch, occluded: bool
) -> None:
    # Small beside its grid, which is not of whole blocks, and with a wall thinner than one.
    silhouettes = Silhouettes(BallBehindAWall())
    grid = Grid.over(Bounds(np.full(3, -1.1), np.array([1.1, 0.9, 1.0])), 90)
    carving = CarvingOcclusion(wall, silhouettes, grid) if occluded else None
    filled = []
    monkeypatch.setattr(hull, "fill_blocks", lambda *given: (filled.append(given[1].mean()), fill_blocks(*given)))
    told, blocks = [], hull._blocks
    monkeypatch.setattr(hull, "_blocks", lambda *given: (told.append(blocks(*given)), told[-1])[1])
    by_blocks = hull.carve_frame(silhouettes, grid, 0, carving)
    ((far, wanted),) = told
    # Of what is not far, no view is asked everywhere, and each somewhere.
    assert all(0.02 < of_view[~far].mean() < 0.98 for of_view in wanted)
    assert 0.2 < filled[0] < (by_blocks == 20).mean() < 1
    monkeypatch.setattr(hull, "_WORTH_BLOCKS", 1000)
    np.testing.assert_array_equal(hull.carve_frame(silhouettes, grid, 0, carving), by_blocks)
    assert len(filled) == 1


class AnyMasks:
    """Cameras around the origin, near and far, wide and narrow, with blots for masks."""

    name = "any_masks"
    n_frames = 1

    def __init__(self, rng: np.random.Generator) -> None:
        self.cameras, self._masks = {}, {}
        for name in "abcd":
            eye = rng.normal(size=3)
            eye *= rng.uniform(1.3, 4.0) / np.linalg.norm(eye)
            focal = rng.uniform(60, 400)
            intrinsics = np.array([[focal, 0, rng.uniform(20, 140)], [0, focal * rng.uniform(0.7, 1.4), 60], [0, 0, 1]])
            self.cameras[name] = Camera(name, 160, 120, intrinsics, look_at(eye))
            blots = cv2.GaussianBlur(rng.normal(size=(120, 160)), (0, 0), rng.uniform(2, 12))
            self._masks[name] = blots > np.quantile(blots, rng.uniform(0.1, 0.8))
        self.train = tuple(self.cameras)

    def mask(self, camera: str, t: int) -> np.ndarray:
        return self._masks[camera]


@pytest.mark.parametrize("seed", range(12))
def test_blocks_change_nothing_whatever_masks_and_cameras_are(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(seed)
    silhouettes = Silhouettes(AnyMasks(rng))
    assert any(silhouettes.cut_off)
    low = rng.uniform(-1.0, -0.4, 3)
    grid = Grid.over(Bounds(low, low + rng.uniform(0.9, 1.4, 3)), int(rng.integers(70, 120)))
    corners = np.sort(rng.uniform(-0.9, 0.9, (2, 3)), axis=0)
    container = ContainerOcclusion(box(*map(tuple, corners))) if seed % 3 else None
    carving = CarvingOcclusion.of(container, silhouettes, grid)
    monkeypatch.setattr(hull, "_WORTH_BLOCKS", 1)
    by_blocks = hull.carve_frame(silhouettes, grid, 0, carving)
    monkeypatch.setattr(hull, "_WORTH_BLOCKS", 1000)
    np.testing.assert_array_equal(hull.carve_frame(silhouettes, grid, 0, carving), by_blocks)


def test_points_in_the_plane_of_a_camera_and_behind_it_are_outside() -> None:
    camera = Camera("a", 20, 20, np.array([[100.0, 0, 10], [0, 100, 10], [0, 0, 1]]), np.eye(4))
    phi = np.full((21, 21, 21), -20, np.float32)
    liquid = np.full((20, 20), -3, np.float32)
    carve_view(phi, np.array([-1.0, -1.0, -1.0]), 0.1, camera.projection, 100.0, liquid, np.zeros(2), 20.0)
    np.testing.assert_array_equal(phi[:, :, :11], 20)
    assert phi[10, 10, 12] == pytest.approx(-3 * 0.2 / (100 * 0.1))


def test_a_container_out_of_sight_changes_nothing() -> None:
    far = ContainerOcclusion(box((50, 50, 50), (51, 51, 51)))
    scene = BallBehindAWall()
    np.testing.assert_array_equal(
        signed_distance_fields(scene, 24, container=far).phi, signed_distance_fields(scene, 24).phi
    )

"""What gravity says: motion in a jet, the level of a pool, where carriers land, and what a view can see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splashbench.observe import Silhouettes, sequence_bounds
from splashbench.observe.container import depth_image
from splashbench.observe.grid import Bounds, Grid
from splashbench.observe.hull import carve_frame
from splashbench.observe.occlusion import CarvingOcclusion, ContainerOcclusion
from splashbench.scene.camera import Camera, look_at
from splashbench.scene.container import ContainerMesh
from splashbench_methods.splashsplat.carriers.visibility import seen_by_any
from splashbench_methods.splashsplat.fields.gravity_cues import GravityCues, falling_jets, gravity_cues
from splashbench_methods.splashsplat.fields.jet import Jet
from splashbench_methods.splashsplat.fields.pool import LiquidPool
from splashbench_methods.splashsplat.fields.vessel import Vessel, upright
from splashbench_methods.splashsplat.motion.fall import JetFall, falls_of, table_of
from splashbench_methods.splashsplat.motion.gate import gated
from splashbench_methods.splashsplat.motion.steps import FrameStep, Motion
from splashbench_methods.splashsplat.motion.velocity import control_shape, velocity_at

DOWN = np.array([0.0, -1.0, 0.0])
G = 9.81
VOXEL = 0.005


def looking_at(name: str, eye: np.ndarray, target: np.ndarray, size: tuple[int, int] = (160, 120)) -> Camera:
    """A pinhole camera at `eye` looking at `target`, y of the world up."""
    K = np.array([[1.2 * size[0], 0, size[0] / 2], [0, 1.2 * size[0], size[1] / 2], [0, 0, 1.0]])
    return Camera(name, *size, K, look_at(eye, target))


def rig(target: np.ndarray, distance: float = 1.0, elevation: float = 30.0) -> dict[str, Camera]:
    """Five cameras on an arc of 80 degrees, as the paper's."""
    cameras = {}
    for number, turn in enumerate(np.radians([-40, -20, 0, 20, 40])):
        up = np.radians(elevation)
        offset = np.array([np.sin(turn) * np.cos(up), np.sin(up), np.cos(turn) * np.cos(up)])
        cameras[str(number)] = looking_at(str(number), target + distance * offset, target)
    return cameras


def open_box(inner: tuple[float, float, float], wall: float) -> ContainerMesh:
    """A closed mesh: a box of `inner` width, height and depth with an open top, its floor's upper side at y = 0."""
    w, h, d = inner[0] / 2, inner[1], inner[2] / 2
    outer = [(sx * (w + wall), y, sz * (d + wall)) for y in (-wall, h) for sx in (-1, 1) for sz in (-1, 1)]
    inside = [(sx * w, y, sz * d) for y in (0, h) for sx in (-1, 1) for sz in (-1, 1)]
    quads = [(0, 1, 3, 2), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]  # the outside, without the top
    quads += [(8, 10, 11, 9), (8, 9, 13, 12), (10, 14, 15, 11), (8, 12, 14, 10), (9, 11, 15, 13)]  # the inside
    quads += [(4, 12, 13, 5), (6, 7, 15, 14), (4, 6, 14, 12), (5, 13, 15, 7)]  # the rim
    faces = [triangle for a, b, c, e in quads for triangle in ((a, b, c), (a, c, e))]
    return ContainerMesh(np.array(outer + inside), np.array(faces))


# Motion


GRID = Grid(np.array([-0.1, 0.0, -0.1]), VOXEL, (40, 64, 40))
JET = Jet(0.3, np.array([0.0, 0.0]), np.array([0.2, -0.1]), 1.0, G, 0.01)
FALL = JetFall(JET, 0.1, upright(DOWN), GRID, 0.033)
FOURS = (4.0, 4.0, 4.0)
SIDEWAYS = np.broadcast_to(np.float32([1, 0, 0]), (*control_shape(GRID.shape, 4), 3))


def in_the_jet(heights: np.ndarray, aside: float = 0.0) -> np.ndarray:
    """Grid coordinates [N, 3] at `heights`, so far (scene units) beside the jet's middle."""
    points = np.concatenate([JET.axis(heights) + np.array([aside, 0]), heights[:, None]], axis=1)
    return GRID.to_voxels(points @ upright(DOWN)).astype(np.float32)


def eyes(count: int) -> np.ndarray:
    return np.broadcast_to(np.eye(3, dtype=np.float32), (count, 3, 3))


def test_what_is_in_the_jet_falls_and_what_is_beside_it_follows_the_fit():
    heights = np.array([0.15, 0.2, 0.25])
    step = FrameStep(SIDEWAYS, 4, FALL)
    found = step.velocity(in_the_jet(heights)) * VOXEL / 0.033
    np.testing.assert_allclose(found, JET.velocity(heights) @ upright(DOWN), rtol=1e-5)
    for elsewhere in (in_the_jet(heights, aside=0.011 + VOXEL), in_the_jet(np.array([0.05, 0.09]))):
        np.testing.assert_array_equal(step.velocity(elsewhere), np.broadcast_to([1.0, 0, 0], elsewhere.shape))
        moved, F = step.forecast(elsewhere, eyes(len(elsewhere)))
        np.testing.assert_allclose(moved, elsewhere + np.array([1, 0, 0]), atol=1e-5)
        np.testing.assert_allclose(F, eyes(len(elsewhere)), atol=1e-6)


def test_carriers_in_the_jet_fly_on_their_parabola_and_stretch():
    start = in_the_jet(np.array([0.26]))
    moved, F = FrameStep(SIDEWAYS, 4, FALL).forecast(start, eyes(1))
    rise = np.array([0.0, 0.0, 1.0]) @ upright(DOWN)
    way = JET.velocity(np.array([0.26])) @ upright(DOWN) * 0.033 - 0.5 * G * 0.033**2 * rise
    np.testing.assert_allclose(moved, start + way / VOXEL, atol=1e-4)
    # It is still in the middle of the jet, and has the speed that the jet has there.
    height = (GRID.to_scene(moved) @ upright(DOWN).T)[:, 2]
    np.testing.assert_allclose(moved, in_the_jet(height), atol=1e-3)
    # Two carriers on top of each other part as F says: speeds grow downwards.
    tip = 1e-2 * rise / VOXEL
    apart = (FrameStep(SIDEWAYS, 4, FALL).forecast(start + tip.astype(np.float32), eyes(1))[0] - moved) / 1e-2 * VOXEL
    np.testing.assert_allclose(F[0] @ rise, apart[0], atol=0.02)
    assert F[0] @ rise @ rise > 1.05
    # One that lands within the first half of the step is left to the fit.
    low = in_the_jet(np.array([0.1 + 0.4 * 0.033 * 1.0]))
    np.testing.assert_allclose(
        FrameStep(SIDEWAYS, 4, FALL).forecast(low, eyes(1))[0], low + np.array([1, 0, 0]), atol=1e-5
    )
    # Halves of a step, forwards or backwards, make whole ones.
    half = FrameStep(SIDEWAYS, 4, FALL).forecast(*FrameStep(SIDEWAYS, 4, FALL).forecast(start, eyes(1), 0.5), 0.5)[0]
    np.testing.assert_allclose(half, moved, atol=1e-3)
    back = FrameStep(SIDEWAYS, 4, FALL).forecast(moved, eyes(1), -1.0)[0]
    np.testing.assert_allclose(back, start, atol=1e-3)
    # Nor do places depend on whether F is asked for.
    both = np.concatenate([start, low, in_the_jet(np.array([0.2]), aside=0.05)])
    step = FrameStep(SIDEWAYS, 4, FALL)
    np.testing.assert_array_equal(step.moved(both, 0.7), step.forecast(both, eyes(3), 0.7)[0])


def test_motion_is_read_as_it_was_written():
    motion = Motion(np.stack([SIDEWAYS, SIDEWAYS]), 4, [None, FALL])
    again = falls_of(*table_of(motion.falls), GRID, np.array([0.0, 0.1, 0.133]))
    assert again[0] is None
    assert again[1] is not None
    points = in_the_jet(np.array([0.15, 0.25]))
    np.testing.assert_allclose(again[1].velocity(points), FALL.velocity(points), rtol=1e-12)
    np.testing.assert_array_equal(again[1].holds(points), [True, True])
    with pytest.raises(ValueError, match="jets of shape"):
        falls_of(*table_of(motion.falls), GRID, np.array([0.0, 0.1]))
    rows, turn = table_of(motion.falls)
    rows[1, 6] = 0
    with pytest.raises(ValueError, match="gravity"):
        falls_of(rows, turn, GRID, np.array([0.0, 0.1, 0.133]))


def test_a_fit_that_leads_nowhere_is_dropped_and_one_that_leads_home_is_kept():
    nodes = np.stack(np.meshgrid(*[np.arange(40.0)] * 3, indexing="ij"), -1)

    def ball(x: float) -> np.ndarray:
        return (np.linalg.norm(nodes - [x, 20, 20], axis=-1) - 8).astype(np.float32)

    right = np.zeros((10, 10, 10, 3), np.float32)
    right[..., 0] = 3
    kept = gated(right, 4, ball(17), ball(20))
    assert velocity_at(kept, FOURS, 24.0, 20.0, 20.0)[0] == pytest.approx(3)
    assert np.abs(velocity_at(gated(right, 4, ball(17), ball(17)), FOURS, 17.0, 20.0, 20.0)).max() == 0
    # A slow surface gains next to nothing by its own motion, and keeps it.
    slow = 0.02 * right
    assert velocity_at(gated(slow, 4, ball(17), ball(17.06)), FOURS, 20.0, 20.0, 20.0)[0] == pytest.approx(0.06)


def test_motion_that_takes_arriving_liquid_away_from_where_it_was_is_dropped():
    x = np.broadcast_to(np.arange(40.0)[:, None, None], (40, 40, 40)).astype(np.float32)
    left = np.zeros((10, 10, 10, 3), np.float32)
    left[..., 0] = -8
    # Liquid up to x = 8, then up to 16. What is liquid now stays inside when it moves left. What arrives at 16 would
    # have come from 24, farther outside than 16 itself.
    gated_motion = gated(left, 4, x - 8, x - 16)
    assert np.abs(velocity_at(gated_motion, FOURS, 15.0, 20.0, 20.0)).max() == 0
    assert np.abs(velocity_at(gated_motion, FOURS, 36.0, 20.0, 20.0)).max() == 0  # no liquid tells anything there


# The pool


class PouredBox:
    """A box of liquid in an open box, seen by five cameras; what `Silhouettes` needs of a scene."""

    def __init__(self, level: float, opaque: bool = True, floating: bool = False, cut: bool = False) -> None:
        self.name, self.n_frames, self.train = "box", 2, ("0", "1", "2", "3", "4")
        self.mesh = open_box((0.2, 0.12, 0.16), 0.008)
        self.cameras = rig(np.array([0.0, 0.05, 0.0]))
        if cut:  # of the middle camera's images half is left
            whole = self.cameras["2"]
            self.cameras["2"] = whole.cropped(0, 0, whole.width // 2, whole.height)
        axes = np.meshgrid(np.linspace(-0.1, 0.1, 160), np.linspace(0, level, 60), np.linspace(-0.08, 0.08, 130))
        self.points = np.stack(axes, -1).reshape(-1, 3)
        self.opaque = opaque
        self.masks = {name: self._mask(camera) for name, camera in self.cameras.items()}
        if floating:
            self.masks["2"][0:6, 0:6] = True

    def _mask(self, camera: Camera) -> np.ndarray:
        pixels, depth = camera.project(self.points)
        column, row = np.floor(pixels).astype(int).T
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        if self.opaque:
            shadow = depth_image(self.mesh, camera)
            inside[inside] = depth[inside] <= shadow[row[inside], column[inside]] + 1e-3
        mask = np.zeros((camera.height, camera.width), bool)
        mask[row[inside], column[inside]] = True
        return mask

    def mask(self, camera: str, t: int) -> np.ndarray:
        return self.masks[camera]


@pytest.fixture(scope="module")
def poured() -> PouredBox:
    return PouredBox(0.06)


@pytest.mark.parametrize("opaque", [True, False])
def test_the_level_is_where_the_masks_end_on_the_wall(opaque):
    scene = PouredBox(0.05, opaque)
    vessel = Vessel.of(scene.mesh, DOWN)
    assert vessel.rim == pytest.approx(0.12, abs=0.01)
    levels = LiquidPool(vessel, Silhouettes(scene), opaque).levels()
    np.testing.assert_allclose(levels, 0.05, atol=0.005)


def test_gravity_may_point_anywhere(poured):
    turn = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
    mesh = ContainerMesh(poured.mesh.vertices @ turn.T, poured.mesh.faces)
    straight, turned = Vessel.of(poured.mesh, DOWN), Vessel.of(mesh, turn @ DOWN)
    volumes = [vessel.inside.sum() * vessel.grid.voxel**3 for vessel in (straight, turned)]
    assert volumes[0] == pytest.approx(0.2 * 0.12 * 0.16, rel=0.12)
    assert volumes[1] == pytest.approx(volumes[0], rel=0.03)


def test_a_plate_is_no_vessel():
    corners = np.array([(x, y, z) for x in (-0.1, 0.1) for y in (0, 0.01) for z in (-0.1, 0.1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    flat = ContainerMesh(corners, np.array([t for a, b, c, e in quads for t in ((a, b, c), (a, c, e))]))
    assert Vessel.of(flat, DOWN) is None


@pytest.mark.parametrize("cut", [False, True])
def test_the_dome_over_a_pool_goes_and_the_pool_is_full(cut):
    poured = PouredBox(0.06, cut=cut)
    silhouettes = Silhouettes(poured)
    assert (silhouettes.cut_off[2] is not None) == cut
    container = ContainerOcclusion(poured.mesh, DOWN)
    grid = Grid.over(sequence_bounds(silhouettes, container).padded(0.1), 56)
    phi = carve_frame(silhouettes, grid, 0, CarvingOcclusion.of(None, silhouettes, grid))
    depths = [depth_image(poured.mesh, camera) for camera in silhouettes.cameras]
    settled = LiquidPool(Vessel.of(poured.mesh, DOWN), silhouettes, True).lowered(phi.copy(), grid, 0.06, depths)
    points = grid.nodes()
    truth = (np.abs(points[..., 0]) < 0.1) & (np.abs(points[..., 2]) < 0.08) & (points[..., 1] > 0)
    truth &= points[..., 1] < 0.06

    def overlap(field: np.ndarray) -> float:
        return float(((field < 0) & truth).sum() / ((field < 0) | truth).sum())

    assert overlap(phi) < 0.5
    assert overlap(settled) > 0.85
    floating = points[..., 1] > 0.06 + 2 * grid.voxel
    # A mask's outermost pixels are wider than the pool; little more may stay.
    assert (settled[floating] < 0).sum() < 0.15 * (phi[floating] < 0).sum()


def test_what_falls_into_the_pool_is_kept(poured):
    silhouettes = Silhouettes(poured)
    grid = Grid.over(Bounds(np.array([-0.12, -0.02, -0.1]), np.array([0.12, 0.2, 0.1])), 48)
    jet = Jet(0.2, np.zeros(2), np.zeros(2), 1.0, G, 0.02)
    phi = np.full(grid.shape, -5, np.float32)
    pool = LiquidPool(Vessel.of(poured.mesh, DOWN), silhouettes, True)
    depths = [depth_image(poured.mesh, camera) for camera in silhouettes.cameras]
    low, kept = pool.lowered(phi.copy(), grid, 0.06, depths), pool.lowered(phi.copy(), grid, 0.06, depths, jet)
    node = tuple(np.round(grid.to_voxels(np.array([0.0, 0.09, 0.0]))).astype(int))
    assert low[node] > 0 > kept[node]


# Landing


def test_carriers_land_on_the_pool_and_on_the_walls(poured):
    silhouettes = Silhouettes(poured)
    container = ContainerOcclusion(poured.mesh, DOWN)
    bounds = sequence_bounds(silhouettes, container).padded(0.1)
    depths = [depth_image(poured.mesh, camera) for camera in silhouettes.cameras]
    falling = falling_jets(silhouettes, silhouettes, bounds, container, DOWN, None, np.arange(2.0))
    assert falling.jets == [None, None]
    assert not falling.scaled
    known = gravity_cues(silhouettes, container, DOWN, depths, falling=falling)
    grid = Grid.over(Bounds(np.full(3, -0.2), np.full(3, 0.2)), 80)
    start = grid.to_voxels(np.array([[0, 0.15, 0], [0, 0.03, 0], [0, 0.15, 0], [0, 0.15, 0]]))
    end = grid.to_voxels(np.array([[0.01, -0.05, 0], [0, 0.02, 0], [0.15, 0.07, 0], [0.15, 0.15, 0]]))
    rest = grid.to_scene(known.landed(grid, 1, start, end))
    assert rest[0, 1] == pytest.approx(known.levels[1], abs=1e-4)
    np.testing.assert_allclose(rest[1], [0, 0.02, 0], atol=1e-6)
    assert 0.09 < rest[2, 0] < 0.102  # it met the wall's inner side on its way
    np.testing.assert_allclose(rest[3], [0.15, 0.15, 0], atol=1e-6)


# Visibility


def test_a_camera_sees_its_own_side_of_the_liquid_only():
    grid = Grid(np.full(3, -1.0), 0.05, (41, 41, 41))
    phi = ((np.linalg.norm(grid.nodes(), axis=-1) - 0.6) / 0.05).astype(np.float32)
    camera = looking_at("0", np.array([0, 0, 4.0]), np.zeros(3))
    points = grid.to_voxels(np.array([[0, 0, 0.55], [0, 0, -0.55], [0.3, 0, 0.45], [0, 0, 0.0]]))
    assert seen_by_any(phi, grid, points, [camera], [None], 3).tolist() == [True, False, True, False]
    behind = looking_at("1", np.array([0, 0, -4.0]), np.zeros(3))
    assert seen_by_any(phi, grid, points, [camera, behind], [None, None], 3).tolist() == [True, True, True, False]
    wall = np.full((camera.height, camera.width), 2.0, np.float32)
    assert not seen_by_any(phi, grid, points, [camera], [wall], 3).any()


def test_a_jet_flies_down_to_the_pool_or_to_where_it_was_found():
    levels = np.array([0.2, np.nan, 0.1, np.nan])
    cues = GravityCues(np.eye(3), [None] * 4, 0.3, None, levels, [])
    # It fills up: where its level is not seen, it is no higher than when it is seen next.
    assert [cues.jet_floor(t) for t in range(4)] == [0.2, 0.1, 0.1, 0.3]


def test_a_jet_flies_down_to_the_wall_where_no_pool_is_seen(poured):
    pool = LiquidPool(Vessel.of(poured.mesh, DOWN), Silhouettes(poured), True)
    middle, outside = np.zeros(2), np.array([0.3, 0.0])
    jets = [Jet(0.3, middle, np.zeros(2), 1.0, G, 0.01), None, Jet(0.3, outside, np.zeros(2), 1.0, G, 0.01)]
    cues = GravityCues(np.eye(3), jets, 0.16, pool, np.full(3, np.nan), [])
    assert cues.jet_floor(0) == pytest.approx(0, abs=1.5 * pool.vessel.grid.voxel)  # the box's own floor
    assert cues.jet_floor(1) == 0.16
    assert cues.jet_floor(2) == pytest.approx(pool.vessel.rim)  # it does not come in
    # What drifts meets the side wall before the floor; it is .08 away along the first upright axis.
    lands = pool.vessel.foot(lambda heights: np.stack([0.12 - heights, 0 * heights], axis=1))
    assert lands == pytest.approx(0.04, abs=2 * pool.vessel.grid.voxel)


def test_in_words_a_jet_says_whence_gravity_is_known():
    jet = Jet(0.3, np.zeros(2), np.zeros(2), 1.2, 9.0, 0.01)
    told = GravityCues(np.eye(3), [None, jet], 0.3, None, np.full(2, np.nan), [])
    assert told.fall() == "passes height 0.3 at 1.2 scene units/s; gravity 9 scene units/s^2, of the scene"
    found = replace(told, scaled=False)
    assert found.fall().endswith("by how its first drop and its last fall")
    assert replace(told, jets=[None, None]).fall() is None

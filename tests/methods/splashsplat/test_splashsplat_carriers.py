"""The carriers' life: where they are born, what they outlive, and what a mask without liquid gives them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from splashbench.observe.grid import Grid
from splashbench.observe.image_window import ImageWindow
from splashbench.observe.silhouettes import Silhouettes
from splashbench.scene import Camera, look_at
from splashbench_methods.splashsplat.carriers.coverage import COVERED, uncovered, uncovered_by_any
from splashbench_methods.splashsplat.carriers.population import Carriers
from splashbench_methods.splashsplat.carriers.resampling import (
    ShellSettings,
    cell_of,
    newborns,
    target_population,
    within_capacity,
)
from splashbench_methods.splashsplat.carriers.tracking import CarrierSettings, CarrierTracker, Tracking
from splashbench_methods.splashsplat.motion.steps import FrameStep, Motion
from splashbench_methods.splashsplat.motion.velocity import control_shape

SIZE = 40
NODES = np.stack(np.meshgrid(*[np.arange(SIZE)] * 3, indexing="ij"), axis=-1).astype(np.float32)
FACTOR = 4


def ball(centre: tuple[float, float, float], radius: float = 8.0) -> np.ndarray:
    """Signed distance to a ball, in voxels."""
    return (np.linalg.norm(NODES - np.array(centre, dtype=np.float32), axis=-1) - radius).astype(np.float32)


def control_of(field) -> np.ndarray:
    """Control values [10, 10, 10, 3] of field(x) with x [..., 3] in transport voxels."""
    shape = control_shape((SIZE,) * 3, FACTOR)
    index = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), axis=-1)
    return np.ascontiguousarray(field(index * FACTOR + (FACTOR - 1) / 2), dtype=np.float32)


GRID = Grid(np.zeros(3), 1.0, (SIZE,) * 3)
SHELL = ShellSettings(depth=1.5, min_per_cell=2, max_per_cell=2)


def track(fields, velocities=None, keep_deformation: bool = True, **settings) -> Carriers:
    """Run the loop with hull grid = transport grid."""
    pairs = len(fields) - 1
    if velocities is None:
        velocities = np.zeros((pairs, *control_shape((SIZE,) * 3, FACTOR), 3), dtype=np.float32)
    motion = Motion(velocities, FACTOR, [None] * pairs)
    kept = {"keep_deformation": keep_deformation}
    tracker = CarrierTracker(Tracking(GRID, GRID, CarrierSettings(shell=SHELL, **settings), seed=3, **kept))
    for t, phi in enumerate(fields):
        tracker.advance(phi, None if t == 0 else motion.step(t - 1))
    return tracker.carriers()


def test_newborns_fill_the_shell_and_nothing_else():
    phi = ball((20, 20, 20))
    new = newborns(phi, GRID, 1.0, np.zeros((0, 3), np.float32), SHELL, np.random.default_rng(0))
    depth = np.linalg.norm(new - 20, axis=1) - 8
    assert depth.max() < 0.1
    assert depth.min() > -1.6
    # Two in every cell that the shell fills: its volume is 1.5 voxels thick.
    volume = 4 / 3 * np.pi * (8**3 - 6.5**3)
    assert len(new) > 2 * volume
    counts = np.bincount(cell_of(new, GRID))
    assert counts.max() == 2
    # After that only cells are short that the shell barely grazes: few of the candidates fall into it.
    more = newborns(phi, GRID, 1.0, new, SHELL, np.random.default_rng(1))
    assert len(more) < 0.1 * len(new)
    assert (np.bincount(cell_of(np.concatenate([new, more]), GRID)) <= 2).all()


@pytest.mark.parametrize("outside", [0.125, 0.5])
def test_the_shell_may_reach_beyond_the_surface(outside: float):
    shell = ShellSettings(depth=1.5, outside=outside, min_per_cell=2, max_per_cell=2)
    empty = np.zeros((0, 3), np.float32)
    new = newborns(ball((20, 20, 20)), GRID, 1.0, empty, shell, np.random.default_rng(0))
    depth = np.linalg.norm(new - 20, axis=1) - 8
    assert outside - 0.05 < depth.max() < outside + 0.1


def test_a_drop_too_small_for_the_grid_gets_carriers_beyond_its_surface():
    drop = ball((20, 20, 20)) + 8.05  # no node is within it
    empty = np.zeros((0, 3), np.float32)
    for outside, some in ((0.0, False), (0.5, True)):
        born = newborns(drop, GRID, 1.0, empty, ShellSettings(outside=outside), np.random.default_rng(0))
        assert (len(born) > 0) == some


def test_cells_near_the_surface_and_curved_ones_want_more_carriers():
    shell = ShellSettings(min_per_cell=2, max_per_cell=10, curvature_weight=0.1)
    across = np.broadcast_to(np.arange(SIZE, dtype=np.float32)[:, None, None] - 20, (SIZE,) * 3)
    flat, curved = np.ascontiguousarray(across), 0.5 * across**2 - 1
    at = np.array([[20, 20, 20], [19, 20, 20]], dtype=np.float32)
    # 2 + 8 (exp(-|phi|) / 2 + 0.1 |Laplacian|): the plane has no Laplacian, the parabola has 1 at phi = -1.
    np.testing.assert_array_equal(target_population(flat, at, 1.0, shell), [6, 3])
    np.testing.assert_array_equal(target_population(curved, at[:1], 1.0, shell), [4])


def test_no_carrier_is_born_where_no_view_sees_and_fliers_rest_where_they_land():
    fields = [ball((20, 20, 20)), ball((20, 20, 20))]
    settings = CarrierSettings(shell=SHELL)

    def seen(phi: np.ndarray, points: np.ndarray) -> np.ndarray:
        return points[:, 0] > 20

    def landed(t: int, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        assert t == 1
        return start + np.float32([0, 0.25, 0])

    tracker = CarrierTracker(Tracking(GRID, GRID, settings, seed=3, seen=seen, landed=landed))
    still = FrameStep(np.zeros((*control_shape((SIZE,) * 3, FACTOR), 3), np.float32), FACTOR)
    tracker.advance(fields[0], None)
    tracker.advance(fields[1], still)
    carriers = tracker.carriers()
    first, second = (carriers.positions[carriers.rows(t)] for t in range(2))
    assert carriers.positions[:, 0].min() > 20
    ids = carriers.ids[carriers.rows(1)]
    low = first[:, 1] < 19  # these stay within the ball, where nothing is corrected
    lasting = np.intersect1d(ids, np.flatnonzero(low))
    assert len(lasting) > 100
    moved = second[np.searchsorted(ids, lasting)] - first[lasting]
    assert np.median(np.abs(moved - [0, 0.25, 0])) < 1e-5


def test_carriers_that_sank_below_the_shell_go():
    fields = [ball((20, 20, 20)), ball((20, 20, 20), radius=13.0)]  # the surface leaves them 5 voxels below
    for kill_inside, some in ((-3.0, False), (None, True)):
        births, ends = track(fields, kill_inside=kill_inside).births_and_ends()
        assert (ends[births == 0] == 1).any() == some


@pytest.mark.parametrize(("capacity", "lasting"), [(4, 4), (7, 7), (None, 400)])
def test_a_crowded_cell_keeps_as_many_as_it_may(capacity: int | None, lasting: int):
    def landed(t: int, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        return np.full_like(end, 20.5) - np.float32([0, 0, 8])  # all in one cell below the surface

    settings = CarrierSettings(shell=SHELL, cell_capacity=capacity)
    tracker = CarrierTracker(Tracking(GRID, GRID, settings, seed=3, landed=landed))
    tracker.advance(ball((20, 20, 20)), None)
    tracker.advance(ball((20, 20, 20)), FrameStep(np.zeros((10, 10, 10, 3), np.float32), FACTOR))
    births, ends = tracker.carriers().births_and_ends()
    old = np.flatnonzero((births == 0) & (ends == 1))
    assert len(old) == lasting if capacity else len(old) > lasting
    assert old.tolist() == list(range(len(old)))  # the oldest, which have the smallest numbers


def test_crowded_cells_keep_their_oldest():
    cells, ids = np.array([7, 7, 7, 2, 7]), np.array([9, 1, 4, 3, 2])
    np.testing.assert_array_equal(within_capacity(cells, ids, 2), [False, True, False, True, True])


def test_resampling_restores_coverage_that_transport_alone_loses():
    fields = [ball((14, 20, 20)), ball((26, 20, 20))]  # the liquid jumps; the motion is not known
    full, alone = track(fields), track(fields, variant="no_resampling")
    assert np.diff(full.starts)[1] > 0.8 * np.diff(full.starts)[0]
    assert np.diff(alone.starts)[1] < 0.4 * np.diff(alone.starts)[0]
    assert full.phi.max() <= 0.5
    # Reseeding each frame shares no carrier between frames.
    anew = track([ball((20, 20, 20))] * 2, variant="per_frame")
    assert len(np.intersect1d(anew.ids[anew.rows(0)], anew.ids[anew.rows(1)])) == 0


def test_carriers_live_on_with_the_flow():
    step = 1.0
    fields = [ball((16 + step * t, 20, 20)) for t in range(4)]
    control = control_of(lambda x: np.broadcast_to([step, 0, 0], x.shape))
    carriers = track(fields, np.stack([control] * 3))
    births, ends = carriers.births_and_ends()
    first = births == 0
    assert (ends[first] == 3).mean() > 0.97
    assert carriers.count < 1.15 * np.diff(carriers.starts)[0]  # against 4 times as many when reseeding each frame
    np.testing.assert_allclose(carriers.deformation, np.broadcast_to(np.eye(3), carriers.deformation.shape), atol=1e-4)


@pytest.mark.parametrize("lifetime", [1, 2, 4])
def test_carriers_are_replaced_when_their_time_is_up(lifetime: int):
    """Of liquid at rest every carrier would stay; they last as long as they are let, and others take their places."""
    carriers = track([ball((20, 20, 20))] * 13, lifetime=lifetime)
    births, ends = carriers.births_and_ends()
    frames = ends - births + 1
    within = births <= 12 - 2 * lifetime  # the sequence does not cut these short
    assert frames.max() == 2 * lifetime - 1
    assert frames[within].mean() == pytest.approx(lifetime, rel=0.03)
    counts = np.diff(carriers.starts)
    assert counts.min() > 0.9 * counts.max()  # cells that the shell grazes fill up by and by
    # Spread: those of one frame do not go together, though they came together.
    gone = np.bincount(ends + 1, minlength=13)[1:12]
    assert gone.max() < 1.6 * counts.mean() / lifetime


def test_who_lives_one_frame_is_made_anew_in_every_one():
    fields = [ball((16 + t, 20, 20)) for t in range(3)]
    short, anew = track(fields, lifetime=1), track(fields, variant="per_frame")
    np.testing.assert_array_equal(short.ids, anew.ids)
    np.testing.assert_array_equal(short.positions, anew.positions)


def test_the_loop_starts_when_liquid_appears_and_survives_an_empty_frame():
    nothing = np.full((SIZE,) * 3, 20, dtype=np.float32)
    carriers = track([nothing, ball((20, 20, 20)), nothing, ball((20, 20, 20))])
    counts = np.diff(carriers.starts)
    assert counts[0] == counts[2] == 0
    assert counts[1] > 500
    assert counts[3] > 500
    assert len(np.unique(carriers.ids)) == carriers.count


def test_keeping_some_carriers_renumbers_them():
    carriers = track([ball((18, 20, 20)), ball((19, 20, 20)), np.full((SIZE,) * 3, 20, np.float32)])
    wanted = np.arange(carriers.count) % 3 == 0
    kept, old = carriers.keep(wanted)
    assert kept.count == wanted.sum()
    for t in range(3):
        rows, kept_rows = carriers.rows(t), kept.rows(t)
        chosen = wanted[carriers.ids[rows]]
        np.testing.assert_array_equal(old[kept.ids[kept_rows]], carriers.ids[rows][chosen])
        np.testing.assert_array_equal(kept.positions[kept_rows], carriers.positions[rows][chosen])


def test_the_same_seed_gives_the_same_carriers():
    fields = [ball((18, 20, 20)), ball((20, 20, 20))]
    np.testing.assert_array_equal(track(fields).positions, track(fields).positions)


def test_carriers_are_the_same_where_nobody_asks_how_they_are_deformed():
    fields = [ball((18, 20, 20)), ball((19, 20, 20)), ball((21, 20, 20))]
    velocities = np.stack([control_of(lambda x: 0.2 * (x - 20) * [1, -1, 0]) for _ in range(2)])
    full, bare = (track(fields, velocities, keep, lifetime=2) for keep in (True, False))
    for name in ("starts", "ids", "positions", "phi"):
        np.testing.assert_array_equal(getattr(bare, name), getattr(full, name))
    assert np.abs(full.deformation - np.eye(3)).max() > 0.1
    assert (bare.deformation == np.eye(3)).all()


# Coverage


def pixel_camera(size: int = 80) -> Camera:
    """In front of the grid, 40 voxels off its near side; a pixel is about a voxel wide in the grid's middle."""
    K = np.array([[60.0, 0, size / 2], [0, 60.0, size / 2], [0, 0, 1]])
    return Camera("0", size, size, K, look_at(np.array([20.0, 20.0, -40.0]), np.array([20.0, 20.0, 20.0])))


def pixels_of(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Rows and columns [N, 2] of the pixels that show `points`."""
    return np.floor(camera.project(points)[0]).astype(int)[:, ::-1]


def test_a_pixel_without_liquid_gets_the_point_of_its_ray_nearest_to_some():
    camera, phi = pixel_camera(), ball((20, 20, 20))
    mask = np.zeros((80, 80), bool)
    # Seen past the ball at 2 voxels (within reach), at 6 (beyond it), and through its middle (covered).
    wanted = np.array([[20 + 10.2, 20, 20], [20, 20 + 14.5, 20], [20, 20, 20]])
    pixels = pixels_of(camera, wanted)
    mask[tuple(pixels.T)] = True
    points = uncovered(phi, GRID, camera, mask, ImageWindow(0, 80, 0, 80), None, reach=4.0, scale=1.0)
    assert pixels_of(camera, points).tolist() == [pixels[0].tolist()]
    distance = np.linalg.norm(points[0] - 20) - 8
    assert COVERED < distance < 4
    # No other point of the ray is nearer to the ball.
    eye = camera.center
    ray = (points[0] - eye) / np.linalg.norm(points[0] - eye)
    nearest = np.linalg.norm(np.cross(np.full(3, 20.0) - eye, ray)) - 8
    assert distance == pytest.approx(nearest, abs=0.05)


def test_rays_end_at_the_container_and_beside_the_grid_there_is_nothing():
    camera, phi = pixel_camera(), ball((20, 20, 20))
    mask = np.zeros((80, 80), bool)
    pixel = pixels_of(camera, np.array([[20 + 10.2, 20, 20.0]]))[0]
    mask[tuple(pixel)] = True
    mask[0, 0] = True  # looks past the grid
    window = ImageWindow(0, 80, 0, 80)
    wall = np.full((80, 80), 57.0, np.float32)  # three voxels in front of the ball's middle
    (point,) = uncovered(phi, GRID, camera, mask, window, wall, reach=4.0, scale=1.0)
    assert camera.project(point[None])[1][0] <= 57.0 + 1e-3
    near = np.full((80, 80), 45.0, np.float32)  # so far in front of the ball that nothing is within reach
    assert len(uncovered(phi, GRID, camera, mask, window, near, reach=4.0, scale=1.0)) == 0


def test_units_are_those_of_phi_and_windows_are_placed():
    camera, phi = pixel_camera(), ball((20, 20, 20))
    mask = np.zeros((80, 80), bool)
    mask[tuple(pixels_of(camera, np.array([[20 + 10.2, 20, 20.0]]))[0])] = True
    window = ImageWindow(10, 70, 20, 80)
    whole = uncovered(phi, GRID, camera, mask, ImageWindow(0, 80, 0, 80), None, 4.0, 1.0)
    part = uncovered(phi, GRID, camera, mask[window.slices], window, None, 4.0, 1.0)
    np.testing.assert_array_equal(part, whole)
    # phi in units of two of the grid's voxels: the same point, and half the distance.
    halved = uncovered(phi / 2, GRID, camera, mask, ImageWindow(0, 80, 0, 80), None, 4.0, 2.0)
    np.testing.assert_allclose(halved, whole, atol=0.6)
    assert len(uncovered(phi / 2, GRID, camera, mask, ImageWindow(0, 80, 0, 80), None, 0.9, 2.0)) == 0


def test_a_failed_mask_asks_for_no_carriers():
    camera = pixel_camera()
    mask = np.zeros((80, 80), bool)
    mask[tuple(pixels_of(camera, np.array([[20 + 10.2, 20, 20.0]]))[0])] = True
    scene = SimpleNamespace(
        name="one", cameras={"0": camera, "1": camera}, train=("0", "1"), n_frames=1, mask=lambda view, t: mask.copy()
    )
    silhouettes = Silhouettes(scene)
    phi = ball((20, 20, 20))
    assert len(uncovered_by_any(phi, GRID, silhouettes, 0, [None, None], 4.0, 1.0)) == 2
    silhouettes.distrust(np.array([[True, False]]))
    assert len(uncovered_by_any(phi, GRID, silhouettes, 0, [None, None], 4.0, 1.0)) == 1


def test_what_masks_show_uncovered_is_born_beyond_the_shell():
    where = np.array([[31.0, 20, 20]], np.float32)
    settings = CarrierSettings(shell=SHELL)
    tracker = CarrierTracker(Tracking(GRID, GRID, settings, seed=3, uncovered=lambda t, phi: where))
    tracker.advance(ball((20, 20, 20)), None)
    positions = tracker.carriers().positions
    np.testing.assert_array_equal(positions[-1:], where)
    assert (np.linalg.norm(positions[:-1] - 20, axis=1) < 8.1).all()


def test_the_interior_is_thinner_than_the_shell():
    shell = ShellSettings(depth=7.0, min_per_cell=3, max_per_cell=3, interior_per_cell=1)
    centres = np.array([[20.5, 20.5, 27.5], [20.5, 20.5, 22.5]], np.float32)  # 1 and 6 voxels deep
    assert target_population(ball((20, 20, 20)), centres, 1.0, shell).tolist() == [3, 1]

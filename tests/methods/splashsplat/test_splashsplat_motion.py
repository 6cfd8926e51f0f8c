"""Velocity fit, transport and the carriers' life, on fields whose motion is known."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench.observe.grid import Grid
from splashbench_methods.splashsplat.carriers.correction import correct
from splashbench_methods.splashsplat.carriers.population import Carriers
from splashbench_methods.splashsplat.carriers.resampling import (
    ShellSettings,
    cell_of,
    newborns,
    target_population,
    within_capacity,
)
from splashbench_methods.splashsplat.carriers.tracking import CarrierSettings, CarrierTracker, Tracking
from splashbench_methods.splashsplat.motion.advection import clamp_stretch, forecast
from splashbench_methods.splashsplat.motion.steps import FrameStep, Motion
from splashbench_methods.splashsplat.motion.velocity import (
    DivergenceFree,
    VelocityFit,
    VelocitySettings,
    control_shape,
    factor_of_sides,
    factors,
    fit_velocity,
    velocity_at,
)

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


def central_divergence(field: np.ndarray) -> np.ndarray:
    """Divergence by central differences in the interior of [n, n, n, 3]."""
    return sum(np.gradient(field[..., axis], axis=axis)[2:-2, 2:-2, 2:-2] for axis in range(3))


def surface_motion(fit: VelocityFit, phi: np.ndarray) -> np.ndarray:
    """Mean velocity over the surface phi = 0, [3]."""
    surface = np.argwhere(np.abs(phi) < 0.5)
    return np.mean([velocity_at(fit.control, factors(FACTOR), *map(float, node)) for node in surface], axis=0)


@pytest.mark.parametrize("motion", [(1.0, 0.0, 0.0), (0.0, -0.7, 0.7)])
def test_velocity_fit_recovers_a_translation(motion):
    fit = fit_velocity(ball((18, 20, 20)), ball(tuple(np.add((18, 20, 20), motion))), FACTOR)
    np.testing.assert_allclose(surface_motion(fit, ball((18, 20, 20))), motion, atol=0.12)
    assert fit.residual < 0.1 * fit.residual_before


def test_smoothing_the_field_instead_of_the_update_shrinks_the_motion():
    before, after = ball((18, 20, 20)), ball((20, 20, 20))
    field, update = (fit_velocity(before, after, FACTOR, VelocitySettings(smooth=s)) for s in ("field", "update"))
    assert 0.5 < surface_motion(field, before)[0] < 1.5
    assert 1.7 < surface_motion(update, before)[0] < 2.1


def test_the_gaussian_shrinks_the_motion_less_where_its_width_is_in_transport_voxels():
    """A ball of radius 12 moved by 6 voxels, smoothed by a sigma of 0.6 in either unit (the field, as in the paper)."""
    before, after = ball((14, 20, 20), 12.0), ball((20, 20, 20), 12.0)
    control, transport = (
        fit_velocity(before, after, FACTOR, VelocitySettings(smooth="field", smoothing_unit=unit))
        for unit in ("control", "transport")
    )
    found = [surface_motion(fit, before)[0] for fit in (control, transport)]
    assert found[0] < 4.3
    assert found[1] > found[0] + 0.6
    # A width of 2.4 transport voxels is one of 0.6 control cells.
    wide = VelocitySettings(smooth="field", smoothing=0.6 * FACTOR, smoothing_unit="transport")
    np.testing.assert_array_equal(fit_velocity(before, after, FACTOR, wide).control, control.control)


def test_the_control_grid_may_have_as_many_cells_along_every_side_of_a_long_box():
    """As the paper's 24^3, whatever the box; a translation is found on such cells, too."""
    shape = (20, 60, 20)
    factor = factor_of_sides(shape, 10)
    assert (factor, control_shape(shape, factor)) == ((2.0, 6.0, 2.0), (10, 10, 10))
    assert control_shape((8, 60, 20), factor_of_sides((8, 60, 20), 10)) == (8, 10, 10)  # no finer than a voxel
    nodes = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), axis=-1).astype(np.float32)
    before, after = (
        (np.linalg.norm(nodes - np.float32((10, y, 10)), axis=-1) - np.float32(6)).astype(np.float32) for y in (30, 31)
    )
    fit = fit_velocity(before, after, factor)
    assert fit.control.shape == (10, 10, 10, 3)
    surface = np.argwhere(np.abs(before) < 0.5)
    found = np.mean([velocity_at(fit.control, factor, *map(float, node)) for node in surface], axis=0)
    np.testing.assert_allclose(found, (0, 1, 0), atol=0.15)


def test_the_projection_knows_how_far_apart_its_nodes_are():
    """A field without divergence on cells three times as long along y as along x."""
    index = np.stack(np.meshgrid(np.arange(31.0), np.arange(15.0), np.arange(9.0), indexing="ij"), axis=-1)
    place = index * np.array([1.0, 3.0, 1.0]) - np.array([15.0, 21.0, 4.0])
    potential = np.exp(-(place**2 / (2 * np.array([3.0, 7.0, 1.0]) ** 2)).sum(axis=-1))
    slopes = np.gradient(potential, 1.0, 3.0, 1.0)
    curl = np.stack([slopes[1], -slopes[0], np.zeros_like(potential)], axis=-1)
    project = DivergenceFree((31, 15, 9), (2.0, 6.0, 2.0))
    assert np.abs(project(curl) - curl).max() < 2e-2 * np.abs(curl).max()
    assert np.abs(DivergenceFree((31, 15, 9))(curl) - curl).max() > 0.1 * np.abs(curl).max()


def test_velocity_is_zero_where_nothing_moves_or_nothing_is():
    still = fit_velocity(ball((18, 20, 20)), ball((18, 20, 20)), FACTOR)
    assert np.abs(still.control).max() < 1e-3
    nothing = np.full((SIZE,) * 3, 20, dtype=np.float32)
    assert (fit_velocity(nothing, ball((20, 20, 20)), FACTOR).control == 0).all()


def test_velocity_never_exceeds_its_limit():
    fit = fit_velocity(ball((15, 20, 20)), ball((22, 20, 20)), FACTOR, VelocitySettings(limit=2.0))
    assert np.linalg.norm(fit.control, axis=-1).max() <= 2.0 + 1e-5


def smooth_bump(x: np.ndarray) -> np.ndarray:
    return np.exp(-((x - 12.0) ** 2).sum(axis=-1) / (2 * 2.5**2))


def test_projection_leaves_a_divergence_free_field_alone_and_removes_a_gradient():
    x = np.stack(np.meshgrid(*[np.arange(25.0)] * 3, indexing="ij"), axis=-1)
    potential = smooth_bump(x)
    slopes = np.stack(np.gradient(potential), axis=-1)
    curl = np.stack([slopes[..., 1], -slopes[..., 0], np.zeros_like(potential)], axis=-1)
    project = DivergenceFree((25, 25, 25))
    assert np.abs(project(curl) - curl).max() < 1e-3 * np.abs(curl).max()
    assert np.abs(project(slopes)).max() < 1e-3 * np.abs(slopes).max()
    mixed = project(slopes + 0.5 * curl)
    np.testing.assert_allclose(mixed, 0.5 * curl, atol=1e-3 * np.abs(slopes).max())
    assert np.abs(central_divergence(mixed)).max() < 1e-3 * np.abs(central_divergence(slopes)).max()


def test_the_projection_axis_by_axis_is_that_of_the_whole_padded_volume():
    shape = (9, 6, 13)
    field = np.random.default_rng(2).normal(size=(*shape, 3))
    project = DivergenceFree(shape)
    spectrum = np.fft.fftn(field, s=project.padded, axes=(0, 1, 2))
    waves = np.stack(np.meshgrid(*[np.sin(2 * np.pi * np.fft.fftfreq(n)) for n in project.padded], indexing="ij"), -1)
    square = (waves**2).sum(axis=-1, keepdims=True)
    # Where the symbol vanishes, the constant and the checkerboards, nothing is taken away.
    along = (waves * spectrum).sum(axis=-1, keepdims=True) / np.where(square > 1e-9, square, np.inf)
    whole = np.fft.ifftn(spectrum - waves * along, axes=(0, 1, 2)).real[: shape[0], : shape[1], : shape[2]]
    np.testing.assert_allclose(project(field), whole, atol=1e-5)


def test_uniform_flow_moves_carriers_and_keeps_their_shape():
    control = control_of(lambda x: np.broadcast_to([1.5, -0.5, 0.25], x.shape))
    x = np.random.default_rng(0).uniform(10, 30, (50, 3)).astype(np.float32)
    F = np.broadcast_to(np.eye(3, dtype=np.float32), (50, 3, 3))
    moved, deformed = forecast(control, FACTOR, x, F)
    np.testing.assert_allclose(moved - x, np.broadcast_to([1.5, -0.5, 0.25], x.shape), atol=1e-5)
    np.testing.assert_allclose(deformed, F, atol=1e-5)
    half, _ = forecast(control, FACTOR, x, F, duration=0.5)
    np.testing.assert_allclose(half - x, np.broadcast_to([0.75, -0.25, 0.125], x.shape), atol=1e-5)


def test_shear_deforms_carriers_by_its_gradient():
    rate = 0.2
    control = control_of(lambda x: np.stack([rate * (x[..., 1] - 20), 0 * x[..., 0], 0 * x[..., 0]], axis=-1))
    x = np.array([[20.0, 22.0, 20.0]], dtype=np.float32)
    moved, deformed = forecast(control, FACTOR, x, np.eye(3, dtype=np.float32)[None])
    np.testing.assert_allclose(moved, [[20 + 2 * rate, 22, 20]], atol=1e-4)
    np.testing.assert_allclose(deformed[0], np.eye(3) + rate * np.outer([1, 0, 0], [0, 1, 0]), atol=1e-4)


def test_midpoint_steps_stay_on_a_circle_where_euler_steps_leave_it():
    rate = 0.1

    def spin(x: np.ndarray) -> np.ndarray:
        return np.stack([-rate * (x[..., 1] - 20), rate * (x[..., 0] - 20), 0 * x[..., 0]], axis=-1)

    control = control_of(spin)
    x, F = np.array([[26.0, 20.0, 20.0]], dtype=np.float32), np.eye(3, dtype=np.float32)[None]
    for _ in range(10):
        x, F = forecast(control, FACTOR, x, F)
    radius = np.hypot(x[0, 0] - 20, x[0, 1] - 20)
    assert radius == pytest.approx(6, abs=0.01)  # ten Euler steps would end at 6 * 1.01^5 = 6.31
    np.testing.assert_allclose(x[0], [20 + 6 * np.cos(1), 20 + 6 * np.sin(1), 20], atol=0.03)
    angle = np.arctan2(F[0, 1, 0], F[0, 0, 0])
    assert angle == pytest.approx(10 * np.arctan(rate), abs=1e-3)


def test_stretch_is_clamped_without_turning():
    stretched = np.diag([10.0, 1.0, 0.01]).astype(np.float32)[None]
    np.testing.assert_allclose(clamp_stretch(stretched)[0], np.diag([3, 1, 1 / 3]), atol=1e-6)
    kept = np.array([[[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1.0]]], dtype=np.float32)
    np.testing.assert_allclose(clamp_stretch(kept), kept, atol=1e-6)


def test_stretch_is_clamped_wherever_a_singular_value_leaves_the_bounds():
    rng = np.random.default_rng(0)
    deformation = (np.eye(3) + rng.uniform(0, 1.2, (4000, 1, 1)) * rng.normal(size=(4000, 3, 3))).astype(np.float32)
    left, stretch, right = np.linalg.svd(deformation.astype(np.float64))
    assert 0.2 < ((stretch > 3) | (stretch < 1 / 3)).any(axis=1).mean() < 0.8
    expected = (left * np.clip(stretch, 1 / 3, 3)[:, None]) @ right
    np.testing.assert_allclose(clamp_stretch(deformation), expected, atol=2e-5)
    assert clamp_stretch(deformation[:0]).shape == (0, 3, 3)


def test_correction_moves_exterior_carriers_only_and_no_farther_than_its_limit():
    phi = ball((20, 20, 20))
    inside, near, far = [20.0, 20, 15], [28.5, 20, 20], [20.0, 33, 20]
    corrected = correct(phi, np.array([inside, near, far], dtype=np.float32), 1.0, limit=1.0)
    np.testing.assert_array_equal(corrected[0], inside)
    np.testing.assert_allclose(corrected[1], [28, 20, 20], atol=0.03)
    np.testing.assert_allclose(corrected[2], [20, 32, 20], atol=0.03)


GRID = Grid(np.zeros(3), 1.0, (SIZE,) * 3)
SHELL = ShellSettings(depth=1.5, min_per_cell=2, max_per_cell=2)


def track(fields, velocities=None, **settings) -> Carriers:
    """Run the loop with hull grid = transport grid."""
    pairs = len(fields) - 1
    if velocities is None:
        velocities = np.zeros((pairs, *control_shape((SIZE,) * 3, FACTOR), 3), dtype=np.float32)
    motion = Motion(velocities, FACTOR, [None] * pairs)
    tracker = CarrierTracker(Tracking(GRID, GRID, CarrierSettings(shell=SHELL, **settings), seed=3))
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

"""Velocity fit, transport and correction, on fields whose motion is known."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench_methods.splashsplat.carriers.correction import correct
from splashbench_methods.splashsplat.motion.advection import clamp_stretch, forecast, moved
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


def test_a_fit_that_carries_on_needs_fewer_steps():
    """A ball that moves on by the same 3 voxels, from the motion of the step before and from none."""
    places = [ball((x, 20, 20)) for x in (14.0, 17.0, 20.0)]
    first = fit_velocity(places[0], places[1], FACTOR).control
    few = VelocitySettings(steps=4)
    cold = fit_velocity(places[1], places[2], FACTOR, few)
    warm = fit_velocity(places[1], places[2], FACTOR, few, first)
    assert warm.residual_before < 0.5 * cold.residual_before
    assert warm.residual < 0.5 * cold.residual
    # What the liquid does not say any more is not kept: it stands still again.
    still = fit_velocity(places[1], places[1], FACTOR, VelocitySettings(steps=35), first)
    assert np.abs(surface_motion(still, places[1])).max() < 0.2
    np.testing.assert_array_equal(fit_velocity(places[0], places[1], FACTOR).control, first)


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


def test_what_has_no_volume_left_gets_some():
    rng = np.random.default_rng(1)
    flat = rng.normal(size=(50, 3, 2)) @ rng.normal(size=(50, 2, 3))
    line = rng.normal(size=(50, 3, 1)) @ rng.normal(size=(50, 1, 3))
    deformation = np.concatenate([flat, line, np.zeros((1, 3, 3))]).astype(np.float32)
    stretch = np.linalg.svd(clamp_stretch(deformation), compute_uv=False)
    assert stretch.min() > 1 / 3 - 1e-5
    assert stretch.max() < 3 + 1e-5


def test_places_do_not_depend_on_whether_the_deformation_is_asked_for():
    rng = np.random.default_rng(2)
    control = rng.normal(0, 2, (*control_shape((SIZE,) * 3, FACTOR), 3)).astype(np.float32)
    x = rng.uniform(-2, SIZE + 2, (3000, 3)).astype(np.float32)
    F = np.broadcast_to(np.eye(3, dtype=np.float32), (len(x), 3, 3))
    for duration in (1.0, -0.4):
        np.testing.assert_array_equal(moved(control, FACTOR, x, duration), forecast(control, FACTOR, x, F, duration)[0])


def test_correction_moves_exterior_carriers_only_and_no_farther_than_its_limit():
    phi = ball((20, 20, 20))
    inside, near, far = [20.0, 20, 15], [28.5, 20, 20], [20.0, 33, 20]
    corrected = correct(phi, np.array([inside, near, far], dtype=np.float32), 1.0, limit=1.0)
    np.testing.assert_array_equal(corrected[0], inside)
    np.testing.assert_allclose(corrected[1], [28, 20, 20], atol=0.03)
    np.testing.assert_allclose(corrected[2], [20, 32, 20], atol=0.03)

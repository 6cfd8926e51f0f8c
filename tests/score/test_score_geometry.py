"""Volume and surface against the truth, on balls whose overlap and distance are known in closed form."""

import time

import numpy as np
import pytest

from splashbench.observe.grid import Grid
from splashbench.scene import SignedDistance
from splashbench.score.particles.surface import particle_distance, spacing
from splashbench.score.truth.level_set import chamfer, filled, overlap, resampled, surface_points

SHAPE = (48, 44, 44)
MIDDLE = np.array([22.3, 21.6, 21.9])


def ball(radius: float, centre: np.ndarray = MIDDLE) -> np.ndarray:
    """Signed distance to a ball, voxels."""
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij"), axis=-1)
    return (np.linalg.norm(nodes - centre, axis=-1) - radius).astype(np.float32)


def lattice_ball(radius: float, step: float) -> np.ndarray:
    """Points of a cubic lattice in a ball about the middle, [N, 3]."""
    side = np.arange(-np.ceil(radius / step), np.ceil(radius / step) + 1) * step
    points = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3) + 0.31 * step
    return MIDDLE + points[np.linalg.norm(points, axis=1) < radius]


def chance_ball(radius: float, count: int) -> np.ndarray:
    """Points scattered uniformly through a ball about the middle, [count, 3]."""
    rng = np.random.default_rng(4)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return MIDDLE + directions * radius * rng.random((count, 1)) ** (1 / 3)


@pytest.mark.parametrize("shift", [2.0, 5.0, 12.0])
def test_overlap_of_shifted_balls_is_that_of_two_caps(shift: float) -> None:
    radius = 14.0
    shared = overlap(ball(radius), ball(radius, MIDDLE + np.array([shift, 0, 0])))
    lens = np.pi * (4 * radius + shift) * (2 * radius - shift) ** 2 / 12
    volume = 4 / 3 * np.pi * radius**3
    assert shared.iou == pytest.approx(lens / (2 * volume - lens), abs=0.01)
    assert shared.recall == pytest.approx(lens / volume, abs=0.01)
    assert shared.precision == pytest.approx(lens / volume, abs=0.01)


def test_too_much_costs_precision_and_too_little_costs_recall() -> None:
    more, less = overlap(ball(10), ball(12)), overlap(ball(12), ball(10))
    assert (more.recall, less.precision) == (1.0, 1.0)
    assert more.precision == pytest.approx((10 / 12) ** 3, abs=0.01)
    assert less.recall == pytest.approx((10 / 12) ** 3, abs=0.01)
    assert overlap(ball(10), ball(-1)).precision is None


def test_surface_points_lie_on_the_surface() -> None:
    radii = np.linalg.norm(surface_points(ball(13.2)) - MIDDLE, axis=1)
    assert np.abs(radii - 13.2).max() < 0.02
    assert surface_points(ball(-1)).shape == (0, 3)


@pytest.mark.parametrize("gap", [1.0, 3.0, 6.0])
def test_chamfer_of_balls_about_one_centre_is_the_difference_of_radii(gap: float) -> None:
    value = chamfer(surface_points(ball(10)), surface_points(ball(10 + gap)))
    # From point to point: the nearest one lies a little to the side.
    assert gap <= value < gap + 0.12


def test_chamfer_of_a_shifted_ball_is_its_mean_distance() -> None:
    radius, shift = 14.0, 4.0
    cosine = np.linspace(-1, 1, 20_001)
    expected = np.abs(np.sqrt(radius**2 + shift**2 - 2 * radius * shift * cosine) - radius).mean()
    points = surface_points(ball(radius)), surface_points(ball(radius, MIDDLE + np.array([shift, 0, 0])))
    assert chamfer(*points) == pytest.approx(expected, rel=0.05)
    assert chamfer(points[0], points[0]) == 0.0


def test_single_distances_are_clipped_and_nothing_is_as_far() -> None:
    near, far = np.zeros((1, 3)), np.array([[0.0, 0, 0], [500.0, 0, 0]])
    assert chamfer(near, far) == pytest.approx(0.5 * (0 + (0 + 20) / 2))
    assert chamfer(near, np.zeros((0, 3))) == 20.0


@pytest.mark.parametrize("step", [0.8, 1.5, 2.5])
def test_particles_on_a_lattice_fill_the_volume_they_stand_for(step: float) -> None:
    points = lattice_ball(14.0, step)
    liquid = particle_distance(points, step, SHAPE) < 0
    assert liquid.sum() == pytest.approx(len(points) * step**3, rel=0.08)
    assert overlap(ball(14.0), np.where(liquid, np.float32(-1), np.float32(1))).iou > 0.9


def test_the_spacing_of_particles_is_told_from_lattice_and_chance_alike() -> None:
    assert spacing(lattice_ball(14.0, 1.5)) == pytest.approx(1.5)
    count = 3000
    mean_spacing = (4 / 3 * np.pi * 14**3 / count) ** (1 / 3)
    assert spacing(chance_ball(14.0, count)) == pytest.approx(0.86 * mean_spacing, rel=0.08)
    assert spacing(np.zeros((3, 3))) is None


def test_particles_scattered_at_random_give_the_ball_they_fill() -> None:
    points = chance_ball(14.0, 3000)
    size = spacing(points)
    assert size is not None
    assert overlap(ball(14.0), filled(particle_distance(points, size, SHAPE))).iou > 0.8


def test_gaps_wider_than_the_spacing_stay_open() -> None:
    side = np.arange(10.0, 34.0, 1.5)
    sheets = np.array([[x, y, z] for x in (16.0, 21.0) for y in side for z in side])
    phi = particle_distance(sheets, 1.5, SHAPE)
    through = phi[:, 22, 22] < 0
    assert through[16]
    assert through[21]
    assert not through[18:20].any()


def test_the_surface_does_not_depend_on_the_order_of_the_particles() -> None:
    points = chance_ball(12.0, 500)
    shuffled = np.random.default_rng(1).permutation(points)
    np.testing.assert_array_equal(particle_distance(points, 1.5, SHAPE), particle_distance(shuffled, 1.5, SHAPE))


def test_particles_beyond_the_grid_count_for_nothing() -> None:
    points = np.concatenate([lattice_ball(8.0, 1.5), np.full((3, 3), 1e30), np.full((3, 3), -1e30)])
    np.testing.assert_array_equal(
        particle_distance(points, 1.5, SHAPE), particle_distance(lattice_ball(8.0, 1.5), 1.5, SHAPE)
    )


def test_a_shell_is_filled_and_a_bowl_is_not() -> None:
    shell = np.maximum(ball(14), -ball(11))
    assert (filled(shell) < 0).sum() == (ball(14) < 0).sum()
    assert len(surface_points(filled(shell))) == len(surface_points(ball(14)))
    opened = np.where(np.arange(SHAPE[0])[:, None, None] > 20, shell, np.float32(2))
    np.testing.assert_array_equal(filled(opened), opened)


def test_geometry_on_another_grid_is_the_same_liquid() -> None:
    """A ball told on a finer grid in other units, farther apart than a node from the scored grid's."""
    truth = Grid(np.array([1.0, 2.0, 3.0]), 0.1, SHAPE)
    centre, radius = truth.to_scene(MIDDLE), 1.3
    fine = Grid(centre - 1.61, 0.07, (47, 47, 47))
    own = (np.linalg.norm(fine.nodes() - centre, axis=-1) - radius) / fine.voxel
    geometry = SignedDistance.of(own[None], fine.origin, fine.voxel)
    phi = resampled(geometry, 0, truth)
    shared = overlap(ball(13.0), phi)
    assert shared.iou > 0.99
    assert chamfer(surface_points(ball(13.0)), surface_points(phi)) < 0.1
    # Beyond the grid that was handed in there is no liquid.
    assert phi[0, 0, 0] > 7.9


def test_stored_distances_keep_their_sign() -> None:
    values = np.array([-100.0, -0.01, 0.0, 0.01, 0.5, 100.0, 1.0, 2.0]).reshape(1, 2, 2, 2)
    geometry = SignedDistance.of(values, np.zeros(3), 1.0)
    assert geometry.phi.ravel().tolist() == [-127, -1, 0, 0, 8, 127, 16, 32]
    with pytest.raises(ValueError, match="NaN"):
        SignedDistance.of(values * np.nan, np.zeros(3), 1.0)


def test_the_spacing_of_particles_that_lie_on_each_other_is_found_at_once() -> None:
    points = lattice_ball(14.0, 1.5)
    # Every second particle lies where the first does: their third neighbour is at no distance.
    crowd = np.concatenate([points, np.tile(points[:1], (100_000, 1))])
    began = time.process_time()
    assert spacing(crowd) == 0.0
    assert time.process_time() - began < 5
    twice = np.concatenate([points, np.tile(points[:1], (len(points) // 3, 1))])
    assert spacing(twice) == pytest.approx(1.5)

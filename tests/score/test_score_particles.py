"""Density, uniformity and energy of particles with known answers."""

from dataclasses import dataclass

import numpy as np
import pytest

from splashbench.observe.consistency import inside_mask
from splashbench.scene import Camera, Particles
from splashbench.score.particles.density import frame_density, poly6_densities
from splashbench.score.particles.energy import energy_deviation
from splashbench.score.particles.uniformity import frame_uniformity, shell_points
from splashbench.score.settings import Protocol

UP = np.array([0.0, 1.0, 0.0])


def uniform_ball(count: int, radius: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * radius * rng.random((count, 1)) ** (1 / 3)


@dataclass
class BallFields:
    """The exact signed distance of a ball around the origin, with the interface of the observed fields."""

    radius: float
    cells: int = 48

    @property
    def voxel(self) -> float:
        return 2.4 * self.radius / self.cells

    @property
    def origin(self) -> np.ndarray:
        return np.full(3, -1.2 * self.radius)

    @property
    def longest_side(self) -> float:
        return 2 * self.radius

    @property
    def phi(self) -> np.ndarray:
        axis = self.origin[0] + self.voxel * np.arange(self.cells + 1)
        nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
        return self.sample(0, nodes.reshape(-1, 3)).reshape(nodes.shape[:3])[None]

    def sample(self, t: int, points: np.ndarray) -> np.ndarray:
        return (np.linalg.norm(points, axis=1) - self.radius) / self.voxel


def test_density_equals_a_brute_force_sum() -> None:
    points = np.random.default_rng(3).random((150, 3)) * 0.5
    h = 0.3
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    nearest = np.sort(distances, axis=1)[:, 1:65]
    weights = np.where(nearest < h, 315 / (64 * np.pi * h**9) * (h**2 - nearest**2) ** 3, 0.0)
    np.testing.assert_allclose(poly6_densities(points), weights.sum(axis=1), rtol=1e-12)


def test_uniform_ball_gives_the_published_magnitude() -> None:
    """16 000 uniform points in a ball of radius 1.5: the paper reports sigma 219.9 and sigma / mu 0.198."""
    density = frame_density(uniform_ball(16_000, 1.5), 0)
    assert density is not None
    assert density.ratio is not None
    assert density.sigma == pytest.approx(203, abs=2)
    assert density.mu == pytest.approx(1011, abs=3)
    assert density.ratio == pytest.approx(0.201, abs=0.002)


def test_fewer_particles_than_a_neighbourhood_are_invalid_not_even() -> None:
    points = np.random.default_rng(0).random((65, 3)) * 0.1
    assert frame_density(points[:64], 0) is None
    assert frame_density(points, 0) is not None


def test_more_particles_than_the_cap_are_subsampled_to_it() -> None:
    capped = frame_density(uniform_ball(6_000, 1.0), 0, Protocol(particle_cap=2_000))
    as_many = frame_density(uniform_ball(2_000, 1.0, seed=1), 0)
    assert capped is not None
    assert as_many is not None
    assert capped.count == 2_000
    assert capped.mu == pytest.approx(as_many.mu, rel=0.03)


def test_density_does_not_depend_on_the_order_of_the_particles() -> None:
    points = uniform_ball(3_000, 1.0)
    shuffled = np.random.default_rng(5).permutation(points)
    protocol = Protocol(particle_cap=1_000)
    assert frame_density(points, 4, protocol) == frame_density(shuffled, 4, protocol)


def test_shell_points_lie_in_the_shell_and_fill_it() -> None:
    fields = BallFields(0.5)
    points = shell_points(fields, 0, 4_000, depth=3.0)
    assert points is not None
    assert points.shape == (4_000, 3)
    phi = fields.sample(0, points)
    assert phi.min() >= -3
    assert phi.max() <= 0
    # Uniform by volume: the share outside the middle radius is known.
    inner, outer = fields.radius - 3 * fields.voxel, fields.radius
    middle = 0.5 * (inner + outer)
    expected = (outer**3 - middle**3) / (outer**3 - inner**3)
    assert np.mean(np.linalg.norm(points, axis=1) > middle) == pytest.approx(expected, abs=0.03)
    assert np.abs(points.mean(axis=0)).max() < 0.03


def _uniformity(points: np.ndarray, fields: BallFields) -> float:
    scale = 3.0 / fields.longest_side
    density = frame_density(points * scale, 0)
    assert density is not None
    value = frame_uniformity(density, fields, 0, scale)
    assert value is not None
    return value


def test_uniformity_is_one_for_chance_and_larger_for_clusters() -> None:
    fields = BallFields(0.5)
    generator = np.random.default_rng(9)
    directions = generator.normal(size=(3_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    inner, outer = fields.radius - 3 * fields.voxel, fields.radius
    radii = generator.uniform(inner**3, outer**3, (3_000, 1)) ** (1 / 3)
    even = directions * radii
    assert _uniformity(even, fields) == pytest.approx(1.0, abs=0.1)
    clustered = even.copy()
    clustered[:1_000] = even[0] + 0.02 * generator.normal(size=(1_000, 3))
    assert _uniformity(clustered, fields) > 1.5


def test_uniformity_cannot_be_gamed_by_shrinking_the_unit_of_length() -> None:
    """sigma / mu alone falls when everything shrinks within the kernel; the index is defined after scaling."""
    small, large = BallFields(0.05), BallFields(5.0)
    points = uniform_ball(2_000, 1.0)
    assert _uniformity(points * 0.05, small) == pytest.approx(_uniformity(points * 5.0, large), rel=1e-6)


def test_liquid_too_thin_for_the_grid_has_no_uniformity() -> None:
    fields = BallFields(0.5)
    assert shell_points(fields, 0, 100, depth=1e-9) is None


def ballistic(times: np.ndarray, count: int = 40, seed: int = 0) -> Particles:
    rng = np.random.default_rng(seed)
    start, velocity = rng.normal(size=(count, 3)), rng.normal(size=(count, 3)) * 2
    t = times[:, None, None]
    positions = start + velocity * t - 0.5 * 9.81 * t**2 * UP
    return Particles(positions, np.ones(positions.shape[:2], bool))


UNEVEN = np.array([0.0, 0.01, 0.04, 0.05, 0.09, 0.1])


@pytest.mark.parametrize("metres_per_unit", [1.0, 0.1])
def test_ballistic_flight_with_uneven_steps_keeps_its_energy(metres_per_unit: float) -> None:
    particles = ballistic(UNEVEN)
    scaled = Particles(particles.positions / metres_per_unit, particles.active)
    change = energy_deviation(scaled, UNEVEN, UP, metres_per_unit)
    assert change is not None
    assert change.value == 0.0
    assert change.changes == (None, 0.0, 0.0, 0.0, 0.0, None)


def test_ballistic_flight_taken_for_even_steps_does_not() -> None:
    change = energy_deviation(ballistic(UNEVEN), np.linspace(0, 0.1, 6), UP, 1.0)
    assert change is not None
    assert change.value > 0.1


def test_energy_only_lost_scores_zero_and_only_gained_one() -> None:
    times = np.linspace(0, 0.5, 6)
    slowing = np.cumsum([0.0, 0.5, 0.4, 0.3, 0.2, 0.1])
    for path, expected in ((slowing, 0.0), (slowing[-1] - slowing[::-1], 1.0)):
        positions = np.zeros((6, 3, 3))
        positions[:, :, 0] = path[:, None]
        change = energy_deviation(Particles(positions, np.ones((6, 3), bool)), times, UP, 1.0)
        assert change is not None
        assert change.value == expected


def test_energy_share_of_a_known_zigzag() -> None:
    """Steps of 1, 2, 1, 2 m/s: kinetic energy changes by +1.5, -1.5, +1.5 J/kg, two thirds of it upwards."""
    positions = np.zeros((5, 1, 3))
    positions[:, 0, 0] = np.cumsum([0.0, 1.0, 2.0, 1.0, 2.0])
    change = energy_deviation(Particles(positions, np.ones((5, 1), bool)), np.arange(5.0), UP, 1.0)
    assert change is not None
    assert change.changes == pytest.approx((None, 1.5, -1.5, 1.5, None))
    assert change.value == pytest.approx(2 / 3)


def test_energy_uses_carriers_alive_through_three_frames_only() -> None:
    times = np.arange(4.0)
    positions = np.zeros((4, 2, 3))
    positions[:, 0, 0] = [0, 1, 1, 1]
    positions[:, 1, 0] = [0, 50, -70, 900]
    active = np.array([[1, 1], [1, 0], [1, 1], [1, 0]], bool)
    change = energy_deviation(Particles(positions, active), times, UP, 1.0)
    assert change is not None
    assert change.changes == pytest.approx((None, -0.5, 0.0, None))
    active[1] = False
    assert energy_deviation(Particles(positions, active), times, UP, 1.0) is None


def test_points_behind_or_beside_the_camera_are_outside_the_silhouette() -> None:
    camera = Camera("1", 10, 8, np.array([[10.0, 0, 5], [0, 10.0, 4], [0, 0, 1]]), np.eye(4))
    mask = np.zeros((8, 10), bool)
    mask[4, 5] = True
    points = np.array([[0.05, 0.05, 1.0], [0.25, 0.05, 1.0], [0.05, 0.05, -1.0], [9.0, 0.0, 1.0]])
    assert inside_mask(points, camera, mask).tolist() == [True, False, False, False]

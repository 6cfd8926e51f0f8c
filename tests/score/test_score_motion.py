"""Velocities against the truth: endpoint errors of motions that are known exactly."""

import time

import numpy as np
import pytest

from splashbench.scene import Particles
from splashbench.score.truth.motion import FrameMotion, frame_motion, free_flight, known_velocities

GRAVITY = np.array([0.0, -9.81, 0.0])


def moving(count: int = 200, step: tuple[float, float, float] = (3.0, -1.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    """Positions [N, 3] in a box of 12 voxels, and one displacement for all."""
    return np.random.default_rng(0).uniform(0, 12, (count, 3)), np.tile(np.array(step), (count, 1))


def compare(points: np.ndarray, true: np.ndarray, others: np.ndarray, moved: np.ndarray) -> FrameMotion:
    return frame_motion(points, true, np.ones(len(points), bool), points, others, moved)


def test_a_uniform_translation_is_met_exactly_or_missed_by_its_difference() -> None:
    points, true = moving()
    others = np.random.default_rng(1).uniform(0, 12, (300, 3))
    same = compare(points, true, others, np.tile(true[0], (300, 1)))
    assert same.error == pytest.approx(0.0, abs=1e-12)
    assert same.relative == pytest.approx(0.0, abs=1e-12)
    other = compare(points, true, others, np.tile(true[0] + np.array([0.0, 0.3, 0.4]), (300, 1)))
    assert other.error == pytest.approx(0.5)
    assert other.relative == pytest.approx(0.5 / np.sqrt(10))
    assert other.relative_airborne == other.relative


def test_no_motion_scores_exactly_one_and_half_of_it_half() -> None:
    points, _ = moving()
    true = np.random.default_rng(2).normal(size=points.shape) * 4
    assert compare(points, true, points + 0.4, 0 * true).relative == 1.0
    assert compare(points, true, points, 0.5 * true).relative == pytest.approx(0.5, abs=1e-4)


def test_a_particle_on_the_true_one_decides() -> None:
    points, _ = moving()
    true = np.random.default_rng(2).normal(size=points.shape) * 4
    assert compare(points, true, points, true).error == pytest.approx(0.0, abs=1e-4)


def test_what_is_out_of_reach_is_left_out_and_counted() -> None:
    true_points = np.array([[0.0, 0, 0], [2.9, 0, 0], [6.2, 0, 0], [50.0, 0, 0]])
    true = np.ones((4, 3))
    surface = np.array([[0.0, 0, 0], [6.0, 0, 0]])
    motion = frame_motion(true_points, true, np.zeros(4, bool), surface, np.zeros((1, 3)), np.zeros((1, 3)))
    # The last is far from the surface, the last but one near it and far from the reconstruction.
    assert motion.near == 3
    assert len(motion.errors) == 2
    assert motion.coverage == pytest.approx(2 / 3)
    assert motion.relative_airborne is None
    nothing = frame_motion(true_points, true, np.zeros(4, bool), surface, np.zeros((0, 3)), np.zeros((0, 3)))
    assert (nothing.error, nothing.relative, nothing.coverage) == (None, None, 0.0)


def test_velocities_are_the_particles_own_else_displacements_of_those_alive_in_both_frames() -> None:
    times = np.array([0.0, 0.1, 0.3])
    positions = np.zeros((3, 2, 3))
    positions[:, 0, 0] = [0, 1, 5]
    active = np.array([[1, 1], [1, 0], [1, 1]], bool)
    rows, velocities = known_velocities(Particles(positions, active), 1, times)
    assert rows.tolist() == [0]
    np.testing.assert_allclose(velocities, [[20.0, 0, 0]])
    rows, velocities = known_velocities(Particles(positions, active, np.full((3, 2, 3), 7.0)), 0, times)
    assert rows.tolist() == [0, 1]
    np.testing.assert_allclose(velocities, 7.0)


def test_free_flight_is_told_from_rest_contact_and_the_last_step() -> None:
    times = np.array([0.0, 0.02])
    velocities = np.zeros((2, 5, 3))
    velocities[0] = [1.0, 2.0, 0.5]
    velocities[1] = velocities[0] + 0.02 * GRAVITY
    velocities[1, 1] = velocities[0, 1]  # carried
    velocities[1, 2, 0] += 0.02 * 0.19 * 9.81  # a little drag
    velocities[1, 3, 0] += 0.02 * 0.21 * 9.81  # too much of it
    active = np.ones((2, 5), bool)
    active[1, 4] = False
    true = Particles(np.zeros((2, 5, 3)), active, velocities)
    falling = free_flight(true, 0, times, GRAVITY)
    assert falling is not None
    assert falling.tolist() == [True, False, True, False, False]
    assert free_flight(Particles(true.positions, active), 0, times, GRAVITY) is None


def test_any_number_of_particles_at_one_place_is_compared_at_once() -> None:
    """A leaf of the k-d tree would hold them all, and every true particle look at each."""
    points, true = moving(2000)
    others = np.concatenate([points, np.tile(points[:1], (200_000, 1))])
    moved = np.concatenate([true, np.tile(true[:1], (200_000, 1))])
    began = time.process_time()
    found = compare(points, true, others, moved)
    assert time.process_time() - began < 3
    assert found.error == pytest.approx(0.0, abs=1e-12)
    assert found.coverage == 1.0

"""The FLIP solver against what physics knows, and carriers moved by it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splashbench import parallel
from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Run
from splashbench.observe.grid import Grid
from splashbench.observe.kernels import sample
from splashbench.scene import Scene
from splashbench_methods.splashsplat import SplashSplat, SplashSplatConfig
from splashbench_methods.splashsplat.flip.solver import (
    FlipSettings,
    FlipSolver,
    FlipTransport,
    gravity_in_voxels,
)
from splashbench_methods.splashsplat.motion.steps import FrameStep
from splashbench_methods.splashsplat.motion.velocity import control_shape, velocities_at

GRAVITY = np.array([0.0, 0.0, -500.0])  # voxels/s^2
CUBE = (32, 32, 32)


def nodes(shape: tuple[int, int, int]) -> np.ndarray:
    return np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), axis=-1).astype(np.float64)


def box(shape: tuple[int, int, int], low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
    """Walls around a box-shaped cavity."""
    x = nodes(shape)
    return np.minimum(x - np.array(low), np.array(high) - x).min(axis=-1).astype(np.float32)


def block(low: tuple[float, ...], high: tuple[float, ...], seed: int = 0, per_axis: int = 2) -> np.ndarray:
    """Jittered particles in a box, per_axis^3 to a voxel."""
    rng = np.random.default_rng(seed)
    counts = [round(per_axis * (b - a)) for a, b in zip(low, high)]
    lattice = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    size = (np.array(high) - np.array(low)) / counts
    return np.array(low) + (lattice + rng.random(lattice.shape)) * size


def energy(x: np.ndarray, v: np.ndarray) -> float:
    """Kinetic and potential energy per unit mass of a particle, summed."""
    return float(0.5 * (v**2).sum() - (x @ GRAVITY).sum())


def test_free_fall_is_exact_on_the_grid_and_beyond_it():
    x = block((10, 10, 20), (14, 14, 24))
    x[0] = [-5, 50, 3]
    v = np.broadcast_to([30.0, 0, 10], x.shape)
    F = np.broadcast_to(np.eye(3), (20, 3, 3))
    solver = FlipSolver(CUBE, GRAVITY)
    fallen, faster, deformed = solver.step(x, v, 0.1, F)
    np.testing.assert_allclose(fallen - x, np.broadcast_to([3, 0, 1 - 2.5], x.shape), atol=1e-10)
    np.testing.assert_allclose(faster, np.broadcast_to([30, 0, 10 - 50], x.shape), atol=1e-9)
    np.testing.assert_allclose(deformed, F, atol=1e-6)
    assert solver.report.substeps >= 4  # up to 54 voxels/s for 0.1 s


@pytest.mark.parametrize("low", [(1.5, 1.5, 1.5), (1.8, 2.1, 1.3)], ids=["on cell faces", "across cells"])
def test_liquid_at_rest_in_a_box_stays_at_rest_for_a_second(low):
    shape, high = (15, 13, 26), (12.3, 10.2, 24.5)
    walls = box(shape, low, high)
    x = start = block(low, (*high[:2], low[2] + 10))
    v = np.zeros_like(x)
    solver = FlipSolver(shape, GRAVITY, walls)
    for _ in range(10):
        x, v, _ = solver.step(x, v, 0.1)
        assert solver.report.divergence < 1e-3
    # Falling freely, it would be 250 voxels lower and 500 voxels/s fast.
    assert np.abs((x - start).mean(axis=0)).max() < 0.1
    assert np.sqrt((v**2).sum(axis=1).mean()) < 0.5
    # What is above or below the surface is a matter of cells: the topmost one reaches up to 11.5.
    assert np.quantile(start[:, 2], 0.995) - 0.05 < np.quantile(x[:, 2], 0.995) < 11.5
    assert sample(walls, x).min() > 0


def dam_break(steps: int, **settings) -> tuple[FlipSolver, list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """A column twice as high as wide, a = 8 voxels, let go at the end of a trough: the states after each 0.02 s."""
    shape = (44, 6, 22)
    walls = box(shape, (1.5, 1.5, 1.5), (42.5, 4.5, 30))
    chosen = FlipSettings(**settings)
    x = block((1.5, 1.5, 1.5), (9.5, 4.5, 17.5), per_axis=2 * chosen.grid_scale)
    v = np.zeros_like(x)
    solver = FlipSolver(shape, GRAVITY, walls, chosen)
    states = [(x, v)]
    for _ in range(steps):
        x, v, _ = solver.step(x, v, 0.02)
        states.append((x, v))
    return solver, states, walls


def front(x: np.ndarray) -> float:
    """How far the tongue has come, in column widths; the very first particles are spray."""
    return (np.quantile(x[:, 0], 0.995) - 1.5) / 8


def test_a_dam_breaks_as_fast_as_in_the_experiment():
    _, states, walls = dam_break(12)
    # Martin and Moyce (1952), n^2 = 2: Z = z / a at T = t sqrt(2 g / a); here T = 11.18 t.
    measured = {1.19: 1.44, 1.63: 1.89, 1.98: 2.33, 2.51: 3.00}
    times = np.sqrt(2 * 500 / 8) * 0.02 * np.arange(len(states))
    fronts = [front(x) for x, _ in states]
    for time, expected in measured.items():
        assert np.interp(time, times, fronts) == pytest.approx(expected, rel=0.08)
    energies = [energy(x, v) for x, v in states]
    assert (np.diff(energies) <= 1e-3 * energies[0]).all()
    assert all(sample(walls, x).min() >= 0 for x, _ in states[1:])


def test_a_finer_grid_gives_the_same_flow():
    coarse, fine = (dam_break(8, grid_scale=scale)[1] for scale in (1, 2))
    assert front(fine[-1][0]) == pytest.approx(front(coarse[-1][0]), rel=0.1)
    np.testing.assert_allclose(fine[-1][0].mean(axis=0), coarse[-1][0].mean(axis=0), atol=0.5)


def test_more_substeps_are_taken_when_asked_for():
    x = block((8, 8, 8), (12, 12, 12))
    counts = []
    for scale in (1.0, 2.0):
        solver = FlipSolver(CUBE, 0 * GRAVITY, settings=FlipSettings(substeps_scale=scale))
        solver.step(x, np.broadcast_to([100.0, 0, 0], x.shape), 0.1)
        counts.append(solver.report.substeps)
    assert counts == [10, 20]  # ten voxels, one at a time or half of one


def test_the_pressure_ends_at_its_tolerance_or_at_its_iterations():
    x = block((8, 8, 8), (24, 24, 24))
    v = 20 * (16 - x)  # shrinks, at a divergence of -60/s
    exact = FlipSolver(CUBE, 0 * GRAVITY, settings=FlipSettings(pressure_tolerance=1e-6))
    exact.step(x, v, 1e-4)
    assert exact.report.divergence < 1e-4
    assert 5 < exact.report.iterations < 200
    hasty = FlipSolver(CUBE, 0 * GRAVITY, settings=FlipSettings(pressure_iterations=3))
    hasty.step(x, v, 1e-4)
    assert hasty.report.iterations == 3
    assert hasty.report.divergence > 1


def test_a_collision_in_the_air_conserves_momentum():
    blobs = [block((6, 12, 12), (12, 20, 20)), block((16, 12, 12), (26, 18, 18), seed=1)]
    x = np.concatenate(blobs)
    v = np.concatenate([np.full(blobs[0].shape, [60.0, 0, 0]), np.full(blobs[1].shape, [-20.0, 0, 10])])
    momentum, kinetic = v.sum(axis=0), (v**2).sum()
    y, w, _ = FlipSolver(CUBE, np.zeros(3)).step(x, v, 0.12)
    assert (w**2).sum() < 0.8 * kinetic  # they did meet
    assert (y[: len(blobs[0]), 0].max()) > blobs[1][:, 0].min() - 3
    np.testing.assert_allclose(w.sum(axis=0), momentum, atol=0.05 * np.abs(v).sum(axis=0).max())


def test_a_pour_into_a_round_bowl_stays_in_it():
    x = nodes(CUBE)
    radius = np.linalg.norm(x - np.array([15.5, 15.5, 16]), axis=-1)
    shell = np.maximum(12 - radius, radius - 15)  # a shell three voxels thick ...
    walls = np.where(x[..., 2] > 16, np.maximum(shell, x[..., 2] - 16), shell).astype(np.float32)  # ... cut in half
    drop = block((13, 13, 6), (18, 18, 16))
    v = np.broadcast_to([10.0, 0, 0], drop.shape)
    solver = FlipSolver(CUBE, GRAVITY, walls)
    for _ in range(30):
        drop, v, _ = solver.step(drop, v, 0.03)
        assert sample(walls, drop).min() >= 0
    within = np.linalg.norm(drop - [15.5, 15.5, 16], axis=1) < 12
    assert within.mean() > 0.95
    # 250 cubic voxels fill a spherical cap of radius 12 up to 2.7 voxels, whose middle is 10.1 below the centre.
    assert drop[within, 2].mean() == pytest.approx(5.9, abs=1.0)


def test_gradients_of_the_flow_turn_carriers():
    x = block((8, 8, 8), (24, 24, 24))
    inner = np.linalg.norm(x - 16, axis=1) < 4
    x = np.concatenate([x[inner], x[~inner]])
    rate = 2.0
    v = rate * np.stack([-(x[:, 1] - 16), x[:, 0] - 16, 0 * x[:, 0]], axis=1)
    F = np.broadcast_to(np.eye(3), (int(inner.sum()), 3, 3))
    solver = FlipSolver(CUBE, np.zeros(3))
    for _ in range(5):
        x, v, F = solver.step(x, v, 0.01, F)
    # The corners fly off, which strains the middle a little.
    turned = np.array([[np.cos(0.1), -np.sin(0.1), 0], [np.sin(0.1), np.cos(0.1), 0], [0, 0, 1]])
    np.testing.assert_allclose(np.mean(F, axis=0), turned, atol=0.02)
    np.testing.assert_allclose(np.linalg.det(F), 1, atol=0.02)


def test_threads_change_nothing(monkeypatch):
    x = block((6, 6, 6), (22, 22, 14))
    v = 30 * np.sin(x[:, ::-1])
    F = np.broadcast_to(np.eye(3), (3000, 3, 3))
    walls = box(CUBE, (2.2, 2.2, 2.2), (29, 29, 40))
    results = []
    for threads in (1, 3):
        monkeypatch.setattr(parallel, "thread_count", lambda threads=threads: threads)
        results.append(FlipSolver(CUBE, GRAVITY, walls).step(x, v, 0.05, F))
    for one, three in zip(*results):
        np.testing.assert_array_equal(one, three)


def test_filling_covers_the_liquid_outside_the_walls():
    phi = (np.linalg.norm(nodes(CUBE) - 16, axis=-1) - 7).astype(np.float32)
    everywhere = FlipSolver(CUBE, GRAVITY).fill(phi, 1.0, np.random.default_rng(0))
    assert len(everywhere) == pytest.approx(8 * 4 / 3 * np.pi * 7**3, rel=0.03)
    np.testing.assert_allclose(everywhere.mean(axis=0), 16, atol=0.1)
    walls = (nodes(CUBE)[..., 2] - 16).astype(np.float32)
    finer = FlipSolver(CUBE, GRAVITY, walls, FlipSettings(grid_scale=2))
    above = finer.fill(phi, 1.0, np.random.default_rng(0))
    assert len(above) == pytest.approx(32 * 4 / 3 * np.pi * 7**3, rel=0.03)
    assert above[:, 2].min() > 16


def test_carriers_follow_the_simulation_by_their_number():
    phi = (np.linalg.norm(nodes(CUBE) - [16, 16, 24], axis=-1) - 4).astype(np.float32)
    solver = FlipSolver(CUBE, GRAVITY)
    ids = np.array([3, 5, 8], np.int32)
    start = np.array([[16, 16, 24], [18, 16, 24], [16, 14, 23]], np.float32)
    flow = FlipTransport(solver, phi, 1.0, ids, start, np.random.default_rng(0))
    control = np.broadcast_to(np.float32([2, 0, 0]), (*control_shape(CUBE, 4), 3))  # voxels per frame
    F = np.broadcast_to(np.eye(3, dtype=np.float32), (3, 3, 3))
    x, F = flow.forecast(ids, F, 0.05, FrameStep(control, 4))
    fall = 0.5 * 500 * 0.05**2
    np.testing.assert_allclose(x, start + np.array([2, 0, -fall]), atol=1e-4)
    # Carrier 5 is gone; the second frame lasts twice as long, and its fitted motion is not looked at.
    x, F = flow.forecast(ids[[0, 2]], F[[0, 2]], 0.1, FrameStep(0 * control, 4))
    np.testing.assert_allclose(x, start[[0, 2]] + np.array([6, 0, -9 * fall]), atol=1e-4)
    assert x.dtype == F.dtype == np.float32
    np.testing.assert_allclose(F, np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-5)


def test_velocities_are_read_off_the_control_grid():
    shape = control_shape(CUBE, 4)
    middles = nodes(shape) * 4 + 1.5
    points = np.random.default_rng(0).uniform(3, 26, (40, 3))
    slope = np.array([[0.1, 0, 0], [0, -0.2, 0.3], [0, 0, 0.4]])
    np.testing.assert_allclose(velocities_at(middles @ slope, 4, points), points @ slope, atol=1e-5)


def test_gravity_needs_scale_direction_and_times():
    class Known:
        name, gravity, metres_per_unit, times_source = "known", np.array([0.0, -1, 0]), 0.5, "scene.json"

    grid = Grid(np.zeros(3), 0.01, CUBE)
    np.testing.assert_allclose(gravity_in_voxels(Known(), grid), [0, -9.81 / 0.5 / 0.01, 0])
    Known.times_source = "nominal"
    with pytest.raises(SplashbenchError, match=r"known: FLIP needs times.*scene\.json"):
        gravity_in_voxels(Known(), grid)
    Known.metres_per_unit = None
    with pytest.raises(SplashbenchError, match=r"known: FLIP needs metres_per_unit.*scene\.json"):
        gravity_in_voxels(Known(), grid)
    Known.gravity = None
    with pytest.raises(SplashbenchError, match=r"needs gravity and metres_per_unit and times.*scene place-container"):
        gravity_in_voxels(Known(), grid)


def test_what_flip_lacks_is_said_before_the_background_is_fitted(balls_copy: Path):
    meta = json.loads((balls_copy / "scene.json").read_text())
    (balls_copy / "scene.json").write_text(json.dumps(meta | {"gravity": None}))
    run = Run(seed=0)
    with pytest.raises(SplashbenchError, match="FLIP needs gravity"):
        SplashSplat().fit(
            Scene.open(balls_copy).training(), SplashSplatConfig.preset("quick", {"variant": "flip"}), run
        )
    assert run.stages == {}

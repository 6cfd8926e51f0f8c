"""The solver's faults become one line; its results repeat; positions between snapshots are right."""

from __future__ import annotations

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from splashbench import child
from splashbench.errors import SplashbenchError
from splashbench.synth.imaging.geometry import bowl_mesh
from splashbench.synth.liquid import simulation
from splashbench.synth.liquid.simulation import Pour, check_libraries, start
from splashbench.synth.liquid.trajectory import Trajectory, assemble

QUICK = Pour(duration=0.45, emit_until=0.4, particle_radius=0.005)


@pytest.fixture(scope="module")
def trajectory(tmp_path_factory: pytest.TempPathFactory) -> Trajectory:
    if importlib.util.find_spec("pysplishsplash") is None:  # importing it here could end the test run
        pytest.skip("pysplishsplash is not installed (splashbench[synth])")
    return start(QUICK, bowl_mesh(), tmp_path_factory.mktemp("solver")).finish()


@pytest.mark.parametrize("missing", ["libGL.so.1", "libX11.so.6"])
def test_a_missing_system_library_is_named_with_its_package(missing: str) -> None:
    def load(name: str) -> None:
        if name == missing:
            raise OSError(f"{name}: cannot open shared object file")

    with pytest.raises(SplashbenchError, match=missing) as caught:
        check_libraries(load)
    assert "libgl1" in str(caught.value)
    assert "libx11-6" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(simulation, "_PACKAGES", ("no_such_package",))
    with pytest.raises(SplashbenchError, match=r"no_such_package.*pip install .*\[synth\]"):
        start(QUICK, bowl_mesh(), tmp_path)


def test_a_crash_of_the_solver_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stub = tmp_path / "crash.sh"
    stub.write_text("#!/bin/sh\nkill -SEGV $$\n")
    stub.chmod(0o755)
    monkeypatch.setattr(child.sys, "executable", str(stub))
    with pytest.raises(SplashbenchError, match="signal 11") as caught:
        start(QUICK, bowl_mesh(), tmp_path).finish()
    assert "\n" not in str(caught.value)


def test_a_solver_that_hangs_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stub = tmp_path / "hang.sh"
    stub.write_text("#!/bin/sh\nexec sleep 60\n")
    stub.chmod(0o755)
    monkeypatch.setattr(child.sys, "executable", str(stub))
    with pytest.raises(SplashbenchError, match="had not finished"):
        start(QUICK, bowl_mesh(), tmp_path, timeout=0.5).finish()


def test_what_the_solver_says_last_reaches_the_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stub = tmp_path / "complain.sh"
    stub.write_text("#!/bin/sh\necho first >&2\necho no module named pysplishsplash >&2\nexit 1\n")
    stub.chmod(0o755)
    monkeypatch.setattr(child.sys, "executable", str(stub))
    with pytest.raises(SplashbenchError, match="no module named pysplishsplash"):
        start(QUICK, bowl_mesh(), tmp_path).finish()


def test_the_same_pour_twice_is_the_same_bit_for_bit(trajectory: Trajectory, tmp_path: Path) -> None:
    again = start(QUICK, bowl_mesh(), tmp_path).finish()
    assert np.array_equal(again.times, trajectory.times)
    assert np.array_equal(again.positions, trajectory.positions)
    assert np.array_equal(again.velocities, trajectory.velocities)


def test_liquid_falls_into_the_bowl(trajectory: Trajectory) -> None:
    assert not trajectory.at(-0.01)[2].any()
    early, late = trajectory.at(0.05), trajectory.at(0.44)
    assert 0 < early[2].sum() < late[2].sum()
    assert early[0][early[2], 1].min() > 0.2
    in_bowl = np.hypot(late[0][:, 0], late[0][:, 2]) < 0.1
    assert (late[2] & in_bowl & (late[0][:, 1] < 0.09)).sum() > 30
    assert late[0][late[2], 1].min() > 0


def test_free_fall_between_snapshots_is_exact() -> None:
    g = np.array([0, -9.81, 0])
    times = np.array([0.0, 0.1, 0.2])
    start_velocity = np.array([0.5, 1.0, 0.2])
    positions = np.array([start_velocity * t + g * t**2 / 2 + [0, 0.5, 0] for t in times], np.float32)[:, None]
    velocities = np.array([start_velocity + g * t for t in times], np.float32)[:, None]
    fall = Trajectory(
        times, positions, velocities, np.array([0]), np.array([3]), np.zeros(3, np.float32), np.ones(3, np.float32)
    )
    for t in (0.03, 0.1, 0.17):
        position, velocity, active = fall.at(t)
        assert active.all()
        assert np.allclose(position[0], start_velocity * t + g * t**2 / 2 + [0, 0.5, 0], atol=1e-6)
        assert np.allclose(velocity[0], start_velocity + g * t, atol=1e-4)


def test_positions_between_snapshots_are_good_to_a_fifth_of_a_millimetre(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every step of the solver against the curve through the snapshots alone.

    Liquid just leaving the nozzle moves by jumps; it lies above every camera's view and is left out.
    """
    spacing = simulation.SNAPSHOT_SECONDS
    monkeypatch.setattr(simulation, "SNAPSHOT_SECONDS", 1e-6)
    steps = start(dataclasses.replace(QUICK, particle_radius=0.004), bowl_mesh(), tmp_path).finish()
    kept = [0]
    for k, time in enumerate(steps.times):
        if time >= steps.times[kept[-1]] + spacing:
            kept.append(k)
    snapshots = Trajectory(
        steps.times[kept],
        steps.positions[kept],
        steps.velocities[kept],
        np.minimum(np.searchsorted(kept, steps.born), len(kept) - 1),
        np.searchsorted(kept, steps.died),
        steps.nozzle,
        steps.direction,
    )
    errors = []
    for k in set(range(kept[-1])) - set(kept):
        positions, _, active = snapshots.at(steps.times[k])
        released = steps.times[k] - steps.times[steps.born] > 0.03
        errors.append(np.linalg.norm(positions - steps.positions[k], axis=1)[active & released])
    gathered = np.concatenate(errors)
    assert len(gathered) > 10_000
    assert np.quantile(gathered, 0.99) < 2e-4
    assert np.median(gathered) < 1e-5


def test_particles_are_followed_by_id_and_leave_for_good() -> None:
    """Snapshots come in any order of ids; a particle outside the region is gone, also if it came back."""
    snapshots = {
        "times": np.array([0.0, 0.1, 0.2]),
        "counts": np.array([1, 2, 2]),
        "ids": np.array([7, 9, 7, 7, 9]),
        "positions": np.array([[0, 0.3, 0], [0.1, 0.2, 0], [0, 0.2, 0], [0, 0.1, 0], [0.9, 0.1, 0]], np.float32),
        "velocities": np.zeros((5, 3), np.float32),
    }
    made = assemble(snapshots, np.zeros(3, np.float32), np.array([0, -1, 0], np.float32))
    assert made.born.tolist() == [0, 1]
    assert made.died.tolist() == [3, 2]
    assert made.positions[:, 0, 1].tolist() == pytest.approx([0.3, 0.2, 0.1])


def test_a_simulation_that_went_wrong_is_refused() -> None:
    snapshots = {
        "times": np.array([0.0]),
        "counts": np.array([1]),
        "ids": np.array([0]),
        "positions": np.array([[0, np.nan, 0]], np.float32),
        "velocities": np.zeros((1, 3), np.float32),
    }
    with pytest.raises(ValueError, match="not finite"):
        assemble(snapshots, np.zeros(3, np.float32), np.zeros(3, np.float32))

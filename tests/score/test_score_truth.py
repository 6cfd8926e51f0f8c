"""Scoring against true particles: the oracle is perfect, a scene without a truth gives none, every null says why."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.harness.oracle import write_oracle
from splashbench.scene import Particles, Scene, SignedDistance
from splashbench.score import Result, score_submission, shared_fields
from splashbench.score.metrics import TRUTH_METRICS
from splashbench.score.truth.comparison import NO_TRUTH, oracle_geometry, true_geometry, true_spacing
from splashbench.submission import Submission, check_submission, seal


@pytest.fixture(scope="module")
def sealed(balls: Scene, tmp_path_factory: pytest.TempPathFactory) -> Submission:
    return write_oracle(balls, tmp_path_factory.mktemp("truth") / "oracle", geometry=oracle_geometry)


@pytest.fixture(scope="module")
def truth(balls: Scene) -> Particles:
    particles = balls.truth_particles()
    assert particles is not None
    return particles


def test_the_oracle_is_perfect_against_the_truth(balls: Scene, sealed: Submission, quiet: Any, tmp_path: Path) -> None:
    result = score_submission(balls, sealed, track=quiet)
    values = {name: result.value(name) for name in TRUTH_METRICS}
    assert values["sdf_iou"] == values["sdf_recall"] == values["sdf_precision"] == 1.0
    assert values["velocity_coverage"] == 1.0
    # Distances are stored in sixteenths of a voxel, and rise by a little over a half per voxel at the surface.
    assert values["surface_chamfer"] < 0.1
    for name in ("velocity_epe", "velocity_epe_relative", "airborne_epe_relative"):
        assert values[name] == pytest.approx(0.0, abs=1e-3)
        assert len(result.metrics[name].frames) == balls.n_frames
        assert result.metrics[name].frames[-1] is None
    assert result.metrics["surface_chamfer"].unit == "voxels"
    assert result.digests.truth is not None
    assert Result.load(result.save(tmp_path)) == result
    assert check_submission(sealed.directory, balls) == []


def test_particles_alone_give_nearly_the_same_liquid(balls: Scene, truth: Particles, fake: Any, quiet: Any) -> None:
    fields = shared_fields(balls)
    alone = score_submission(balls, fake(balls, particle_set=truth), track=quiet, fields=fields)
    assert alone.metrics["sdf_iou"].value > 0.65
    shifted = Particles(truth.positions + np.float32(5 * fields().voxel), truth.active, truth.velocities)
    moved = score_submission(balls, fake(balls, particle_set=shifted), track=quiet, fields=fields)
    assert moved.metrics["sdf_iou"].value < alone.metrics["sdf_iou"].value - 0.2
    assert moved.metrics["surface_chamfer"].value > alone.metrics["surface_chamfer"].value + 1


def test_no_motion_scores_one_and_steps_are_compared_with_steps(
    balls: Scene, truth: Particles, fake: Any, quiet: Any
) -> None:
    still = Particles(truth.positions, truth.active, 0 * truth.positions)
    result = score_submission(balls, fake(balls, particle_set=still), track=quiet)
    assert result.value("velocity_epe_relative") == 1.0
    assert result.value("airborne_epe_relative") == 1.0
    # Everything falls freely here: the displacement over a step is not the velocity at its start times the step.
    followed = Particles(truth.positions, truth.active)
    assert score_submission(balls, fake(balls, particle_set=followed), track=quiet).value(
        "velocity_epe"
    ) == pytest.approx(0.0, abs=1e-3)


def test_a_scene_without_true_particles_has_no_score_against_them(balls_copy: Path, fake: Any, quiet: Any) -> None:
    scene = Scene.open(balls_copy)
    particles = scene.truth_particles()
    (balls_copy / "truth" / "particles.npz").unlink()
    result = score_submission(scene, fake(scene, particle_set=particles), track=quiet)
    assert all(result.metrics[name].reason == NO_TRUTH for name in TRUTH_METRICS)
    assert result.digests.truth is None
    assert result.value("uniformity") is not None
    oracle = write_oracle(scene, balls_copy.parent / "oracle", geometry=oracle_geometry)
    assert not (oracle.directory / "geometry.npz").exists()


def test_every_null_against_the_truth_says_why(balls: Scene, truth: Particles, fake: Any, quiet: Any) -> None:
    fields = shared_fields(balls)

    def reasons(**parts: Any) -> dict[str, str | None]:
        result = score_submission(balls, fake(balls, **parts), track=quiet, fields=fields)
        return {name: result.metrics[name].reason for name in TRUTH_METRICS}

    nothing = reasons()
    assert nothing["sdf_iou"] == "no geometry, and the submission has no particles"
    assert nothing["velocity_epe"] == "the submission has no particles"
    geometry = true_geometry(balls, fields())
    assert geometry is not None
    short = SignedDistance(geometry.phi[:-1], geometry.origin, geometry.voxel)
    assert "7 instants, the scene 8 frames" in str(reasons(signed_distance=short)["surface_chamfer"])
    assert reasons(signed_distance=geometry)["surface_chamfer"] is None
    # Rows that live for one frame have no velocity.
    turns = np.arange(balls.n_frames)[:, None] % 2 == np.arange(truth.active.shape[1])[None] % 2
    lone = reasons(particle_set=Particles(truth.positions, truth.active & turns))
    assert lone["velocity_epe"] == "no reconstructed particle with a velocity comes near a true one"
    assert lone["velocity_coverage"] is None
    away = Particles(truth.positions + 1e3, truth.active, truth.velocities)
    assert (
        reasons(particle_set=away)["sdf_precision"] == "nothing is reconstructed where there is true liquid to compare"
    )


def test_without_gravity_nothing_is_known_to_fall(balls_copy: Path, fake: Any, quiet: Any) -> None:
    path = balls_copy / "scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"gravity": None}))
    scene = Scene.open(balls_copy)
    result = score_submission(scene, fake(scene, particle_set=scene.truth_particles()), track=quiet)
    assert "gravity" in str(result.metrics["airborne_epe_relative"].reason)
    assert result.value("velocity_epe") == pytest.approx(0.0, abs=1e-3)


def test_the_radius_of_true_particles_is_the_stated_one_else_estimated(balls_copy: Path) -> None:
    scene = Scene.open(balls_copy)
    side = np.arange(5) * 0.04
    lattice = np.stack(np.meshgrid(side, side, side), axis=-1).reshape(1, -1, 3)
    particles = Particles(lattice, np.ones(lattice.shape[:2], bool))
    assert true_spacing(scene, particles) == pytest.approx(0.0276)
    path = balls_copy / "scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"provenance": {"particle_radius": "thick"}}))
    assert true_spacing(Scene.open(balls_copy), particles) == pytest.approx(0.04)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"phi": np.zeros((8, 4, 4, 4), np.float32)}, "phi is float32"),
        ({"phi": np.zeros((8, 4, 4), np.int8)}, "phi has 3 dimensions, not 4"),
        ({"phi": np.zeros((8, 4, 1, 4), np.int8)}, "two nodes a side"),
        ({"phi": np.zeros((3, 4, 4, 4), np.int8)}, "has 3 instants, the scene 8"),
        ({"origin": np.zeros(2)}, "origin"),
        ({"origin": np.array([0, np.nan, 0])}, "origin has NaN"),
        ({"origin": np.array([0, 1e300, 0])}, "origin"),
        ({"voxel": np.array(0.0)}, "voxel is 0"),
        ({"voxel": np.array(1e-300)}, "voxel is 1e-300"),
        ({"phi": np.array([{}], object)}, "without pickles"),
        ({"phi": None}, "lacks the array 'phi'"),
    ],
)
def test_geometry_from_a_stranger_is_one_line(
    balls: Scene, sealed: Submission, tmp_path: Path, changes: dict[str, Any], fault: str
) -> None:
    arrays = {"phi": np.zeros((8, 4, 4, 4), np.int8), "origin": np.zeros(3), "voxel": np.array(0.1)} | changes
    path = tmp_path / "geometry.npz"
    np.savez_compressed(path, **{name: array for name, array in arrays.items() if array is not None})
    seal(tmp_path, sealed.identity, sealed.record)
    faults = [line for line in check_submission(tmp_path, balls) if "geometry.npz" in line]
    assert len(faults) == 1
    assert fault in faults[0]
    if "instants" not in fault:
        with pytest.raises(SplashbenchError, match=r"geometry\.npz"):
            Submission.open(tmp_path).geometry()


def test_geometry_that_unpacks_to_too_much_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splashbench.scene.geometry.MAX_BYTES", 1 << 10)
    path = tmp_path / "geometry.npz"
    np.savez_compressed(path, phi=np.zeros((1, 4, 4, 4), np.int8), origin=np.zeros(3), voxel=0.1)
    assert SignedDistance.load(path).n_frames == 1
    np.savez_compressed(path, phi=np.zeros((2, 128, 128, 128), np.int8), origin=np.zeros(3), voxel=0.1)
    with pytest.raises(SplashbenchError, match=r"geometry\.npz unpacks to more than"):
        SignedDistance.load(path)

"""What a method says of the liquid's geometry reaches the submission, or ends the run with a status."""

from pathlib import Path

from splashbench.harness.runner import run_method
from splashbench.scene import Scene
from splashbench.scene.particles import MAX_PARTICLES
from splashbench.submission import Status, check_submission

METHODS = Path(__file__).with_name("geometry_methods.py")


def test_a_signed_distance_is_handed_in(balls_directory: Path, balls: Scene, tmp_path: Path) -> None:
    submission = run_method(f"{METHODS}:Geometry", balls_directory, tmp_path / "out", timing_frames=0)
    assert submission.status == Status.OK
    geometry = submission.geometry()
    assert geometry is not None
    assert geometry.phi.shape == (balls.n_frames, 6, 6, 6)
    assert geometry.phi[0, 2, 2, 2] == -8
    assert geometry.origin.tolist() == [0.1, 0.2, 0.3]
    assert check_submission(tmp_path / "out", balls) == []


def test_a_signed_distance_for_other_timesteps_is_no_run(balls_directory: Path, tmp_path: Path) -> None:
    submission = run_method(f"{METHODS}:ShortGeometry", balls_directory, tmp_path / "out", timing_frames=0)
    assert submission.status == Status.INCOMPLETE
    assert "covers 7 of 8 timesteps" in submission.reason
    assert not (tmp_path / "out" / "geometry.npz").exists()


def test_of_more_particles_than_a_file_holds_an_even_share_is_kept(balls_directory: Path, tmp_path: Path) -> None:
    submission = run_method(f"{METHODS}:Dust", balls_directory, tmp_path / "out", timing_frames=0)
    assert submission.status == Status.OK, submission.reason
    particles = submission.particles()
    assert particles is not None
    assert particles.count == MAX_PARTICLES
    assert particles.positions[0, -1, 0] >= MAX_PARTICLES - 1
    said = f"{MAX_PARTICLES} of {MAX_PARTICLES + 1}, an even share: a file holds no more of them"
    assert submission.record.notes["particles"] == said

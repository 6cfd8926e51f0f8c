"""Submissions: refused when tampered with, and every fault listed at once."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from splashbench.errors import SplashbenchError
from splashbench.files import write_png
from splashbench.scene import Particles, Scene
from splashbench.submission import Identity, Record, Submission, check_submission, to_8bit


def test_a_changed_render_is_refused(copy: Path) -> None:
    write_png(copy / "renders" / "6" / "000003.png", np.zeros((64, 96, 3), np.uint8))
    with pytest.raises(SplashbenchError, match=r"renders/6/000003.png does not match .* refused"):
        Submission.open(copy)


def test_changed_costs_are_refused(copy: Path) -> None:
    path = copy / "record.json"
    path.write_text(path.read_text().replace('"fit_seconds": null', '"fit_seconds": 0.1'))
    with pytest.raises(SplashbenchError, match=r"record.json does not match"):
        Submission.open(copy)


def test_added_removed_and_linked_files_are_refused(copy: Path) -> None:
    (copy / "extra.txt").write_text("more")
    with pytest.raises(SplashbenchError, match=r"extra.txt is not listed"):
        Submission.open(copy)
    (copy / "extra.txt").unlink()
    target = copy / "alpha" / "7" / "000000.png"
    target.rename(copy.parent / "elsewhere.png")
    with pytest.raises(SplashbenchError, match=r"alpha/7/000000.png is missing"):
        Submission.open(copy)
    target.symlink_to(copy.parent / "elsewhere.png")
    with pytest.raises(SplashbenchError, match="is a link"):
        Submission.open(copy)


def test_a_submission_without_digests_is_refused(copy: Path) -> None:
    (copy / "SHA256SUMS").unlink()
    with pytest.raises(SplashbenchError, match="SHA256SUMS is missing"):
        Submission.open(copy)


def test_check_lists_every_fault(copy: Path, balls: Scene) -> None:
    write_png(copy / "renders" / "6" / "000001.png", np.zeros((10, 10, 3), np.uint8))
    (copy / "alpha" / "7" / "000002.png").unlink()
    faults = "\n".join(check_submission(copy, balls))
    assert "renders/6/000001.png does not match its digest" in faults
    assert "renders/6/000001.png is 10x10, not 96x64" in faults
    assert "alpha/7/000002.png is missing" in faults


def test_check_counts_the_timesteps_of_arrays(copy: Path, balls: Scene) -> None:
    n = balls.n_frames
    Particles(np.zeros((n - 1, 1, 3)), np.ones((n - 1, 1), bool)).save(copy / "particles.npz")
    assert f"{copy / 'particles.npz'} has {n - 1} instants, the scene {n}" in check_submission(copy, balls)
    Particles(np.zeros((n, 1, 3)), np.ones((n, 1), bool)).save(copy / "particles.npz")
    assert not any("instants" in fault for fault in check_submission(copy, balls))


def test_check_sees_another_scene(copy: Path, balls_copy: Path) -> None:
    write_png(balls_copy / "seg" / "1" / "000000.png", np.full((64, 96), 255, np.uint8))
    faults = check_submission(copy, Scene.open(balls_copy))
    assert faults == [f"{copy} was made for another version of scene balls"]


def test_a_folder_that_is_no_submission_is_told(tmp_path: Path) -> None:
    assert "no submission" in check_submission(tmp_path)[0]


def test_an_identity_from_elsewhere_is_validated(copy: Path) -> None:
    path = copy / "submission.toml"
    path.write_text(path.read_text().replace('method = "oracle"', 'method = "../../etc"'))
    with pytest.raises(SplashbenchError, match=r"submission.toml: method"):
        Submission.open(copy, verify=False)


def test_figures_under_their_old_names_are_still_read() -> None:
    assert Record.model_validate_json('{"carriers_per_frame": 12.5}').particles_per_frame == 12.5
    claims = Identity(method="a", scene="b", scene_digest="0" * 64, claimed={"carriers_per_frame": 3.0, "psnr": 20.0})
    assert claims.claimed == {"particles_per_frame": 3.0, "psnr": 20.0}
    with pytest.raises(ValidationError, match="a list"):
        Record.model_validate(["a list"])


def test_eight_bits_round_and_clip() -> None:
    assert to_8bit(np.array([-0.1, 0.0, 0.5, 1.0, 1.2])).tolist() == [0, 0, 128, 255, 255]

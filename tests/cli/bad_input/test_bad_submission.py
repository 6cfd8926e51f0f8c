"""Damaged and forged submissions: one line that names the file, exit status 1, and no result."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splashbench.cli.main import main
from splashbench.files import sha256_file
from splashbench.scene import Scene
from splashbench.submission import Submission, seal

Fails = Callable[..., str]


def reseal(directory: Path, **record: object) -> None:
    """Make the digests hold again after damage, as a forger would."""
    opened = Submission.open(directory, verify=False)
    seal(directory, opened.identity, opened.record)
    if record:
        path = directory / "record.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | record))
        sums = directory / "SHA256SUMS"
        sums.write_text("".join(line for line in sums.read_text().splitlines(True) if "record.json" not in line))
        sums.write_text(sums.read_text() + f"{sha256_file(path)}  record.json\n")


def edit(path: Path, change: Callable[[dict], object]) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def test_a_thousand_missing_files_are_one_line_in_score_and_all_in_check(
    balls_directory: Path, submission: Path, tmp_path: Path, fails: Fails, capsys: pytest.CaptureFixture[str]
) -> None:
    with (submission / "SHA256SUMS").open("a") as sums:
        sums.writelines(f"{'0' * 64}  renders/8/{t:06d}.png\n" for t in range(1000))
    line = fails("score", submission, "--scene", balls_directory, "--out", tmp_path / "results")
    assert "renders/8/000000.png is missing (and 999 more)" in line
    assert not (tmp_path / "results").exists()
    assert main(["check", str(submission), "--scene", str(balls_directory)]) == 1
    assert capsys.readouterr().err.count("is missing") == 1000


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("submission.toml", lambda p: p.write_bytes(b"\xff\xfe"), "cannot be read as TOML"),
        ("submission.toml", lambda p: p.write_text("a = " + "[" * 100_000), "cannot be read as TOML"),
        ("submission.toml", lambda p: p.write_text(p.read_text().replace('"oracle"', '"../../x"')), "method: "),
        ("record.json", lambda p: edit(p, lambda d: d.update(fit_seconds=float("inf"))), "fit_seconds: "),
        ("record.json", lambda p: edit(p, lambda d: d.update(peak_memory_bytes=10**400)), "peak_memory_bytes: "),
        ("record.json", lambda p: edit(p, lambda d: d.update(status="great")), "status: "),
    ],
)
def test_a_forged_description_is_named(
    submission: Path, fails: Fails, name: str, damage: Callable[[Path], object], message: str
) -> None:
    damage(submission / name)
    line = fails("check", submission)
    assert name in line
    assert message in line


def test_particles_beyond_float32_are_refused(
    balls_directory: Path, submission: Path, tmp_path: Path, fails: Fails
) -> None:
    np.savez(submission / "particles.npz", positions=np.full((8, 2, 3), 1e300), active=np.ones((8, 2), bool))
    reseal(submission)
    assert "particles.npz: positions has entries beyond" in fails("check", submission)
    line = fails("score", submission, "--scene", balls_directory, "--out", tmp_path / "results")
    assert "particles.npz" in line
    assert not (tmp_path / "results").exists()


def test_a_strangers_reason_stays_on_one_line_and_off_the_terminal(
    balls_directory: Path, submission: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in ("renders", "alpha"):
        shutil.rmtree(submission / folder)
    reseal(submission, status="crashed", reason="first\nsecond \x1b[31m")
    reseal(submission)
    words = ["score", submission, "--scene", balls_directory, "--out", tmp_path / "results"]
    assert main([str(word) for word in words]) == 0
    errors = capsys.readouterr().err
    assert "first second ?[31m" in errors
    assert "\x1b" not in errors


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("x", "--set 'x' is not KEY=VALUE; there are version, psnr_cap_db"),
        ("=1", "--set '=1' is not KEY=VALUE"),
        ("psnr_cap_db=inf", "--set psnr_cap_db: "),
        ("psnr_cap_db=nan", "--set psnr_cap_db: "),
        ("grid_cells=999999999", "--set grid_cells: "),
        ("ssim_sigma=1e308", "--set ssim_sigma: "),
        ("nothing=1", "--set nothing: the protocol has no such setting; there are version"),
        ("grid_cell=50", "--set grid_cell: the protocol has no such setting; did you mean 'grid_cells'?"),
    ],
)
def test_a_bad_setting_of_the_protocol_is_named(
    balls_directory: Path, submission: Path, tmp_path: Path, fails: Fails, change: str, message: str
) -> None:
    words = ["score", submission, "--scene", balls_directory, "--out", tmp_path / "results", "--set", change]
    assert message in fails(*words)
    assert not (tmp_path / "results").exists()


def test_a_view_smaller_than_the_window_is_named(
    balls_directory: Path, submission: Path, tmp_path: Path, fails: Fails
) -> None:
    words = ["score", submission, "--scene", balls_directory, "--out", tmp_path / "results", "--set", "ssim_sigma=50"]
    line = fails(*words)
    assert "ims/6/" in line
    assert "SSIM needs images of more than" in line


def test_a_mask_of_the_wrong_size_ends_scoring_without_a_result(
    balls_copy: Path, submission: Path, tmp_path: Path, fails: Fails
) -> None:
    Image.new("L", (10, 20)).save(balls_copy / "seg" / "6" / "000002.png")
    assert "seg/6/000002.png is 10x20" in fails("scene", "check", balls_copy)
    # The forged submission says it is of the damaged scene.
    text = (submission / "submission.toml").read_text()
    digest = Submission.open(submission).identity.scene_digest
    (submission / "submission.toml").write_text(text.replace(digest, Scene.open(balls_copy).digest))
    reseal(submission)
    assert "seg/6/000002.png" in fails("score", submission, "--scene", balls_copy, "--out", tmp_path / "results")
    assert not (tmp_path / "results").exists()


def test_results_do_not_go_into_a_sealed_submission(submission: Path, balls_directory: Path, fails: Fails) -> None:
    before = sorted(path.name for path in submission.iterdir())
    for option, place in (("--out", submission / "results"), ("--sheet", submission / "sheet.png")):
        words = ["--out", submission.parent / "results"] if option == "--sheet" else []
        line = fails("score", submission, "--scene", balls_directory, *words, option, place)
        assert "whose files are sealed" in line
    assert sorted(path.name for path in submission.iterdir()) == before

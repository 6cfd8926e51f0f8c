"""Official models through the commands: trained, imported, checked and scored."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path

import numpy as np
import official_layouts as layouts
import pytest
from official_comparison import (
    anchor_rows,
    assert_same_image,
    expected_deformable,
    rows_of,
)

from splashbench.cli.main import main
from splashbench.files import read_image, read_json
from splashbench.harness.external.importers import load_importer, registered_importers
from splashbench.observe import initial_points
from splashbench.scene import Scene
from splashbench.scene.export import export_scene
from splashbench.submission import Submission
from splashbench.synth.balls import write_balls_scene

POINTS = 20


def _leaves(trained: Path) -> str:
    """A command that stands in for a training: it leaves what is in `trained`."""
    return shlex.join([sys.executable, layouts.__file__, "{scene}", "{out}", str(trained)])


def _checked_and_scored(
    scene: Scene, folder: Path, capsys: pytest.CaptureFixture[str], *options: str
) -> tuple[Path, dict[str, float]]:
    """A code that leaves `folder`/trained, through run, check and score: the submission, and its figures."""
    out = folder / "submission"
    arguments = ["run-external", str(scene.directory), str(out), "--name", "theirs", *options]
    arguments += ["--command", _leaves(folder / "trained"), "--points", str(POINTS), "--timing-frames", "1", "--json"]
    assert main(arguments) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "ok"
    assert main(["check", str(out), "--scene", str(scene.directory)]) == 0
    capsys.readouterr()
    assert main(["score", str(out), "--scene", str(scene.directory), "--out", str(folder / "r"), "--json"]) == 0
    (result,) = json.loads(capsys.readouterr().out)["results"]
    assert Submission.open(out).identity.mixed  # the importer says so
    return out, result["metrics"]


def test_the_command_trains_imports_checks_and_scores(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "deformable_3dgs" in registered_importers()
    balls, nerfies = write_balls_scene(tmp_path / "balls", n_frames=3), tmp_path / "NeRF" / "balls"
    export_scene(balls, nerfies, "nerfies", initial_points(balls, POINTS))
    rng = np.random.default_rng(0)
    rows, network = layouts.points_of(nerfies, rng), layouts.deform_network(rng, scale=0.01)
    layouts.write_deformable(tmp_path / "trained", rows, network)
    out, metrics = _checked_and_scored(balls, tmp_path, capsys, "--format", "nerfies", "--import", "deformable_3dgs")
    assert metrics["psnr"] > 5
    assert metrics["primitives_per_frame"] == 40
    # The picture that was scored is the one of the published formulas.
    share = (balls.times[1] - balls.times[0]) / (balls.times[-1] - balls.times[0])
    box = read_json(nerfies / "scene.json")
    wanted = expected_deformable(np.float32(rows), network, balls.cameras["7"], float(share), box)
    got = read_image(out / "renders" / "7" / "000001.png") / 255
    assert_same_image(got, np.round(wanted * 255) / 255, 1.01 / 255)


@pytest.mark.parametrize(("importer", "layout"), [("spacetime_gaussians", "colmap"), ("scaffold_4d", "blender")])
def test_the_other_codes_take_the_same_road(
    importer: str, layout: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    balls, rng = write_balls_scene(tmp_path / "balls", n_frames=3), np.random.default_rng(0)
    if importer == "spacetime_gaussians":
        layouts.write_spacetime(tmp_path / "trained", rows_of(layouts.LITE, rng, 40), None, duration=3)
    else:
        layouts.write_scaffold(tmp_path / "trained", anchor_rows(rng), layouts.scaffold_heads(rng))
    options = ("--format", layout, "--import", importer, "--blank-test-images")
    out, metrics = _checked_and_scored(balls, tmp_path, capsys, *options)
    assert metrics["psnr"] > 5
    picture = read_image(out / "renders" / "7" / "000001.png")
    assert picture.std() > 5  # something is drawn


@pytest.mark.slow
def test_a_model_that_was_trained_before_is_imported_without_a_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    balls = write_balls_scene(tmp_path / "balls", n_frames=3)
    layouts.write_spacetime(tmp_path / "trained", rows_of(layouts.LITE, np.random.default_rng(0), 40), None, duration=3)
    command = _leaves(tmp_path / "trained")
    common = ["--name", "theirs", "--format", "colmap", "--import", "spacetime_gaussians", "--points", str(POINTS)]
    submissions = []
    for name, how in (("run", ["--command", command]), ("taken", ["--trained", str(tmp_path / "trained")])):
        out = tmp_path / name
        assert main(["run-external", str(balls.directory), str(out), *common, *how, "--timing-frames", "1"]) == 0
        submissions.append(Submission.open(out))
    run, taken = submissions
    for path in sorted((tmp_path / "run" / "renders").rglob("*.png")):
        other = tmp_path / "taken" / path.relative_to(tmp_path / "run")
        assert path.read_bytes() == other.read_bytes()
    assert run.record.fit_seconds is not None
    assert (taken.record.fit_seconds, taken.record.peak_memory_bytes) == (None, None)
    assert taken.record.storage_bytes == run.record.storage_bytes
    assert taken.identity.settings["trained"] is True
    assert str(tmp_path) not in (tmp_path / "taken" / "submission.toml").read_text()
    capsys.readouterr()
    for how, said in ((tmp_path / "none", "is not a folder; give the one that the code left its model in"),
                      (tmp_path / "balls", "let the code save its last iteration")):  # fmt: skip
        assert main(["run-external", str(balls.directory), str(tmp_path / "x"), *common, "--trained", str(how)]) == 1
        assert said in capsys.readouterr().err


def test_importers_are_there_and_say_what_they_read() -> None:
    for name in ("deformable_3dgs", "scaffold_4d", "spacetime_gaussians"):
        importer = load_importer(name)
        assert importer.id == name
        assert importer.formats

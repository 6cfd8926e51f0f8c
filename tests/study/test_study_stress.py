"""`splashbench study stress`: the grid is run once, failures keep nothing, and what is wrong is one line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from splashbench.cli.main import main
from splashbench.files import write_png
from splashbench.scene import Scene
from splashbench.study.stress import make_stress_plan

METHODS = Path(__file__).with_name("study_methods.py")
CAUTIOUS, GREY = f"{METHODS}:Cautious", f"{METHODS}:Grey"
KINDS = ["exposure", "clock_offset"]


@pytest.fixture(scope="module")
def study(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stress study of two methods; clock offsets of half a frame and less are left out."""
    out = tmp_path_factory.mktemp("stress") / "out"
    command = ["study", "stress", str(out), "--methods", CAUTIOUS, GREY, "--scenes", str(balls_directory)]
    assert main([*command, "--kinds", *KINDS, "--severities", "1", "3", "5"]) == 0
    return out


def test_what_methods_keep_is_told(study: Path) -> None:
    runs = pd.read_csv(study / "retention.csv")
    psnr = runs[runs.metric == "psnr"].set_index(["method", "kind", "severity"]).retention
    # The grey method never looks at a photograph, so that nothing harms it.
    assert (psnr["grey"] == 1).all()
    assert psnr["cautious", "exposure", 5] == 0.0
    stability = pd.read_csv(study / "stability.csv").set_index(["method", "metric"])
    assert stability.loc[("grey", "psnr"), "S"] == 1
    assert stability.loc[("cautious", "psnr"), "failed"] > 0
    assert stability.loc[("cautious", "psnr"), "CVaR10"] == 0
    assert stability.loc[("cautious", "psnr"), "runs"] == stability.loc[("grey", "psnr"), "runs"] == len(psnr) / 2


def test_the_page_says_where_methods_break_and_which_runs_failed(study: Path) -> None:
    page = (study / "stability.md").read_text(encoding="utf-8")
    assert "## By miou" in page
    assert "## By psnr" in page
    assert "cautious.exposure.5, seed 0: crashed: RuntimeError: so bright, and so dark" in page
    assert "- clock_offset 8 ms: balls: clock_offset 8 ms: frames were recorded 57.5 ms apart" in page
    # What was run, told and drawn, and where.
    assert "- grey: version 3, preset best" in page
    assert "- Told besides images, masks and cameras: " in page
    assert "- Seeds: 0" in page
    assert "- Machine: " in page
    assert (study / "retention.png").stat().st_size > 10_000
    points = pd.read_csv(study / "breakdown.csv")
    broken = points[(points.method == "cautious") & (points.metric == "psnr") & (points.kind == "exposure")]
    assert 0 < broken.point.iloc[0] < 1.5
    whole = points[(points.method == "grey") & (points.metric == "psnr") & (points.kind == "exposure")]
    assert whole.point.isna().all()
    assert set(points.kind) == set(KINDS)
    assert set(points[points.kind == "clock_offset"].amount) == {0, 33, 100}


def test_a_second_time_nothing_is_run(study: Path, balls_directory: Path, capsys: pytest.CaptureFixture) -> None:
    before = (study / "stability.csv").read_bytes()
    command = ["study", "stress", str(study), "--methods", CAUTIOUS, GREY, "--scenes", str(balls_directory)]
    assert main([*command, "--kinds", *KINDS, "--severities", "1", "3", "5", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["made"] == 0
    assert told["left_out"] == ["clock_offset 8"]
    assert (study / "stability.csv").read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--methods", "splashsplat", "--kinds", "fog"], "no kind 'fog' of harm; give some of empty_masks"),
        (["--methods", "splashplat"], "did you mean 'splashsplat'"),
        (["--methods", "splashsplat:fast"], "fast"),
        (["--methods", "splashsplat:quick:x"], "write METHOD, METHOD:PRESET"),
        (["--methods", "nothing"], "nothing is the control"),
        (["--methods", "hull_points", "hull_points"], "hull_points is listed twice"),
        (["--methods", "hull_points", "--kinds", "clock_offset", "--severities", "1"], "none of the harms is left"),
    ],
)
def test_what_makes_no_sense_is_one_line(
    arguments: list[str], message: str, balls_directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "out"
    assert main(["study", "stress", str(out), "--scenes", str(balls_directory), *arguments]) == 1
    told = capsys.readouterr().err.strip()
    assert message in told
    assert len(told.splitlines()) == 1
    assert not out.exists()


@pytest.mark.slow
def test_a_method_may_be_called_as_it_likes(balls_directory: Path, tmp_path: Path) -> None:
    odd = tmp_path / "odd.py"
    lines = ["import sys", f"sys.path.insert(0, {str(METHODS.parent)!r})", "from study_methods import Grey"]
    for name, method in (("Dotted", "my.method"), ("Long", "a" * 50), ("Longer", "a" * 60)):
        lines.append(f"class {name}(Grey):\n    id = {method!r}")
    odd.write_text("\n".join(lines) + "\n")
    out, methods = tmp_path / "out", [f"{odd}:{name}" for name in ("Dotted", "Long", "Longer")]
    command = ["study", "stress", str(out), "--methods", *methods, "--scenes", str(balls_directory)]
    assert main([*command, "--kinds", "haze", "--severities", "5"]) == 0
    found = pd.read_csv(out / "retention.csv").query("metric == 'psnr'")
    assert list(found.method) == ["my.method", "a" * 50, "a" * 60]


def test_a_method_may_come_with_two_presets(balls_directory: Path) -> None:
    plan = make_stress_plan(
        ["splashsplat:quick", "splashsplat:best"], [str(balls_directory)], kinds=["haze"], levels=[2]
    )
    assert plan.methods == ("splashsplat-quick", "splashsplat-best")
    assert [run.variant.name for run in plan.plan.runs] == [
        "nothing.as_recorded",
        "splashsplat-quick.as_recorded",
        "splashsplat-quick.haze.2",
        "splashsplat-best.as_recorded",
        "splashsplat-best.haze.2",
    ]


def test_timesteps_that_a_scene_cannot_do_without_are_left_out(balls_directory: Path) -> None:
    kinds, levels = ("fewer_timesteps",), (1, 4, 5)
    plan = make_stress_plan([GREY], [str(balls_directory)], kinds=kinds, levels=levels)
    assert [harm.amount for harm in plan.harms] == [2, 6]  # of 8 timesteps
    assert [(harm.amount, reason) for harm, reason in plan.left_out] == [
        (8, "balls: of 8 timesteps keep_1_of_8 leaves none between two that are seen")
    ]
    unseen = {run.variant.unseen for run in plan.plan.runs}
    assert unseen == {None, "keep_1_of_2", "keep_1_of_6"}


@pytest.mark.slow
def test_runs_that_were_told_otherwise_are_made_again(balls_directory: Path, tmp_path: Path) -> None:
    """Container masks that come later are hints which no digest is of."""
    scene, out = Path(shutil.copytree(balls_directory, tmp_path / "balls")), tmp_path / "out"
    command = ["study", "stress", str(out), "--methods", GREY, "--scenes", str(scene)]
    command += ["--kinds", "exposure", "missing_cameras", "--severities", "1"]

    def made() -> int:
        before = {path: path.stat().st_mtime_ns for path in (out / "runs").glob("*.json")}
        assert main(command) == 0
        return sum(before.get(path) != path.stat().st_mtime_ns for path in (out / "runs").glob("*.json"))

    everything = made()
    assert everything > 3
    assert made() == 0
    (scene / "container_mask").mkdir()
    opened = Scene.open(scene)
    for name in opened.train:
        write_png(scene / "container_mask" / f"{name}.png", opened.mask(name, 0).astype(np.uint8) * 255)
    again = made()
    assert again >= everything - 1  # where a camera is missing nobody knows
    assert made() == 0

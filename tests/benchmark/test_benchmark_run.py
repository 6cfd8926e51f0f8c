"""`splashbench benchmark run`: an estimate first, then one command from scenes to the leaderboard."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import psutil
import pytest

from splashbench.benchmark.budgets import make_benchmark_plan, make_entrants
from splashbench.benchmark.estimate import Machine, estimate, load_rates
from splashbench.benchmark.scenes import find_scenes
from splashbench.cli.main import main
from splashbench.files import list_files
from splashbench.study import execution
from splashbench.study.job import Store

GREY = f"{Path(__file__).parents[1] / 'study' / 'study_methods.py'}:Grey"
SAME = Machine(2, 1.0)


def run(out: Path, real: Path, *words: str) -> list[str]:
    return ["benchmark", "run", str(out), "--scenes", str(real), "--methods", GREY, *words]


def test_scenes_become_a_leaderboard(made: Path) -> None:
    page = (made / "leaderboard" / "index.html").read_text()
    assert "grey" in page
    assert "as reported" in page.lower()
    rows = (made / "leaderboard" / "leaderboard.csv").read_text().splitlines()
    assert sorted({line.split(",")[0] for line in rows[1:]}) == ["grey", "nearest_camera", "nothing"]
    assert {line.split(",")[1] for line in rows[1:]} == {"bowl_001", "tank_002"}
    assert "benchmark run" in (made / "table.md").read_text()


def test_the_same_command_reuses_what_is_there(made: Path, real: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*run(made, real), "nearest_camera", "--json"]) == 0
    said = capsys.readouterr()
    facts = json.loads(said.out[said.out.index('{\n "out"') :])
    assert (facts["made"], facts["failed"]) == (0, 0)
    assert facts["estimate"]["runs_left"] == 0
    assert "2 of 2" in said.err
    assert "all of its runs are there" in said.err


def test_what_a_killed_one_left_is_removed(made: Path, real: Path) -> None:
    for name in (".tmp-0a1b2c3d-leaderboard", "leaderboard/.tmp-0a1b2c3d-x"):
        (made / name).mkdir()
    (made / ".tmp-0a1b2c3d-table.md").write_text("half")
    assert main([*run(made, real), "nearest_camera"]) == 0
    assert list(made.rglob(".tmp-*")) == []


def test_a_dry_run_makes_nothing(real: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    words = ["benchmark", "run", str(out), "--scenes", str(real), "--dry-run"]
    assert main(words) == 0
    said = capsys.readouterr().err
    assert not out.exists()
    assert "2 scenes, 7 methods with the control, 14 runs to make: about " in said
    assert "GB of memory" in said
    assert "on the disk" in said
    assert "whole fits recorded at 240x160" in said
    assert "(longest_side=16384): scaffold_4d, spacetime_gaussians, deformable_3dgs" in said
    assert "its own handicap" in said


def test_an_estimate_that_the_machine_lacks_room_for_is_said(
    real: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["benchmark", "run", str(tmp_path / "out"), "--scenes", str(real), "--dry-run"]
    assert main(words) == 0
    alone = capsys.readouterr().err
    assert "That is more" not in alone
    memory = psutil.virtual_memory()
    monkeypatch.setattr(psutil, "virtual_memory", lambda: memory._replace(total=3_000_000_000))
    assert main([*words, "--jobs", "20"]) == 0
    assert "That is more memory than the 3.0 GB of this machine: give fewer --jobs" in capsys.readouterr().err
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda place: usage._replace(free=1000))
    assert main(words) == 0
    assert (
        f"That is more than the 0.0 GB that are free at {tmp_path}: give OUT on a larger disk"
        in capsys.readouterr().err
    )


def test_on_many_machines_the_estimate_is_of_one_run_at_a_time(
    real: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(execution, "has_gpu", lambda on: True)
    assert main(["benchmark", "run", str(tmp_path / "out"), "--scenes", str(real), "--dry-run", "--on", "ray"]) == 0
    assert (
        "That is one run at a time, with the threads of --cores (1), on a machine like this" in capsys.readouterr().err
    )


@pytest.mark.slow
def test_what_it_does_on_ray_it_does_here(made: Path, real: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="comes with the extra [cluster]")
    scene = str(find_scenes([str(real)])[0])
    words = ["benchmark", "run", str(tmp_path / "out"), "--scenes", scene, "--methods", "nearest_camera", "--on", "ray"]
    ended = subprocess.run(
        [sys.executable, "-m", "splashbench", *words], capture_output=True, text=True, check=False, timeout=600
    )
    assert ended.returncode == 0, ended.stderr
    assert "Ray: " in ended.stderr
    found, here = without_times(tmp_path / "out"), without_times(made)
    assert {key[:2] for key in found} == {("nearest_camera", "bowl_001"), ("nothing", "bowl_001")}
    there, here_too = (each["nearest_camera", "bowl_001", 0]["metrics"] for each in (found, here))
    of_the_reference = ("dpsnr_bg", "spill_rgb")  # which has few steps in the fixture
    assert {name for name in there if there[name] != here_too[name]} <= set(of_the_reference)


def test_a_method_that_nobody_recorded_is_said(real: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(run(tmp_path / "out", real, "--dry-run")) == 0
    said = capsys.readouterr().err
    assert "and grey, of which nothing is known" in said
    assert "unknown  nothing: no run of it was recorded, and none was made here yet" in said


def test_runs_that_were_made_here_go_before_recorded_ones(made: Path, real: Path) -> None:
    scenes = [str(path) for path in find_scenes([str(real)])]
    entrants = make_entrants([GREY, "nearest_camera"], "quick")
    more = make_benchmark_plan(entrants, scenes, "quick", seeds=[0, 1])
    found = estimate(more, Store(made), load_rates(), SAME, with_lpips=False)
    by_name = {each.label: each for each in found.methods}
    assert by_name["grey"].basis == by_name["nearest_camera"].basis == "2 of its runs, made here"
    assert (by_name["grey"].made, by_name["grey"].runs) == (2, 4)
    entries = [Store(made).entry(run.digest) for run in more.runs if run.variant.name == "grey"]
    spent = [entry.seconds for entry in entries if entry is not None]
    assert len(spent) == 2
    assert by_name["grey"].seconds == pytest.approx(sum(spent), rel=0.01)
    assert found.unknown == []


#: What differs between two runs of the same: what was measured, and digests of what holds it.
_MEASURED = {"fit_seconds", "render_fps", "peak_memory_bytes", "peak_device_memory_bytes"}


def without_times(out: Path) -> dict[str, Any]:
    """The results by method, scene and seed, without what is measured: times, memory, frame rate, and the digest."""
    found = {}
    for path in sorted((out / "results").glob("*.json")):
        data = json.loads(path.read_text())
        data["metrics"] = {name: value for name, value in data["metrics"].items() if name not in _MEASURED}
        data["digests"] = {
            name: value for name, value in data["digests"].items() if name not in ("submission", "reference")
        }
        data.pop("stages")
        found[data["method"], data["scene"], data["seed"]] = data
    return found


@pytest.mark.slow
def test_killed_and_started_again_the_results_are_the_same(real: Path, tmp_path: Path) -> None:
    """A short form of benchmarks/released_road.py, which kills twenty times."""
    command = [sys.executable, "-m", "splashbench"]
    whole, out = tmp_path / "whole", tmp_path / "out"
    assert subprocess.run([*command, *run(whole, real)], stderr=subprocess.DEVNULL, check=False).returncode == 0
    draw, killed = random.Random(31), 0
    for _ in range(3):
        process = subprocess.Popen([*command, *run(out, real)], stderr=subprocess.DEVNULL, start_new_session=True)
        try:
            process.wait(draw.uniform(2, 12))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            killed += 1
    assert killed
    assert subprocess.run([*command, *run(out, real)], stderr=subprocess.DEVNULL, check=False).returncode == 0
    assert without_times(out) == without_times(whole)
    assert list(out.rglob(".tmp-*")) == []
    assert len(list_files(out / "results").names) == 4


@pytest.mark.slow
def test_a_failed_run_keeps_its_row(real: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    words = ["benchmark", "run", str(out), "--scenes", str(real / "real_scene_crop" / "bowl_001")]
    assert main([*words, "--methods", f"{GREY}:fail_on_seed=0", "--json"]) == 0
    said = capsys.readouterr()
    assert "1 failed" in said.err
    assert "this seed does not work" in (out / "leaderboard" / "leaderboard.csv").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--scenes", "nowhere"], "nowhere is not a folder"),
        (["--scenes", "REAL", "--methods", "splashplat"], "splashplat"),
        (["--scenes", "REAL", "--methods", "nothing"], "nothing is the control"),
    ],
)
def test_what_is_wrong_is_one_line(
    words: list[str], message: str, real: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(real) if word == "REAL" else word for word in words]
    assert main(["benchmark", "run", str(tmp_path / "out"), *words]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line

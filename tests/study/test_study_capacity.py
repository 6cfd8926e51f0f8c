"""`splashbench study capacity`: rungs are run once, the knee and overfitting are told, and bad input is one line."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.files import write_model
from splashbench.harness.discovery import load_method
from splashbench.scene import Scene
from splashbench.score.image.fidelity import psnr
from splashbench.study.capacity import (
    COSTS,
    MEAN,
    QUALITIES,
    capacity_frame,
    curves,
    make_capacity_plan,
    smallest_first,
)
from splashbench.study.job import RunEntry, Store
from splashbench.study.ladder import declared_ladder, parse_ladder
from splashbench.study.spending import StudyBudget

METHODS = Path(__file__).with_name("study_methods.py")
GROWING = f"{METHODS}:Growing"
ON_THEIR_OWN = ["splashsplat", "spacetime_gaussians", "deformable_3dgs", "scaffold_4d", "hull_points"]


@pytest.fixture(scope="module")
def study(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of the method's own ladder, of sizes 1, 2, 4 and 8; test views get worse from 4 on."""
    out = tmp_path_factory.mktemp("capacity") / "out"
    command = ["study", "capacity", GROWING, str(out), "--scenes", str(balls_directory), "--seeds", "0", "1"]
    assert main([*command, "--set", "overfits_from=4"]) == 0
    return out


def test_every_rung_has_a_row_for_each_seed(study: Path, balls: Scene) -> None:
    runs = pd.read_csv(study / "capacity.csv")
    assert list(runs.rung) == [1, 1, 2, 2, 3, 3, 4, 4]
    assert list(runs.set_size) == [1, 1, 2, 2, 4, 4, 8, 8]
    assert set(runs.status) == set(runs.train_status) == {"ok"}
    # A weight of 1000 bytes for each size, and the settings.
    assert runs.storage_bytes.diff().iloc[2] == 1000
    assert (runs.peak_memory_bytes > 1e6).all()
    assert (runs.fit_seconds >= 0.01 * runs.set_size).all()
    # Training views are the first and the middle one, at timesteps 0 and 5 of 8; the render is .3 / size too bright.
    expected = []
    for camera in ("1", "3"):
        pairs = [(balls.image(camera, t) / 255, balls.mask(camera, t)) for t in (0, 5)]
        shown = [psnr((truth + 0.3 / 4).clip(0, 1), truth, mask) for truth, mask in pairs]
        expected.append(sum(shown) / 2)
    of_four = runs[runs.set_size == 4].train_psnr.iloc[0]
    assert of_four == pytest.approx(sum(expected) / 2, abs=0.1)


def test_the_knee_and_overfitting_are_told(study: Path) -> None:
    page = (study / "capacity.md").read_text(encoding="utf-8")
    assert page.startswith("# Capacity of growing, preset best: knee at rung 3 of 4, 12.66 dB with 0.00")
    assert "beyond it overfitting\n" in page
    assert "larger rung" not in page
    assert "12.66 ± 0.00" in page
    assert "balls: knee at rung 3 (size=4); beyond it overfitting (test views -" in page
    assert "| 3 | size=4 | 2 of 2 |" in page
    assert "Satopaa et al. 2011" in page
    assert "Training views of balls: 1 at 2 timesteps, 3 at 2 timesteps" in page
    assert "--set overfits_from=4 --seeds 0 1" in page
    assert (study / "capacity.png").stat().st_size > 20_000
    assert (study / "capacity.svg").stat().st_size > 10_000


def test_a_second_time_nothing_is_run(study: Path, balls_directory: Path, capsys: pytest.CaptureFixture) -> None:
    before = (study / "capacity.csv").read_bytes()
    command = ["study", "capacity", GROWING, str(study), "--scenes", str(balls_directory), "--seeds", "0", "1"]
    assert main([*command, "--set", "overfits_from=4", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["made"], told["kept"]) == (0, 8)
    assert told["knees"]["balls"]["settings"] == {"size": 4}
    assert told["knees"]["balls"]["beyond"] == "overfitting"
    assert (study / "capacity.csv").read_bytes() == before
    # Renders of training views are nowhere, and no model is left.
    assert list((study / "submissions").iterdir()) == []


@pytest.mark.slow
def test_failed_rungs_are_rows_and_the_curve_goes_on_rising(balls_directory: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ["study", "capacity", GROWING, str(out), "--scenes", str(balls_directory)]
    assert main([*command, "--ladder", "size=1,2,4", "--set", "fails_from=4"]) == 0
    runs = pd.read_csv(out / "capacity.csv")
    assert list(runs.status) == ["ok", "ok", "crashed"]
    assert runs.reason.iloc[2] == "RuntimeError: too large"
    assert runs.psnr.isna().tolist() == [False, False, True]
    page = (out / "capacity.md").read_text(encoding="utf-8")
    assert "no knee: still rising at rung 2; 1 larger rung has no figures" in page
    assert "- rung 3, balls, seed 0: crashed: RuntimeError: too large" in page
    assert "Runs: 2 ok, 1 failed" in page


@pytest.mark.slow
def test_rungs_that_failed_above_a_knee_are_told(balls_directory: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ["study", "capacity", GROWING, str(out), "--scenes", str(balls_directory), "--set", "fails_from=16"]
    assert main([*command, "--ladder", "size=2,4,8,16,32"]) == 0
    page = (out / "capacity.md").read_text(encoding="utf-8")
    assert "balls: knee at rung 2 (size=4); beyond it a plateau (" in page
    assert "up to rung 3); 2 larger rungs have no figures." in page


@pytest.mark.slow
def test_training_views_that_a_model_cannot_show_are_told(balls_directory: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ["study", "capacity", GROWING, str(out), "--scenes", str(balls_directory), "--ladder", "size=4,8"]
    assert main([*command, "--set", "shows_training_views=false"]) == 0
    runs = pd.read_csv(out / "capacity.csv")
    assert set(runs.status) == {"ok"}
    assert set(runs.train_status) == {"crashed"}
    assert runs.train_psnr.isna().all()
    assert runs.psnr.notna().all()
    page = (out / "capacity.md").read_text(encoding="utf-8")
    assert "- rung 1, balls, seed 0, training views: crashed: RuntimeError: for test views only" in page
    assert "beyond it a plateau (test views " in page


def test_without_time_nothing_is_run_beyond_the_first_rung(balls_directory: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ["study", "capacity", GROWING, str(out), "--scenes", str(balls_directory), "--seeds", "0", "1"]
    assert main([*command, "--budget", "0.001"]) == 0
    runs = pd.read_csv(out / "capacity.csv")
    assert list(runs.status) == ["ok"] + 7 * ["not run"]
    page = (out / "capacity.md").read_text(encoding="utf-8")
    assert "rung 1 alone has figures" in page
    assert "7 not run yet" in page


def test_within_a_budget_small_rungs_come_first_and_too_long_ones_never(balls_directory: Path, tmp_path: Path) -> None:
    store = Store(tmp_path)
    capacity = make_capacity_plan(GROWING, [str(balls_directory)], seeds=[0, 1])
    now = [0.0]
    made = []
    order = smallest_first(capacity, store, StudyBudget(100, clock=lambda: now[0]))
    for run in order(capacity.plan.runs):
        rung = capacity.rungs[run.variant.name]
        made.append((rung, run.seed))
        seconds = 10.0 * 2 ** (rung - 1)
        now[0] += seconds
        write_model(
            store.entry_path(run.digest), RunEntry(digest=run.digest, title="", status="crashed", seconds=seconds)
        )
    # 10 + 10 + 20 + 20 = 60 s; the next one takes 40, by the step before, and ends in time, and no other after it.
    assert made == [(1, 0), (1, 1), (2, 0), (2, 1), (3, 0)]


def test_a_mean_is_of_seeds_that_have_all_scenes() -> None:
    rows = [(1, "a", 0, 10, 1, 4), (1, "b", 0, 12, 4, 4), (1, "a", 1, 20, 1, 1), (1, "b", 1, None, None, None)]
    frame = pd.DataFrame(rows, columns=["rung", "scene", "seed", "psnr", "storage_bytes", "fit_seconds"]).astype(
        {"psnr": float, "storage_bytes": float, "fit_seconds": float}
    )
    empty = ["dynamic_bytes", "peak_memory_bytes", "primitives_per_frame", "lpips", "miou"]
    empty += ["train_psnr", "train_lpips", "train_miou"]
    frame[empty] = float("nan")
    frame["status"] = ["ok", "ok", "ok", "timeout"]
    found = curves(frame)
    assert found[MEAN].loc[1, "psnr"] == 11
    # Of 1 and 4 bytes the geometric mean.
    assert found[MEAN].loc[1, "storage_bytes"] == pytest.approx(2)
    assert found["a"].loc[1, "psnr"] == 15
    assert found["a"].loc[1, "fit_seconds"] == pytest.approx(2)
    assert (found[MEAN].loc[1, "ok"], found[MEAN].loc[1, "runs"]) == (3, 4)
    assert list(curves(frame[frame.scene == "a"])) == ["a"]


@pytest.mark.parametrize("name", ON_THEIR_OWN)
def test_declared_ladders_are_settings_of_every_preset(name: str) -> None:
    method = load_method(name)
    ladder = declared_ladder(method)
    assert ladder is not None
    assert ladder.height == 5
    for preset in method.Config.presets:
        for rung in range(1, 6):
            settings = method.Config.preset(preset, ladder.settings(rung))
            assert {key: getattr(settings, key) for key in ladder.columns} == ladder.row(rung)


def test_values_of_a_ladder_are_json_or_text() -> None:
    ladder = parse_ladder(["losses.weight=0.5,1", "cells=[4,16],[4]", "kind=fast,slow"])
    assert ladder.settings(1) == {"losses": {"weight": 0.5}, "cells": [4, 16], "kind": "fast"}
    assert ladder.text(2) == "losses.weight=1 cells=[4] kind=slow"


@pytest.mark.parametrize(
    ("capacity", "message"),
    [
        ({"size": (1, 2), "grey": (0.1,)}, "size has 2, grey has 1"),
        ({"sise": (1, 2)}, "'sise', which is no setting, did you mean 'size'"),
        ({"size": (2, 1)}, "does not rise: size is 2, 1; sort the rungs"),
        ({"size": (2, 2)}, "two rungs are size=2"),
        ({"size": ()}, "has no rung"),
    ],
)
def test_a_ladder_that_a_method_declares_is_checked(
    capacity: dict, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    method = load_method(GROWING)
    monkeypatch.setattr(method.Config, "capacity", capacity)
    with pytest.raises(SplashbenchError, match=r"the ladder that growing declares \(LadderSettings.capacity\)") as told:
        declared_ladder(method)
    assert message in str(told.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([GROWING, "--ladder", "size=1,2", "--ladder", "grey=0.1"], "size has 2, grey has 1"),
        ([GROWING, "--ladder", "size"], "is not SETTING=V1,V2,...; write it like iterations=100,400,1600"),
        ([GROWING, "--ladder", "size=1,,2"], "is not SETTING=V1,V2,..."),
        ([GROWING, "--ladder", "size=1,2", "--ladder", "size=3,4"], "gives size twice"),
        ([GROWING, "--ladder", "size=1,1"], "two rungs are size=1; leave one out"),
        ([GROWING, "--ladder", "sise=1,2"], "setting sise"),
        ([GROWING, "--ladder", "size=1,x"], "setting size"),
        ([GROWING, "--ladder", "size=1,NaN"], "setting size"),
        ([GROWING, "--ladder", "size=1,2", "--set", "size=3"], "size is on the ladder and given with --set"),
        ([GROWING, "--preset", "bright"], "there is no preset 'bright'"),
        (
            [f"{METHODS}:Grey"],
            "declares no ladder; give one, such as --ladder grey=V1,V2,V3; its numeric settings: grey",
        ),
        (["nearest_camera"], "declares no ladder and has no numeric setting"),
        (["splashplat"], "did you mean 'splashsplat'"),
    ],
)
def test_what_makes_no_sense_is_one_line(
    arguments: list[str], message: str, balls_directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    method, *rest = arguments
    out = tmp_path / "out"
    assert main(["study", "capacity", method, str(out), "--scenes", str(balls_directory), *rest]) == 1
    told = capsys.readouterr().err.strip()
    assert message in told
    assert len(told.splitlines()) == 1
    assert not out.exists()


def test_capacity_frame_has_a_row_for_what_was_not_run(balls_directory: Path, tmp_path: Path) -> None:
    capacity = make_capacity_plan(GROWING, [str(balls_directory)], ladder=["size=1,2"])
    frame = capacity_frame(capacity, Store(tmp_path))
    assert list(frame.status) == ["not run", "not run"]
    assert frame.psnr.isna().all()


def test_a_seed_that_failed_on_one_rung_shifts_no_curve() -> None:
    """Seeds differ by 10 dB, and rungs by nothing: with seed 0 in two of three means the last rung would gain 5 dB."""
    rows = [
        {"rung": rung, "scene": "a", "seed": seed, "status": "ok", "psnr": 20.0 + 10 * seed}
        for rung in (1, 2, 3)
        for seed in (0, 1)
        if (rung, seed) != (3, 0)
    ]
    rows.append({"rung": 3, "scene": "a", "seed": 0, "status": "crashed"})
    figures = [*COSTS, *QUALITIES, *(f"train_{name}" for name in QUALITIES)]
    frame = pd.DataFrame(rows).reindex(columns=["rung", "scene", "seed", "status", *figures])
    curve = curves(frame)["a"]
    assert curve["psnr"].tolist() == [30.0, 30.0, 30.0]
    assert curve["ok"].tolist() == [2, 2, 1]
    # A rung on which every seed failed has no figure, and takes none from the others.
    none = pd.concat([frame, frame[frame.rung == 1].assign(rung=4, status="crashed", psnr=float("nan"))])
    assert curves(none)["a"]["psnr"].tolist()[:3] == [30.0, 30.0, 30.0]
    assert curves(none)["a"]["psnr"].isna().tolist() == [False, False, False, True]

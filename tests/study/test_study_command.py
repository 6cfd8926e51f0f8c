"""`splashbench study run`: runs are made once, survive a kill, fail as rows, and bad input is one line."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest

from splashbench import toml
from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.report.results import load_results
from splashbench.scene import Scene
from splashbench.study.job import Store
from splashbench.study.plan import make_plan
from splashbench.study.spec import load_spec, shipped

METHOD = f"{Path(__file__).with_name('study_methods.py')}:Grey"
PARTS = [{"kind": "missing_parts", "target_iou": 0.6}]


def _spec(scene: Path, **changes: Any) -> dict[str, Any]:
    return {
        "name": "greys",
        "method": METHOD,
        "seeds": [0, 1],
        "scenes": [str(scene)],
        "metrics": ["psnr", "particles_per_frame", "fit_seconds"],
        "baseline": "full",
        "reference": False,
        "variants": [{"name": "full"}, {"name": "dark", "settings": {"grey": 0.1}}],
        **changes,
    }


def _write(directory: Path, spec: dict[str, Any]) -> str:
    (directory / "greys.toml").write_text(toml.dumps(spec))
    return str(directory / "greys.toml")


def _fits(log: Path) -> list[str]:
    return log.read_text().splitlines() if log.exists() else []


@pytest.fixture(scope="module")
def study(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, Path]:
    """A study that was run: its spec, its folder, and the log of its fits."""
    place = tmp_path_factory.mktemp("study")
    log = place / "log"
    spec = _spec(
        balls_directory,
        base={"wobble": 0.02, "shared_seconds": 0.3, "log": str(log)},
        variants=[
            {"name": "full"},
            {"name": "same", "settings": {"grey": 0.5}},
            {"name": "raw", "perturbation": PARTS},
            {"name": "broken", "settings": {"fail_on_seed": 1}},
        ],
    )
    path = _write(place, spec)
    assert main(["study", "run", path, str(place / "out")]) == 0
    return path, place / "out", log


def _table(out: Path) -> dict[str, Any]:
    return json.loads((out / "table.json").read_text())


def test_every_variant_is_run_and_scored(study: tuple[str, Path, Path], balls: Scene) -> None:
    _, out, log = study
    rows = {row["variant"]: row for row in _table(out)["rows"]}
    assert [(name, row["ok"], row["failed"]) for name, row in rows.items()] == [
        *(("full", 2, 0), ("same", 2, 0), ("raw", 2, 0), ("broken", 1, 1))
    ]
    # The method makes a particle of every hundred pixels of liquid that it saw.
    seen = sum(int(balls.mask(name, t).sum()) for name in balls.train for t in range(balls.n_frames))
    assert rows["full"]["figures"]["particles_per_frame"]["mean"] == seen // 100
    assert rows["raw"]["figures"]["particles_per_frame"]["mean"] == pytest.approx(0.6 * seen / 100, rel=0.15)
    assert "this seed does not work" in (out / "table.md").read_text()
    # Two rows that come to the same share their runs: three fits for each seed.
    assert len(_fits(log)) == 6


def test_results_are_a_leaderboard_s_and_renders_are_gone(study: tuple[str, Path, Path]) -> None:
    _, out, _ = study
    results = [source.result for source in load_results(out / "results")]
    assert len(results) == 6
    psnr = fmean(r.value("psnr") for r in results if r.status == "ok" and r.settings.get("fail_on_seed") is None)
    rows = {row["variant"]: row for row in _table(out)["rows"]}
    assert psnr == pytest.approx(fmean(rows[name]["figures"]["psnr"]["mean"] for name in ("full", "raw")))
    assert list((out / "submissions").iterdir()) == []


@pytest.mark.slow
def test_every_row_with_withheld_timesteps_has_its_own_renders_faded_beside_it(
    balls_directory: Path, tmp_path: Path
) -> None:
    log, out = tmp_path / "log", tmp_path / "out"
    spec = _spec(
        balls_directory,
        seeds=[0],
        base={"log": str(log)},
        metrics=["psnr", "miou", "fit_seconds"],
        variants=[
            {"name": "full", "withheld": "odd"},
            {"name": "hull", "method": "hull_points", "withheld": "odd"},
            {"name": "seen"},
        ],
    )
    path = _write(tmp_path, spec)
    assert main(["study", "run", path, str(out)]) == 0
    rows = {row["variant"]: row for row in _table(out)["rows"]}
    assert list(rows) == ["full", "full, faded", "hull", "hull, faded", "seen"]
    assert [row["control"] for row in rows.values()] == [False, True, False, True, False]
    figures = {name: row["figures"] for name, row in rows.items()}
    # A picture that never changes is its own mean. What moves is not.
    assert figures["full, faded"]["psnr"]["mean"] == figures["full"]["psnr"]["mean"]
    assert figures["hull, faded"]["psnr"]["mean"] != figures["hull"]["psnr"]["mean"]
    assert figures["hull, faded"]["fit_seconds"]["mean"] is None
    assert len(_fits(log)) == 2  # one for each setting of Grey: fading needs no fit
    markdown = (out / "table.md").read_text()
    assert "| *hull, faded* |" in markdown
    assert "- Runs: 3 ok, 0 failed" in markdown
    assert main(["study", "run", path, str(out)]) == 0
    assert len(_fits(log)) == 2
    # A study from before the control existed has its runs made again.
    for entry in (out / "runs").glob("*.json"):
        said = json.loads(entry.read_text())
        entry.write_text(json.dumps({key: value for key, value in said.items() if key != "faded"}))
    assert main(["study", "run", path, str(out)]) == 0
    assert len(_fits(log)) == 3


def test_a_shared_part_counts_in_every_fit_time(study: tuple[str, Path, Path]) -> None:
    path, out, _ = study
    plan, store = make_plan(load_spec(path)), Store(out)
    shared = set()
    for run in plan.runs:
        entry = store.entry(run.digest)
        assert entry is not None
        if entry.status == "ok":
            assert entry.record is not None
            assert entry.record.fit_seconds is not None
            assert entry.record.fit_seconds >= 0.3
            shared |= {(run.variant.name, run.seed)} if entry.record.reused else set()
    # Worse masks are another scene, whose part is fitted anew.
    assert shared == {("broken", 0)}


def test_the_same_command_again_runs_nothing(study: tuple[str, Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    path, out, log = study
    before, fits = (out / "table.csv").read_bytes(), len(_fits(log))
    assert main(["study", "run", path, str(out), "--json"]) == 0
    said = capsys.readouterr()
    assert len(_fits(log)) == fits
    assert (out / "table.csv").read_bytes() == before
    answer = json.loads(said.out)
    assert (answer["made"], answer["kept"], answer["failed"]) == (0, 6, 1)
    assert "0 runs made, 6 reused; 4 rows, 1 failed runs" in said.err


def test_what_failed_is_tried_again_on_request(study: tuple[str, Path, Path]) -> None:
    path, out, log = study
    fits = len(_fits(log))
    assert main(["study", "run", path, str(out), "--retry"]) == 0
    assert _fits(log)[fits:] == ["0.5 1"]


def test_one_row_can_be_run_by_itself_and_several_runs_at_once(
    balls_directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = _write(tmp_path, _spec(balls_directory)), tmp_path / "out"
    assert main(["study", "run", path, str(out), "--only", "dark", "--jobs", "2", "--keep"]) == 0
    assert "run 2 of 2" in capsys.readouterr().err
    rows = {row["variant"]: row for row in _table(out)["rows"]}
    assert (rows["full"]["not_run"], rows["dark"]["ok"]) == (2, 2)
    assert "up to 2 runs shared the machine" in (out / "table.md").read_text()
    assert len(list((out / "submissions").glob("balls__dark__seed*/renders/6/000000.png"))) == 2


def test_dpsnr_is_measured_against_nothing_on_the_same_scene(balls_directory: Path, tmp_path: Path) -> None:
    changes = {
        "seeds": [4],
        "metrics": ["psnr", "dpsnr_bg"],
        "reference": {"settings": {"iterations": 1, "max_anchors": 50, "longest_side": 32}},
        "variants": [{"name": "full"}],
    }
    path, out = _write(tmp_path, _spec(balls_directory, **changes)), tmp_path / "out"
    assert main(["study", "run", path, str(out)]) == 0
    full, nothing = _table(out)["rows"]
    assert (nothing["variant"], nothing["control"], nothing["ok"]) == ("nothing", True, 1)
    gain = full["figures"]["psnr"]["mean"] - nothing["figures"]["psnr"]["mean"]
    assert full["figures"]["dpsnr_bg"]["mean"] == pytest.approx(gain, abs=1e-9)
    assert nothing["figures"]["dpsnr_bg"]["mean"] == 0


def test_a_killed_study_loses_the_run_in_progress_only(balls_directory: Path, tmp_path: Path) -> None:
    log = tmp_path / "log"
    changes = {
        "seeds": [0],
        "base": {"log": str(log)},
        "variants": [{"name": "full"}, {"name": "slow", "settings": {"shared_seconds": 600.0, "grey": 0.2}}],
    }
    path, out = _write(tmp_path, _spec(balls_directory, **changes)), tmp_path / "out"
    command = [sys.executable, "-m", "splashbench", "study", "run", path, str(out)]
    mark = uuid.uuid4().hex  # every process that the study starts inherits it
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, env={**os.environ, "SPLASHBENCH_TEST_MARK": mark})
    _wait_for(lambda: "0.2 0" in _fits(log))
    with pytest.raises(SplashbenchError, match="another study is running in"):
        _raising(["study", "run", path, str(out)])
    process.send_signal(signal.SIGKILL)
    process.wait()
    _wait_for(lambda: not any(mark.encode() in _environment(entry) for entry in Path("/proc").iterdir()))
    assert main(["study", "run", path, str(out), "--only", "full"]) == 0
    assert _fits(log) == ["0.5 0", "0.2 0"]
    rows = {row["variant"]: row for row in _table(out)["rows"]}
    assert (rows["full"]["ok"], rows["slow"]["not_run"]) == (1, 1)
    assert list(out.rglob(".tmp-*")) == []


def _wait_for(condition: Callable[[], bool], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.05)


def _environment(process: Path) -> bytes:
    try:
        return (process / "environ").read_bytes()
    except OSError:
        return b""


def _raising(arguments: list[str]) -> None:
    from splashbench.cli.main import build_parser

    parsed = build_parser().parse_args(arguments)
    parsed.handler(parsed)


@pytest.mark.parametrize(
    ("changes", "words", "said"),
    [
        ({"variants": [{"name": "full", "settings": {"gray": 1}}]}, [], "variant full: setting gray: Extra inputs"),
        ({"variants": [{"name": "full", "preset": "drak"}]}, [], "variant full: there is no preset 'drak'; choose"),
        ({"scenes": ["nowhere"]}, [], "nowhere is not a folder"),
        ({"scenes": []}, [], "names no scenes; give some with --scenes"),
        ({"metrics": ["pnsr"]}, [], "there is no metric 'pnsr', did you mean 'psnr'?"),
        ({"metrics": ["carriers_per_frame"]}, [], "'carriers_per_frame' is called 'particles_per_frame' now"),
        ({"baseline": "ful"}, [], "baseline 'ful' is no variant, did you mean 'full'?"),
        ({"seed": [1]}, [], "greys.toml: seed: Extra inputs are not permitted"),
        ({"seeds": [1, 1]}, [], "seed 1 is listed twice"),
        (
            {"variants": [{"name": "full", "perturbation": [{"kind": "blur"}]}]},
            [],
            "does not match any of the expected",
        ),
        ({"variants": [{"name": "full", "train_views": 9}]}, [], "has 5 training views, not 9"),
        ({"method": "splashspat"}, [], "did you mean 'splashsplat'?"),
        ({"variants": [{"name": "full", "method": "nothin"}]}, [], "did you mean 'nothing'?"),
        ({}, ["--only", "drak"], "has no variant 'drak', did you mean 'dark'?"),
        ({}, ["--set", "gray=1"], "setting gray: Extra inputs"),
        ({}, ["--scenes", "nowhere"], "nowhere is not a folder"),
    ],
)
def test_bad_input_is_one_line_before_anything_runs(
    balls_directory: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    changes: dict[str, Any],
    words: list[str],
    said: str,
) -> None:
    path = _write(tmp_path, _spec(balls_directory, **changes))
    assert main(["study", "run", path, str(tmp_path / "out"), *words]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert said in error
    assert not (tmp_path / "out").exists()


def test_a_folder_with_other_files_is_left_alone(balls_directory: Path, tmp_path: Path) -> None:
    path = _write(tmp_path, _spec(balls_directory))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    with pytest.raises(SplashbenchError, match="holds files that are no study's"):
        _raising(["study", "run", path, str(tmp_path / "mine")])
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_an_unknown_study_is_told_with_those_there_are() -> None:
    with pytest.raises(SplashbenchError, match=r"did you mean 'ablation'\?; give one of ablation, baselines, best"):
        load_spec("ablations")


def test_help_names_every_study_that_is_shipped(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["study", "run", "--help"])
    assert f"one of: {', '.join(shipped())}" in " ".join(capsys.readouterr().out.split())


def test_a_row_may_be_of_another_method(balls_directory: Path, tmp_path: Path) -> None:
    spec = _spec(
        balls_directory,
        seeds=[0],
        base={"wobble": 0.1},
        variants=[{"name": "full"}, {"name": "photograph", "method": "nearest_camera"}],
    )
    out = tmp_path / "out"
    assert main(["study", "run", _write(tmp_path, spec), str(out)]) == 0
    rows = {row["variant"]: row for row in _table(out)["rows"]}
    assert rows["photograph"]["figures"]["psnr"]["mean"] != rows["full"]["figures"]["psnr"]["mean"]
    results = {source.result.method: source.result for source in load_results(out / "results")}
    assert results["nearest_camera"].settings == {}  # the budget is of the study's own method
    assert results["grey"].settings["wobble"] == 0.1
    # A control is set apart as one, whichever row it is.
    assert {name: row["control"] for name, row in rows.items()} == {"full": False, "photograph": True}
    table = (out / "table.md").read_text()
    assert "| *photograph* | nearest_camera best | – |" in table
    assert "**" not in table.split("| Variant |")[1]  # no best row, with one that is no control


@pytest.mark.parametrize("name", shipped())
def test_the_shipped_studies_fit_the_method(name: str, balls_directory: Path) -> None:
    plan = make_plan(load_spec(name, scenes=[str(balls_directory)]))
    assert len(plan.runs) == 3 * len(plan.spec.variants)
    assert len(plan.reference_row) == 3
    # Where the paper has a figure for a row, the row says so.
    if plan.spec.paper:
        from splashbench.study.table import make_table

        reported = [row for row in make_table(plan, Store(balls_directory)).rows if row.paper]
        assert len(reported) >= 2

"""`study stress --budget`: the runs that say the most come first, and none that would end too late; method pages."""

from __future__ import annotations

import json
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pandas as pd
import pytest

from splashbench.cli.main import main
from splashbench.study.job import Store
from splashbench.study.spending import Cell, StudyBudget, by_uncertainty
from splashbench.study.stability import Breakdown, StressRun, breakdown
from splashbench.study.stress import make_stress_plan
from splashbench.study.stress_pages import page_name, place, summaries

METHODS = Path(__file__).with_name("study_methods.py")
CAUTIOUS, GREY = f"{METHODS}:Cautious", f"{METHODS}:Grey"


@pytest.fixture
def simulated(balls_directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str, int]]:
    """What is run, in order, of two methods that break at level 4 under exposure, never, and at once under haze."""
    plan = make_stress_plan([CAUTIOUS, GREY], [str(balls_directory)], kinds=["exposure", "haze"])
    known: dict[Cell, dict[int, bool]] = {}
    monkeypatch.setattr("splashbench.study.spending._known", lambda stress, store: known)
    monkeypatch.setattr("splashbench.study.spending._expected", lambda stress, store, run: 10.0)
    now = [0.0]
    made: list[tuple[str, str, int]] = []
    order = by_uncertainty(plan, Store(tmp_path / "none"), StudyBudget(95, clock=lambda: now[0]))
    for run in order([run for run in plan.plan.runs if plan.rows[run.variant.name][0] != "nothing"]):
        label, harm = plan.rows[run.variant.name]
        made.append((label, harm.kind.named() if harm else "", harm.level if harm else 0))
        now[0] += 10
        if harm is not None:
            broke = {("cautious", "exposure"): harm.level >= 4, ("cautious", "haze"): True}.get(made[-1][:2], False)
            known.setdefault(Cell(label, run.scene.name, 0, harm.kind.named()), {})[harm.level] = broke
    return made


def test_where_a_method_breaks_is_bisected(simulated: list[tuple[str, str, int]]) -> None:
    # The recording as it is, each cell's middle level, and then towards where it broke.
    assert simulated[:2] == [("cautious", "", 0), ("grey", "", 0)]
    assert sorted(simulated[2:6]) == [(m, k, 3) for m in ("cautious", "grey") for k in ("exposure", "haze")]
    later = simulated[6:]
    assert {level for method, kind, level in later if (method, kind) == ("cautious", "haze")} <= {1, 2}
    assert {level for method, kind, level in later if (method, kind) == ("cautious", "exposure")} <= {4, 5}
    assert {level for method, _, level in later if method == "grey"} <= {4, 5}
    # Nine runs of ten seconds end within 95.
    assert len(simulated) == 9


@pytest.mark.slow
def test_without_time_the_recordings_as_they_are_remain(balls_directory: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ["study", "stress", str(out), "--methods", GREY, "--scenes", str(balls_directory)]
    command += ["--kinds", "exposure", "--severities", "3", "5"]
    assert main([*command, "--budget", "0.0001"]) == 0
    assert "**2 of 4 runs are not made yet.**" in (out / "stability.md").read_text(encoding="utf-8")
    # The same command without a budget makes the rest, and one with time enough nothing more.
    assert main(command) == 0
    page = (out / "stability.md").read_text(encoding="utf-8")
    assert "not made yet" not in page
    assert main([*command, "--budget", "5", "--json"]) == 0


@pytest.mark.slow
def test_a_budget_makes_all_runs_where_there_is_time(
    balls_directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "out"
    command = ["study", "stress", str(out), "--methods", f"{GREY}:best", CAUTIOUS, "--scenes", str(balls_directory)]
    assert (
        main([*command, "--kinds", "exposure", "--severities", "1", "5", "--budget", "30", "--jobs", "2", "--json"])
        == 0
    )
    captured = capsys.readouterr()
    assert json.loads(captured.out)["made"] == 7
    # Nobody knows how many a budget leaves room for, and so nobody says.
    assert "run 7: balls__" in captured.err
    assert "run 7 of" not in captured.err
    kept = pd.read_csv(out / "retention.csv")
    assert len(kept[kept.metric == "miou"]) == 4
    # A page for each method; its picture has three views in a row.
    page = (out / "method_cautious.md").read_text(encoding="utf-8")
    assert "# Where cautious breaks" in page
    assert "Lock exposure in all cameras." in page
    picture = imageio.imread(out / "method_grey.png")
    assert picture.shape[1] == 3 * 360
    assert np.ptp(picture) > 50
    assert "[cautious](method_cautious.md)" in (out / "stability.md").read_text(encoding="utf-8")


def test_the_worst_kind_comes_first() -> None:
    found = {
        StressRun("m", "s", 0, kind, level, None if kept == 0 else 1.0): kept
        for kind, level, kept in (("a", 3, 0.9), ("a", 5, 0.2), ("b", 3, 0.0), ("c", 5, 0.7))
    }
    breakdowns = {
        "a": Breakdown((0.0, 1.0, 2.0), (1, 0.9, 0.2), (1, 0.9, 0.2), 1.6, (None, None)),
        "b": Breakdown((0.0, 1.0), (1, 0.0), (1, 0.0), 0.5, (None, None)),
        "c": Breakdown((0.0, 2.0), (1, 0.7), (1, 0.7), None, (None, None)),
    }
    rows = summaries(found, breakdowns)
    assert [row.kind for row in rows] == ["b", "a", "c"]
    assert [row.breaks_at for row in rows] == [3, 5, None]
    assert [place(row.found) for row in rows] == ["0.5", "1.6", "not up to 2"]
    assert rows[0].failed == 1


def test_bad_luck_at_one_severity_breaks_nothing_on_the_page_either() -> None:
    kept = (0.4, 0.9, 0.8, 0.7, 0.6)
    found = {StressRun("m", "s", 0, "a", level, 1.0): value for level, value in enumerate(kept, 1)}
    curve = breakdown(found, "a", [0, 1, 2, 3, 4, 5])
    (row,) = summaries(found, {"a": curve})
    assert row.breaks_at is None
    assert curve.point is None


def test_pages_have_names_of_their_own_whatever_methods_are_called() -> None:
    assert page_name("splashsplat", 0) == "method_splashsplat"
    names = {page_name("a, best", 0), page_name("a; best", 1), page_name("../../etc", 2)}
    assert len(names) == 3
    assert all("/" not in name and "." not in name for name in names)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--methods", GREY, "--budget", "0"], "is not a number of minutes above 0"),
        (["--methods", GREY, "--budget", "nan"], "is not a number of minutes above 0"),
        (["--methods", f"{GREY}:best:nothing=1"], "nothing"),
        (["--methods", GREY, f"{GREY}:best:x"], "is no method; write METHOD"),
    ],
)
def test_what_makes_no_sense_is_one_line(
    balls_directory: Path, tmp_path: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture
) -> None:
    try:
        code = main(["study", "stress", str(tmp_path / "out"), "--scenes", str(balls_directory), *arguments])
    except SystemExit as stopped:
        code = int(stopped.code or 0)
    assert code != 0
    assert message in capsys.readouterr().err

"""What changed between two leaderboards, row by row."""

from pathlib import Path
from typing import Any

import pytest

from splashbench.cli.main import main
from splashbench.report.changes import changes, shortened
from splashbench.report.results import load_results
from splashbench.report.table import leaderboard_table, to_csv


def csv_of(folder: Path) -> str:
    return to_csv(leaderboard_table(load_results(folder)))


@pytest.fixture
def before(make_result: Any, tmp_path: Path) -> str:
    for seed in range(2):
        make_result("alpha", seed, psnr=20.0 + seed, fit_seconds=9.0).save(tmp_path / "before")
    make_result("beta", psnr=19.0, fit_seconds=5.0).save(tmp_path / "before")
    return csv_of(tmp_path / "before")


def test_the_same_results_change_nothing(before: str) -> None:
    assert changes(before, before) == []


def test_new_gone_and_changed_rows_are_told(make_result: Any, before: str, tmp_path: Path) -> None:
    # Another version and other settings are the same row of the table with other figures.
    make_result("alpha", 0, psnr=21.0, fit_seconds=9.0, method_version="2", settings={"a": 1}).save(tmp_path / "after")
    make_result("gamma", 0, status="crashed", reason="no memory").save(tmp_path / "after")
    lines = changes(before, csv_of(tmp_path / "after"))
    assert lines == [
        "gone: beta [best] on bowl, test processor, 2 cores",
        "new: gamma [best] on bowl, test processor, 2 cores",
        "changed: alpha [best] on bowl, test processor, 2 cores: seed 0 1 -> 0, method_version 1 -> 2, "
        "psnr 20.50 -> 21.00",
    ]


def test_a_new_variant_is_new_and_not_another_ones_change(make_result: Any, tmp_path: Path) -> None:
    make_result("alpha", 0, lpips=0.2, settings={"a": 1}).save(tmp_path / "results")
    before = csv_of(tmp_path / "results")
    make_result("alpha", 1, lpips=0.1, settings={"a": 2}).save(tmp_path / "results")
    assert changes(before, csv_of(tmp_path / "results")) == ["new: alpha [best] on bowl, test processor, 2 cores"]


def test_a_very_long_reason(make_result: Any, tmp_path: Path) -> None:
    make_result("alpha", status="crashed", reason="x" * 200_000).save(tmp_path / "results")
    text = csv_of(tmp_path / "results")
    assert changes(text, text) == []


def test_many_changes_are_told_by_their_number() -> None:
    assert shortened(str(n) for n in range(25))[-2:] == ["19", "and 5 more"]
    assert shortened(["one"]) == ["one"]


def test_the_command_tells_what_it_replaces(
    make_result: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results, board = tmp_path / "results", tmp_path / "board"
    make_result("alpha", psnr=20.0, fit_seconds=9.0).save(results)
    words = ["leaderboard", str(results), str(board)]
    assert main(words) == 0
    assert "differs" not in capsys.readouterr().err
    assert main(words) == 0
    assert "no figure differs" in capsys.readouterr().err
    make_result("beta", psnr=20.0, fit_seconds=9.0).save(results)
    assert main(words) == 0
    assert "new: beta [best] on bowl" in capsys.readouterr().err
    # What stands there may be anything.
    (board / "leaderboard.csv").write_bytes(b"\xff\x00")
    assert main(words) == 0
    (board / "leaderboard.csv").write_text("a,b\n1,2\n")
    assert main(words) == 0
    assert "new: alpha" in capsys.readouterr().err

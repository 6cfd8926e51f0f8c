"""What commands print: text that cannot take over a terminal, JSON that any program reads, tables in columns."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from splashbench.cli.output import emit, report_faults, say, table


def test_text_for_people_goes_to_standard_error_without_control_characters(capsys: pytest.CaptureFixture[str]) -> None:
    say("first\nsecond \x1b[31m\r日本")
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "first\nsecond ?[31m?日本\n")


def test_json_has_no_nan(capsys: pytest.CaptureFixture[str]) -> None:
    emit({"psnr": 31.5, "reason": None})
    captured = capsys.readouterr()
    assert (json.loads(captured.out), captured.err) == ({"psnr": 31.5, "reason": None}, "")
    for value in (float("nan"), float("inf")):
        with pytest.raises(ValueError):
            emit({"psnr": value})


def test_every_fault_is_a_line_and_a_failure(capsys: pytest.CaptureFixture[str]) -> None:
    assert report_faults("scene", Path("bowl"), ["a.png is missing", "b.png is cut"], as_json=True) == 1
    captured = capsys.readouterr()
    assert captured.err.splitlines() == ["error: a.png is missing", "error: b.png is cut"]
    assert json.loads(captured.out) == {"scene": "bowl", "ok": False, "faults": ["a.png is missing", "b.png is cut"]}
    assert report_faults("scene", Path("bowl"), [], as_json=False) == 0
    assert capsys.readouterr() == ("", "bowl: no fault found\n")


def test_a_table_has_its_figures_under_each_other() -> None:
    assert table(["method", "dB"], [["a", "9.5"], ["longer name", "31.25"]]).splitlines() == [
        "method          dB",
        "a              9.5",
        "longer name  31.25",
    ]

"""The commands `splashbench masks compare` and `sheet`: what they print, what they write, and what they refuse."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splashbench.cli.main import main
from splashbench.files import read_gray, read_image, write_png


@pytest.fixture
def raw(balls_copy: Path, tmp_path: Path) -> Path:
    """The masks of the scene of balls in a folder, every one without its lower half."""
    for path in (balls_copy / "seg").rglob("*.png"):
        mask = read_gray(path)
        rows = np.flatnonzero(mask.any(axis=1))
        mask = mask.copy()
        if len(rows):
            mask[(rows[0] + rows[-1]) // 2 :] = 0
        write_png(tmp_path / "raw" / path.relative_to(balls_copy / "seg"), mask)
    return tmp_path / "raw"


def test_compare_prints_and_writes(
    raw: Path, balls_copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "comparison"
    assert main(["masks", "compare", str(raw), str(balls_copy), "--out", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:3] == ["scene", "camera", "masks"]
    assert lines[-1].split()[1] == "all"
    assert sorted(path.name for path in out.iterdir()) == ["comparison.png", "masks.csv", "summary.csv"]
    assert read_image(out / "comparison.png").shape[1] > 1000

    assert main(["masks", "compare", str(raw), str(balls_copy), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert rows[-1]["camera"] == "all"
    assert rows[-1]["removed_share"] == 0
    assert 0.2 < rows[-1]["added_share"] < 0.8
    assert rows[-1]["mean_iou"] == pytest.approx(1 - rows[-1]["added_share"])


def test_json_has_no_figure_where_there_is_no_liquid(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_png(tmp_path / "masks" / "1" / "000000.png", np.zeros((4, 4), np.uint8))
    assert main(["masks", "compare", str(tmp_path / "masks"), str(tmp_path / "masks"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"][-1]["mean_iou"] is None


def test_sheet_is_written_and_names_what_fails(
    balls_copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = sorted(path for path in (balls_copy / "seg").iterdir())[0]
    frame = sorted(camera.iterdir())[3]
    write_png(frame, np.full_like(read_gray(frame), 255))
    out = tmp_path / "sheet.png"
    assert main(["masks", "sheet", str(balls_copy), "--out", str(out), "--columns", "3", "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["faults"][camera.name]["3"] == "covers nearly everything"
    assert f"camera {camera.name}, frame 3: covers nearly everything" in captured.err
    assert read_image(out).shape[1] > 3 * 260
    before = out.read_bytes()
    assert main(["masks", "sheet", str(balls_copy), "--out", str(out), "--columns", "2"]) == 1
    assert "sheet.png exists already" in capsys.readouterr().err
    assert out.read_bytes() == before
    assert main(["masks", "sheet", str(balls_copy), "--out", str(out), "--columns", "2", "--replace"]) == 0
    assert out.read_bytes() != before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["compare", "nowhere", "nowhere"], "nowhere is not a folder"),
        (["sheet", "nowhere", "--out", "sheet.png"], "nowhere is not a folder"),
        (["sheet", "nowhere", "--out", "sheet.jpg"], "sheet.jpg does not end in .png"),
        (["sheet", ".", "--images", "nowhere", "--out", "../sheet.png"], "nowhere is not a folder"),
        (["sheet", ".", "--out", "../sheet.png"], "has no masks"),
        (["sheet", ".", "--out", "sheet.png"], "sheet.png lies in ., which is read"),
        (["compare", ".", ".", "--out", "comparison"], "comparison lies in ., which is read"),
    ],
)
def test_bad_input_is_one_line(
    words: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["masks", *words]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.strip().splitlines()) == 1
    assert message in captured.err
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_mask_leaves_nothing_behind(raw: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    next(raw.rglob("*.png")).write_bytes(b"\x89PNG not really")
    out = tmp_path / "out"
    assert main(["masks", "compare", str(raw), str(raw), "--out", str(out)]) == 1
    assert "not a readable image" in capsys.readouterr().err
    assert not out.exists()

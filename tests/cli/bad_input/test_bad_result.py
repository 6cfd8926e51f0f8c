"""Damaged results, and what is no result: one line that names the file, and no leaderboard."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from splashbench.cli.main import main
from splashbench.score.settings import Protocol

Fails = Callable[..., str]


def edit(path: Path, change: Callable[[dict], object]) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda p: p.write_bytes(b""), "cannot be read as JSON"),
        (lambda p: p.write_bytes(b"\xff"), "cannot be read as JSON"),
        (lambda p: (p.unlink(), p.mkdir()), "is a folder"),
        (lambda p: edit(p, lambda d: d.pop("digests")), "digests: Field required"),
        (lambda p: edit(p, lambda d: d["metrics"]["psnr"].update(value=float("nan"))), "metrics.psnr.value"),
        (lambda p: edit(p, lambda d: d["metrics"]["psnr"].update(value=1e308)), "metrics.psnr is 1e+308"),
        (lambda p: edit(p, lambda d: d["protocol"].update(version="v2")), "protocol.version"),
    ],
)
def test_a_damaged_result_is_named_and_no_leaderboard_is_left(
    results: Path, tmp_path: Path, fails: Fails, damage: Callable[[Path], object], message: str
) -> None:
    copy = Path(shutil.copytree(results, tmp_path / "results"))
    (path,) = copy.glob("*.json")
    damage(path)
    line = fails("leaderboard", copy, tmp_path / "board")
    assert path.name in line
    assert message in line
    assert not (tmp_path / "board").exists()


def test_what_a_killed_process_left_is_no_result(results: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(results, tmp_path / "results"))
    (copy / ".tmp-01234567-runs").mkdir()
    (copy / ".tmp-01234567-runs" / "record.json").write_text("{")
    (copy / ".tmp-89abcdef-x.json").write_text("{")
    assert main(["leaderboard", str(copy), str(tmp_path / "board")]) == 0


def test_results_of_another_protocol_have_a_table_of_their_own(results: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(results, tmp_path / "results"))
    (path,) = copy.glob("*.json")
    shutil.copy(path, other := copy / "other.json")

    def of_another(data: dict) -> None:
        data["protocol"].update(grid_cells=50)
        data["digests"].update(protocol=Protocol.model_validate(data["protocol"]).digest)

    edit(other, of_another)
    assert main(["leaderboard", str(copy), str(tmp_path / "board")]) == 0
    rows = (tmp_path / "board" / "leaderboard.csv").read_text().splitlines()
    assert len(rows) == 3
    assert sum("v1+" in row for row in rows) == 1

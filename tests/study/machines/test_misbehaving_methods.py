"""Whatever a method does, its run has a status, the others go on, and nothing is left running: here and on Ray."""

from __future__ import annotations

import uuid
from pathlib import Path

import pytest
from study_process import entries, marked, running, study, wait_for, write_spec


@pytest.fixture
def mark(monkeypatch: pytest.MonkeyPatch) -> str:
    """What everything that a study starts has in its environment."""
    mark = uuid.uuid4().hex
    monkeypatch.setenv("SPLASHBENCH_TEST_MARK", mark)
    return mark


def test_every_misbehaviour_is_a_status_and_leaves_nothing(
    place: list[str], mark: str, balls_directory: Path, tmp_path: Path
) -> None:
    kinds = ["well", "crash", "hang", "leave children", "eat memory"]
    log = tmp_path / "log"
    spec = write_spec(
        tmp_path,
        balls_directory,
        timeout_seconds=15,
        base={"log": str(log)},
        baseline="well",
        variants=[{"name": kind.replace(" ", "_"), "settings": {"how": kind}} for kind in kinds],
    )
    code, said = study(spec, tmp_path / "out", *place, "--memory", "1.5")
    assert code == 0, said
    found = {title.split("__")[1]: entry for title, entry in entries(tmp_path / "out").items()}
    assert {kind: entry["status"] for kind, entry in found.items()} == {
        "well": "ok",
        "crash": "crashed",
        "hang": "timeout",
        "leave_children": "ok",
        "eat_memory": "out_of_memory",
    }
    assert "(signal 9), as when memory runs out" in found["eat_memory"]["reason"]
    assert "over 15 s" in found["hang"]["reason"]
    wait_for(lambda: running(str(log)) == [] and marked(mark) == [], seconds=60)


def test_a_method_that_fills_the_disk_is_told_and_the_others_go_on(
    place: list[str], mark: str, balls_directory: Path, small_disk: Path, tmp_path: Path
) -> None:
    variants = [{"name": "full", "settings": {"how": "fill the disk"}}, {"name": "well"}]
    spec = write_spec(tmp_path, balls_directory, variants=variants)
    # One after the other: what runs beside it has no room either.
    code, said = study(spec, small_disk / "out", *place[:-1], "1", "--cores", "1")
    assert code == 0, said
    found = entries(small_disk / "out")
    assert found["balls__well__seed0"]["status"] == "ok"
    assert found["balls__full__seed0"]["status"] == "error"
    assert "the run filled the disk, and its files are removed" in found["balls__full__seed0"]["reason"]
    assert marked(mark) == []
    assert sum(path.stat().st_size for path in small_disk.rglob("*") if path.is_file()) < 10_000_000


def test_a_method_that_writes_into_the_scene_is_told_and_no_other_run_is_scored_on_it(
    place: list[str], mark: str, balls_copy: Path, tmp_path: Path
) -> None:
    variants = [{"name": "full", "settings": {"how": "write into the scene"}}, {"name": "well"}]
    spec = write_spec(tmp_path, balls_copy, variants=variants)
    code, said = study(spec, tmp_path / "out", *place[:-1], "1", "--cores", "1")
    assert code == 0, said
    found = entries(tmp_path / "out")
    assert {entry["status"] for entry in found.values()} == {"error"}
    assert all("was changed while" in entry["reason"] for entry in found.values())
    assert list((tmp_path / "out" / "results").glob("*")) == []
    assert marked(mark) == []

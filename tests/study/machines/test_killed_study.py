"""A study whose own process is killed, here and on Ray: the same command goes on, and no run counts twice."""

from __future__ import annotations

import re
import signal
import uuid
from pathlib import Path

import pytest
from study_process import deterministic_results, entries, marked, running, start_study, study, wait_for, write_spec


@pytest.mark.slow  # tests/study/test_study_command.py kills a smaller one
def test_the_same_command_goes_on_after_a_kill(
    place: list[str], balls_directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark, log, out = uuid.uuid4().hex, tmp_path / "log", tmp_path / "out"
    seeds = list(range(6))
    spec = write_spec(tmp_path, balls_directory, seeds=seeds, base={"log": str(log), "seconds": 2.0})
    process = start_study(spec, out, *place, SPLASHBENCH_TEST_MARK=mark)
    # In the middle: some have ended, others have not.
    wait_for(lambda: len(list((out / "runs").glob("*.json"))) >= 2)
    code, said = study(spec, out, *place)
    assert code == 1
    assert "another study is running in" in said
    process.send_signal(signal.SIGKILL)
    process.wait()
    before = {title: entry["attempt"] for title, entry in entries(out).items()}
    wait_for(lambda: marked(mark) == [], seconds=60)
    code, said = study(spec, out, *place)
    assert code == 0, said
    found = entries(out)
    assert [entry["status"] for entry in found.values()] == ["ok"] * len(seeds)
    # What had ended was not made again.
    assert {title: found[title]["attempt"] for title in before} == before
    assert len(list((out / "results").iterdir())) == len(seeds)
    # What had ended and was not counted yet is reused too.
    made, reused = map(int, re.findall(r"(\d+) runs made, (\d+) reused", said)[-1])
    assert made + reused == len(seeds)
    assert reused >= len(before)
    assert list((out / "submissions").iterdir()) == []
    assert [path.name for path in (out / "cache" / "jobs").iterdir() if path.is_dir()] == []
    assert list(out.rglob(".tmp-*")) == []
    assert running("misbehaving_methods") == []
    # The same as a study of one run after the other that nobody killed.
    code, said = study(spec, tmp_path / "alone")
    assert code == 0, said
    assert deterministic_results(out) == deterministic_results(tmp_path / "alone")
    assert (out / "table.csv").read_bytes() == (tmp_path / "alone" / "table.csv").read_bytes()

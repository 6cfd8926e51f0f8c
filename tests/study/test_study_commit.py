"""What an attempt has made counts once, wherever the study is killed between its files."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from splashbench.errors import SplashbenchError
from splashbench.files import write_model
from splashbench.study import commit as committing
from splashbench.study.commit import commit, commit_failure, new_attempt, recover
from splashbench.study.job import ERROR, Attempt, Job, RunEntry, Store
from splashbench.study.spec import StudyVariant

DIGEST = "0123456789abcdef" * 4


class PowerCut(Exception):
    """The process is gone."""


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store(tmp_path / "out")
    store.results.mkdir(parents=True)
    return store


def _attempt(store: Store, result: str = "a.json", status: str = "ok", **changes: Any) -> Attempt:
    """A complete attempt with a result, a picture and a submission."""
    attempt = Attempt(new_attempt(store, DIGEST))
    for folder in (attempt.results, attempt.pictures, attempt.submission):
        folder.mkdir(parents=True)
    (attempt.results / result).write_text(attempt.folder.name)
    (attempt.pictures / "picture.png").write_text(attempt.folder.name)
    (attempt.submission / "record.json").write_text(attempt.folder.name)
    job = {
        "digest": DIGEST,
        "title": "balls__full__seed0__01234567",
        "scene": "balls",
        "scene_digest": "0",
        "variant": StudyVariant(name="full"),
        "seed": 0,
        "method": "nothing",
        "preset": "best",
        "overrides": {},
        "reference": None,
        "is_reference": False,
        "device": "cpu",
        "timeout_seconds": None,
        "timing_frames": 0,
        "lpips_weights": None,
        "out": str(store.out),
        "attempt": str(attempt.folder),
        "keep": True,
        "at_once": 1,
    }
    write_model(attempt.request, Job(**{**job, **changes}))
    attempt.log.write_text("said")
    entry = RunEntry(digest=DIGEST, title=str(job["title"]), status=status, result=result, attempt=attempt.folder.name)
    write_model(attempt.entry, entry)
    return attempt


def _files(store: Store) -> list[str]:
    return sorted(path.relative_to(store.out).as_posix() for path in store.out.rglob("*") if path.is_file())


WHOLE = [
    "cache/jobs/0123456789abcdef.log",
    "pictures/picture.png",
    "results/a.json",
    "runs/0123456789abcdef.json",
    "submissions/balls__full__seed0__01234567/record.json",
]


def test_what_an_attempt_has_made_lies_where_it_belongs(store: Store) -> None:
    entry = commit(store, _attempt(store))
    assert store.entry(DIGEST) == entry
    assert _files(store) == WHOLE


def test_a_reference_lies_in_the_cache(store: Store) -> None:
    commit(store, _attempt(store, is_reference=True, keep=False))
    assert (store.reference_path(DIGEST) / "record.json").is_file()
    assert list(store.submissions.iterdir()) == []


@pytest.mark.parametrize("cut", range(1, 6))
def test_a_power_cut_at_any_step_loses_nothing_and_nothing_counts_twice(
    store: Store, monkeypatch: pytest.MonkeyPatch, cut: int
) -> None:
    # An earlier run that failed had a result too.
    commit(store, _attempt(store, "old.json", "crashed"))
    name = _attempt(store).folder.name
    steps = 0

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            nonlocal steps
            steps += 1
            if steps == cut:
                raise PowerCut
            return function(*arguments, **options)

        return call

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", counted(Path.replace))
        patch.setattr(Path, "rename", counted(Path.rename))
        patch.setattr(Path, "unlink", counted(Path.unlink))
        patch.setattr(committing, "remove_attempts", counted(committing.remove_attempts))
        with pytest.raises(PowerCut):
            commit(store, Attempt(store.attempts / name))
    recover(store)
    entry = store.entry(DIGEST)
    assert entry is not None
    assert (entry.status, entry.attempt) == ("ok", name)
    assert [path for path in _files(store) if ".tmp-" not in path] == WHOLE
    recover(store)
    assert [path for path in _files(store) if ".tmp-" not in path] == WHOLE


def test_of_two_complete_attempts_the_first_counts(store: Store) -> None:
    entry = commit(store, _attempt(store))
    # A machine that was taken for lost comes to its end later, after its folder was removed.
    _attempt(store, "b.json")
    recover(store)
    assert store.entry(DIGEST) == entry
    assert _files(store) == WHOLE


def test_an_attempt_without_an_entry_goes(store: Store) -> None:
    attempt = _attempt(store)
    attempt.entry.unlink()
    recover(store)
    assert not attempt.folder.exists()
    assert store.entry(DIGEST) is None
    assert list(store.results.iterdir()) == []


def test_a_run_whose_process_died_has_an_entry_and_keeps_its_log(store: Store) -> None:
    attempt = _attempt(store)
    attempt.entry.unlink()
    commit_failure(store, RunEntry(digest=DIGEST, title="balls", status=ERROR, reason="exit code 1"))
    entry = store.entry(DIGEST)
    assert entry is not None
    assert (entry.status, entry.result) == (ERROR, None)
    assert (store.attempts / f"{DIGEST[:16]}.log").read_text() == "said"
    assert not attempt.folder.exists()


def test_a_retried_run_replaces_its_result(store: Store) -> None:
    commit(store, _attempt(store, "old.json", "crashed"))
    commit(store, _attempt(store))
    assert _files(store) == WHOLE


def test_damage_in_the_folder_of_attempts_is_no_error(store: Store) -> None:
    attempt = _attempt(store)
    attempt.entry.write_text("{")
    recover(store)
    assert not attempt.folder.exists()
    shutil.rmtree(store.cache)
    recover(store)


@pytest.mark.parametrize("title", ["/victim", "../victim", "..", "a/../../victim", "a\\b", "a\nb", ""])
def test_a_folder_from_elsewhere_writes_and_deletes_nothing_outside(store: Store, title: str) -> None:
    victim = store.out.parent / "victim"
    victim.mkdir()
    (victim / "mine.txt").write_text("dear")
    attempt = _attempt(store)
    request = json.loads(attempt.request.read_text())
    named = str(victim) if title == "/victim" else title
    attempt.request.write_text(json.dumps({**request, "title": named}))
    store.runs.mkdir()
    stale = {"digest": DIGEST, "title": "a", "status": "error", "result": "../../victim/mine.txt"}
    store.entry_path(DIGEST).write_text(json.dumps(stale))
    recover(store)
    assert (victim / "mine.txt").read_text() == "dear"
    assert sorted(path.name for path in victim.iterdir()) == ["mine.txt"]
    # With a good title it is the earlier entry that leads out, and is refused by name.
    store.attempts.mkdir(exist_ok=True)
    with pytest.raises(SplashbenchError, match=r"0123456789abcdef.json.*no plain name"):
        commit(store, _attempt(store))
    assert (victim / "mine.txt").read_text() == "dear"

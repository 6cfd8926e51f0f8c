"""A method cannot write its own outcome or clock: both are taken from outside its process."""

import json
import os
import socket
import tempfile
import time
import uuid
from pathlib import Path
from typing import Any

import pytest

from splashbench.errors import SplashbenchError
from splashbench.harness import clock, leftovers, phases
from splashbench.harness.clock import Report, fit_time, frames_per_second, state_seconds
from splashbench.harness.keeper import _Line
from splashbench.harness.messages import Outcome
from splashbench.harness.runner import run_method
from splashbench.submission import Checkpoint, Status, Submission
from splashbench.submission.identity import MAX_CHECKPOINTS

METHODS = Path(__file__).with_name("forging_methods.py")


def _run(name: str, scene: Path, out: Path, **options) -> Submission:
    return run_method(f"{METHODS}:{name}", scene, out, timing_frames=options.pop("timing_frames", 0), **options)


def test_an_outcome_that_a_method_writes_is_none(balls_directory: Path, tmp_path: Path) -> None:
    submission = _run("WritesOutcome", balls_directory, tmp_path / "out")
    assert submission.status == Status.CRASHED
    assert "the fit ended with exit code 0" in submission.reason
    assert submission.record.fit_seconds is None


def test_a_fit_that_goes_on_after_its_end_is_timed_to_the_end_of_its_process(
    balls_directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clock, "END_SECONDS", 0.5)
    submission = _run("EndsEarly", balls_directory, tmp_path / "out")
    assert submission.status == Status.OK
    assert submission.record.fit_seconds is not None
    assert 2.4 < submission.record.fit_seconds < 30


def test_a_fit_that_ends_twice_is_no_fit(balls_directory: Path, tmp_path: Path) -> None:
    submission = _run("EndsTwice", balls_directory, tmp_path / "out")
    assert submission.status == Status.CRASHED
    assert "harness's own code" in submission.reason


def test_time_that_a_method_deducts_is_not_believed(balls_directory: Path, tmp_path: Path) -> None:
    record = _run("ClaimsOverhead", balls_directory, tmp_path / "out").record
    assert record.fit_seconds is not None
    assert 1.0 <= record.fit_seconds < 30
    assert record.reused == {}


@pytest.mark.parametrize("checkpoints", [None, (1e6,)])
def test_pauses_in_which_nothing_was_saved_count(
    balls_directory: Path, tmp_path: Path, checkpoints: tuple[float, ...] | None
) -> None:
    record = _run("ClaimsPauses", balls_directory, tmp_path / "out", checkpoints=checkpoints).record
    assert record.fit_seconds is not None
    assert 1.0 <= record.fit_seconds < 30
    assert not record.checkpoint_seconds


@pytest.mark.parametrize("name", ["LeavesPipeForLog", "LeavesFolderForLog"])
def test_whatever_lies_in_the_place_of_the_log_is_not_waited_for(
    name: str, balls_directory: Path, tmp_path: Path
) -> None:
    assert _run(name, balls_directory, tmp_path / "out", timeout_seconds=60).status == Status.OK


def test_states_beyond_those_that_a_record_has_room_for_are_not_taken(
    balls_directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def not_rendered(*of: Any) -> Checkpoint:
        return Checkpoint(seconds=of[-1], folder=f"checkpoints/{of[-2]:02d}")

    monkeypatch.setattr(phases, "_checkpoint", not_rendered)
    submission = _run("OffersMilestones", balls_directory, tmp_path / "out", checkpoints=(1e6,))
    assert submission.status == Status.OK
    assert len(submission.record.checkpoints) == MAX_CHECKPOINTS


def test_renders_that_are_told_and_not_there_are_incomplete(balls_directory: Path, tmp_path: Path) -> None:
    submission = _run("RendersNothing", balls_directory, tmp_path / "out", timing_frames=5)
    assert submission.status == Status.INCOMPLETE
    assert submission.reason == "camera 6, timestep 0: there is no picture in renders"
    assert submission.record.render_fps is None


def test_a_model_that_changes_after_its_bytes_were_counted_is_refused(balls_directory: Path, tmp_path: Path) -> None:
    submission = _run("ChangesModel", balls_directory, tmp_path / "out")
    assert (submission.status, submission.reason) == (
        Status.CRASHED,
        "the model was changed while it was rendered",
    )


def test_what_lies_in_the_scratch_folder_is_no_part_of_the_model(balls_directory: Path, tmp_path: Path) -> None:
    submission = _run("KeepsInScratch", balls_directory, tmp_path / "out")
    assert submission.status == Status.CRASHED
    assert "rest.bin" in submission.reason


def test_a_process_that_left_group_session_and_environment_ends_with_the_fit(
    balls_directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark = uuid.uuid4().hex
    monkeypatch.setenv("SPLASHBENCH_TEST_MARK", mark)
    assert _run("LeavesDaemon", balls_directory, tmp_path / "out").status == Status.OK
    left = [
        entry.name
        for entry in Path("/proc").iterdir()
        if entry.name.isdigit() and mark.encode() in _read(entry / "cmdline")
    ]
    assert left == []


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""


def _report(*marks: tuple[str, float], ended: float = 20.0) -> Report:
    return Report(started=0.0, ended=ended, marks=list(marks), strays=[], outcome=Outcome())


def test_a_fit_is_timed_between_its_marks_without_its_pauses() -> None:
    marks = [("fit starts", 2.0), ("paused", 5.0), ("goes on", 6.0), ("paused", 8.0), ("goes on", 8.5)]
    found = fit_time(_report(*marks, ("fit ends", 12.0), ("saved", 13.0), ended=14.0), storage_bytes=0)
    assert found is not None
    assert (found.seconds, found.paused, found.states) == (8.5, 1.5, [3.0, 5.0])


def test_what_starting_and_saving_take_too_long_counts() -> None:
    late = _report(("fit starts", 130.0), ("fit ends", 131.0), ("saved", 151.0), ended=151.0)
    found = fit_time(late, storage_bytes=25_000_000)
    assert found is not None
    # 10 s too late to start; of 20 s to save, 10 are free and 5 go with the bytes.
    assert found.seconds == pytest.approx(1 + 10 + 5)


@pytest.mark.parametrize(
    "marks",
    [
        [("fit starts", 1.0), ("fit ends", 2.0)],
        [("fit starts", 1.0), ("saved", 2.0), ("fit ends", 3.0)],
        [("fit starts", 1.0), ("fit ends", 2.0), ("fit ends", 3.0), ("saved", 4.0)],
    ],
)
def test_marks_that_are_no_fits_give_no_time(marks: list[tuple[str, float]]) -> None:
    assert fit_time(_report(*marks), storage_bytes=0) is None


def test_a_frame_rate_is_what_the_time_of_all_frames_allows() -> None:
    report = _report(("timing starts", 1.0), ("timing ends", 3.0))
    assert frames_per_second(report, 70.0, 110) == 70.0
    assert frames_per_second(report, 1e6, 110) == 55.0
    assert frames_per_second(_report(), 70.0, 110) is None
    # Marks that were kept back, and told at once.
    assert frames_per_second(_report(("timing starts", 1.0), ("timing ends", 1.0)), 1e9, 110) is None


def test_a_mark_is_stamped_by_when_it_comes_and_not_by_what_it_tells() -> None:
    ours, theirs = socket.socketpair()
    line = _Line(ours)
    now = time.monotonic()
    for name, at in (("a", now - 100.0), ("b", now - 0.001), ("c", now + 100.0)):
        theirs.sendall(json.dumps({"mark": name, "at": at}).encode() + b"\n")
    theirs.sendall(b"nonsense\n[]\n" + b"[" * 5000 + b"\n")
    assert line.read()
    (_, a), (_, b), (_, c) = line.marks
    assert now <= a <= b <= c < now + 10
    assert line.outcome is None
    ours.close()
    theirs.close()


def test_states_are_told_by_the_fits_clock_where_the_outside_agrees() -> None:
    assert state_seconds([4.8, 9.6], [4.9, 9.8]) == [4.8, 9.6]
    assert state_seconds([0.1, 0.2], [40.0, 80.0]) == [40.0, 80.0]
    assert state_seconds([0.1], [4.9, 9.8]) == [4.9, 9.8]


def _killed_run(folder: Path) -> None:
    folder.mkdir()
    (folder / leftovers.MARK).touch()
    os.utime(folder / leftovers.MARK, (time.time() - 3600,) * 2)
    (folder / "model").mkdir()


def test_what_a_killed_run_left_is_removed_by_the_next_or_named(
    balls_directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    left = [tmp_path / ".tmp-0123abcd-out", tmp_path / "temporary" / "splashbench-run-old"]
    for folder in left:
        _killed_run(folder)
    other, unmarked = tmp_path / ".tmp-0123abcd-another", tmp_path / ".tmp-89abcdef-out"
    for folder in (other, unmarked, young := tmp_path / ".tmp-00000000-out"):
        folder.mkdir()
    os.utime(unmarked, (time.time() - 3600,) * 2)
    lines: list[str] = []
    assert _run("ClaimsOverhead", balls_directory, tmp_path / "out", tell=lines.append).status == Status.OK
    assert not any(folder.exists() for folder in left)
    assert other.is_dir()
    assert unmarked.is_dir()
    assert [line for line in lines if str(unmarked) in line and "remove it if" in line]
    assert young.is_dir()
    assert not [line for line in lines if str(young) in line]
    assert sum(line.startswith("removed ") for line in lines) == 2
    assert list((tmp_path / "temporary").iterdir()) == []
    assert not (tmp_path / "out" / leftovers.MARK).exists()


def test_a_run_under_way_keeps_its_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leftovers, "_YOUNG_SECONDS", -1.0)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    staging = tmp_path / ".tmp-0123abcd-out"
    staging.mkdir()
    with leftovers.scratch_folder() as scratch, leftovers.held(staging):
        assert leftovers.clear_leftovers(tmp_path / "out") == []
        assert scratch.is_dir()
        assert staging.is_dir()
    assert not scratch.exists()


@pytest.mark.parametrize(("name", "said"), [("SavesPipe", "weights.npz"), ("SavesLink", "more")])
def test_pipes_and_links_are_no_model(balls_directory: Path, tmp_path: Path, name: str, said: str) -> None:
    submission = _run(name, balls_directory, tmp_path / "out", timeout_seconds=60)
    assert submission.status == Status.CRASHED
    assert submission.reason.startswith(f"what the method saved is no model: model/{said}")
    assert not (tmp_path / "out" / "model").exists()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("SavesElsewhere", "what the method saved is no model: it is a link"),
        ("MovesModel", "the model was changed while it was rendered"),
        ("RendersElsewhere", "what the method wrote is no submission: renders is a link"),
        ("TellsNaN", "stages.first: Input should be"),
        ("RemovesScratch", "scene is not a folder"),
    ],
)
def test_whatever_a_method_does_there_is_a_submission_with_a_reason(
    balls_directory: Path, tmp_path: Path, name: str, said: str
) -> None:
    submission = _run(name, balls_directory, tmp_path / "out")
    assert submission.status == Status.CRASHED
    assert said in submission.reason
    assert not {path.name for path in (tmp_path / "out").iterdir()} & {"model", "renders", "alpha"}


def test_views_that_a_method_takes_out_of_its_copy_of_the_scene_are_missed(
    balls_directory: Path, tmp_path: Path
) -> None:
    submission = _run("ForgetsViews", balls_directory, tmp_path / "out")
    assert submission.status == Status.INCOMPLETE
    assert submission.reason == "camera 7, timestep 0: there is no picture in renders"


def test_two_runs_do_not_write_one_submission(balls_directory: Path, tmp_path: Path) -> None:
    """The second one would fit to its end, and be thrown away."""
    (other := tmp_path / ".tmp-0123abcd-out").mkdir()
    with leftovers.held(other), pytest.raises(SplashbenchError, match="another run is writing"):
        _run("ClaimsOverhead", balls_directory, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert _run("ClaimsOverhead", balls_directory, tmp_path / "out").status == Status.OK

"""Two parts of a fit at the same time: results, time, progress, what each found out, and errors of either."""

import threading
import time
from pathlib import Path

import pytest

from splashbench.errors import SplashbenchError
from splashbench.harness import side_by_side
from splashbench.harness.contract import Run
from splashbench.scene import Scene
from splashbench.submission import Decision, Record, Rung


@pytest.fixture(params=[1, 2], ids=["one core", "two cores"])
def cores(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(side_by_side, "thread_count", lambda: request.param)
    return int(request.param)


def test_both_results_and_all_that_was_noted_come_back(cores: int) -> None:
    def first(run: Run) -> str:
        with run.stage("both"), run.stage("first"):
            run.note("a", "1")
        return "one"

    def second(run: Run) -> int:
        with run.stage("both"):
            run.note("b", f"seed {run.seed}")
            run.decide(Decision(name="size", basis="scene", chosen="8", because="it is enough"))
        return 2

    run = Run(seed=7)
    assert run.side_by_side(first, second) == ("one", 2)
    assert run.notes == {"a": "1", "b": "seed 7"}
    assert [decision.chosen for decision in run.decisions] == ["8"]
    assert set(run.stages) == {"both", "first"}


def test_decisions_and_their_rungs_are_bounded() -> None:
    run = Run()
    rungs = [Rung(value=str(n), bought=False) for n in range(40)]
    for n in range(60):
        run.decide(Decision(name=str(n), basis="withheld", chosen="0", because="", rungs=rungs))
    assert len(run.decisions) == 50
    assert len(run.decisions[0].rungs) == 40
    Record(decisions=run.decisions)


def test_a_long_note_goes_on_in_others() -> None:
    run = Run()
    text = "".join(str(n % 10) for n in range(1200))
    run.note("found", text)
    run.note("nothing", "")
    assert [len(part) for part in run.notes.values()] == [500, 500, 200, 0]
    assert list(run.notes) == ["found", "found 2", "found 3", "nothing"]
    assert "".join(run.notes.values()) == text
    run.note("flood", "word " * 10_000)
    assert len(run.notes) == 50
    assert run.notes["flood"].endswith("word")


def test_they_run_at_the_same_time_where_there_are_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(side_by_side, "thread_count", lambda: 2)
    meeting = threading.Barrier(2, timeout=30)
    # Each waits for the other: one after the other they would never end.
    assert Run().side_by_side(lambda run: meeting.wait() >= 0, lambda run: meeting.wait() >= 0) == (True, True)


def test_progress_rises_over_the_span_and_names_the_part_behind(cores: int) -> None:
    told: list[tuple[float, str]] = []

    def part(name: str):
        def make(run: Run) -> None:
            for step in range(5):
                run.progress(step / 4, name)

        return make

    Run(_report=lambda fraction, message: told.append((fraction, message))).side_by_side(
        part("one"), part("two"), span=(0.2, 0.4)
    )
    fractions = [fraction for fraction, _ in told]
    assert fractions == sorted(fractions)
    assert fractions[0] >= 0.2
    assert fractions[-1] == pytest.approx(0.4)
    assert {message for _, message in told} <= {"one", "two", "starting"}


@pytest.mark.parametrize("failing", ["first", "second"])
def test_an_error_of_one_ends_the_other(cores: int, failing: str) -> None:
    reports = []

    def fails(run: Run) -> None:
        raise SplashbenchError("no liquid")

    def endless(run: Run) -> None:
        for step in range(10**6):
            reports.append(step)
            run.progress(0.5, "on and on")
            time.sleep(0.001)

    parts = (fails, endless) if failing == "first" else (endless, fails)
    if cores == 1 and failing == "second":
        return  # one after the other, the first one would go on for its million steps
    with pytest.raises(SplashbenchError, match="no liquid"):
        Run().side_by_side(*parts)
    assert len(reports) < 10**5


def test_the_time_is_the_longer_parts_also_where_one_was_reused(
    cores: int, balls: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])

    def fit() -> str:
        clock[0] += 50.0
        return "a background"

    def save(value: str, folder: Path) -> None:
        (folder / "a").write_text(value)

    def first(run: Run) -> str:
        return run.reuse("background", balls.training(), {}, fit, save, lambda folder: (folder / "a").read_text())

    def second(run: Run) -> None:
        clock[0] += 30.0

    monkeypatch.setattr(side_by_side, "_both", lambda parts, one, two: (parts[0].make(one), parts[1].make(two)))
    # With this clock the parts come one after the other; on two cores the wall time would be the longer one's.
    expected = 80.0 if cores == 1 else 50.0
    for _ in range(2):
        run, start = Run(seed=1, cache=tmp_path), clock[0]
        run.side_by_side(first, second)
        assert run.fit_seconds(clock[0] - start) == pytest.approx(expected)
    assert run.reused == {"background": 50.0}


def test_what_is_made_ahead_is_made_once_and_counted_where_it_was_asked_for(
    cores: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []
    told: list[tuple[float, str]] = []

    def first(run: Run) -> str:
        with run.stage("first"):
            time.sleep(0.05)
        run.note("a", "1")
        run.progress(0.1, "late")
        made.append("first")
        return "one"

    def second(run: Run) -> int:
        run.progress(0.5, "second")
        made.append("second")
        return 2

    run = Run(_report=lambda fraction, message: told.append((fraction, message)))
    late, result = run.ahead(first, second, span=(0.2, 0.4))
    assert result == 2
    assert (made == ["second"]) if cores == 1 else (sorted(made) == ["first", "second"])
    run.progress(0.7, "on")
    with run.stage("around"):
        assert [late(), late()] == ["one", "one"]
    assert sorted(made) == ["first", "second"]
    assert run.notes == {"a": "1"}
    assert run.stages["first"] >= 0.05
    assert run.stages["around"] < 0.04
    # The bar does not go back for what comes late.
    fractions = [fraction for fraction, _ in told]
    assert fractions == sorted(fractions)
    if cores == 1:
        assert told[0] == (pytest.approx(0.3), "second")
        assert told[-1] == (0.7, "late")


def test_a_late_error_is_the_callers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(side_by_side, "thread_count", lambda: 1)

    def fails(run: Run) -> None:
        raise SplashbenchError("no liquid")

    late, _ = Run().ahead(fails, lambda run: None)
    for _ in range(2):
        with pytest.raises(SplashbenchError, match="no liquid"):
            late()


def test_a_stage_within_another_is_not_counted_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    run = Run()
    with run.stage("outer"):
        clock[0] += 1
        for _ in range(2):
            with run.stage("inner"):
                clock[0] += 10
                with run.stage("innermost"):
                    clock[0] += 100
        clock[0] += 2
    with run.stage("inner"):
        clock[0] += 5
    assert run.stages == {"outer": 3.0, "inner": 25.0, "innermost": 200.0}

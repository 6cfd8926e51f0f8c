"""Budgets of a run: handed on to methods that keep them, and refused with a word where a method does not."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Run
from splashbench.harness.runner import run_method
from splashbench.submission import Budget, Submission

METHOD = """
from splashbench.harness.contract import Decision, Method, MethodConfig
from splashbench_methods.controls.nothing import Nothing


class Thrifty(Nothing):
    id = "thrifty"
    budgets = ("seconds",)

    def fit(self, scene, config, run):
        run.decide(Decision(name="told", basis="budget", chosen=f"{run.budget.seconds:g} s", because="of the user"))
        assert run.seconds < 60
        return super().fit(scene, config, run)
"""


@pytest.fixture
def thrifty(tmp_path: Path) -> str:
    path = tmp_path / "thrifty.py"
    path.write_text(METHOD)
    return f"{path}:Thrifty"


def test_a_budget_reaches_the_method_and_stands_in_the_submission(
    thrifty: str, balls_directory: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    run_method(thrifty, balls_directory, out, budget=Budget(seconds=60), overrides={"iterations": 20}, timing_frames=0)
    submission = Submission.open(out)
    assert submission.identity.budget == Budget(seconds=60)
    assert [decision.chosen for decision in submission.record.decisions] == ["60 s"]


def test_a_limit_that_a_method_does_not_keep_to_is_refused(thrifty: str, balls_directory: Path, tmp_path: Path) -> None:
    with pytest.raises(SplashbenchError, match=r"keeps to no budget of memory \(to those of: seconds\)"):
        run_method(thrifty, balls_directory, tmp_path / "out", budget=Budget(seconds=60, memory_bytes=10**9))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "many", "1e12"])
@pytest.mark.parametrize("option", ["--budget-seconds", "--budget-mb", "--budget-memory"])
def test_what_is_no_budget_is_a_usage_error(option: str, value: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["run", "nothing", "SCENE", "OUT", f"{option}={value}"])
    assert option in capsys.readouterr().err


@pytest.mark.slow
def test_a_budget_that_was_not_kept_is_said(
    thrifty: str, balls_directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(seconds: str) -> str:
        out = str(tmp_path / seconds)
        few = ["--set", "iterations=20", "--timing-frames=0"]
        main(["run", thrifty, str(balls_directory), out, "--budget-seconds", seconds, *few])
        return capsys.readouterr().err

    assert "a budget of 0.001 s could not be kept" in run("0.001")
    assert "could not be kept" not in run("60")


def test_limits_are_positive_and_finite() -> None:
    assert Budget().limits == {}
    assert Budget(seconds=2).limits == {"seconds": 2.0}
    for wrong in ({"seconds": 0}, {"seconds": float("inf")}, {"storage_bytes": -1}, {"memory": 1}):
        with pytest.raises(ValidationError):
            Budget.model_validate(wrong)


def test_the_clock_of_a_run_goes_on() -> None:
    run = Run()
    first = run.seconds
    assert 0 <= first <= run.seconds < 5


def test_what_of_a_budget_was_not_kept() -> None:
    budget = Budget(seconds=10, storage_bytes=2_000_000, memory_bytes=300_000_000)
    assert budget.exceeded(10.5, 2_100_000, 315_000_000) == []
    assert budget.exceeded(None, None, None) == []
    assert budget.exceeded(10.6, 2_200_000, 400_000_000) == [
        "a budget of 10 s could not be kept: 10.6",
        "a budget of 2 MB of storage could not be kept: 2.2",
        "a budget of 300 MB of memory could not be kept: 400",
    ]
    assert Budget().exceeded(1e9, 10**15, 10**15) == []

"""States of a fit on its way: when they are taken, what they cost, where they lie, and how they are scored."""

import json
import random
import runpy
import sys
import time as clock
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.files import read_json, write_json
from splashbench.harness.checkpoints import MARKS, Checkpoints
from splashbench.harness.contract import Fitted, Method, MethodConfig, Render, Run
from splashbench.harness.runner import run_method
from splashbench.report.results import load_results
from splashbench.scene import Camera, Particles, Scene, TrainingScene
from splashbench.score import Result, score_submission
from splashbench.submission import Record, Status, Submission, check_submission

METHOD = f"{Path(__file__).resolve()}:Brightens"


class Grey(Fitted):
    def __init__(self, grey: float) -> None:
        self.grey = grey

    def render(self, camera: Camera, time: float) -> Render:
        shape = (camera.height, camera.width)
        return Render(np.full((*shape, 3), self.grey, np.float32), np.full(shape, self.grey, np.float32))

    def particles(self) -> Particles | None:
        return None

    def save(self, directory: Path) -> None:
        clock.sleep(0.8)  # a large model
        (directory / "grey.txt").write_text(str(self.grey))


class Settings(MethodConfig):
    presets: ClassVar[dict] = {"best": {}}
    first: float = 0.1


class Brightens(Method):
    """A grey that rises by a tenth in each of eight steps of 50 ms, by its own clock; saving a state takes .8 s."""

    id, title, Config = "brightens", "a rising grey", Settings

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Fitted:
        grey = config.first
        number = 0
        if run._checkpoints is not None:
            # A busy machine may take longer for a step: the marks are to fall on the same ones all the same.
            run._checkpoints._elapsed = lambda: round(0.05 * number, 2)
        for number in range(1, 9):  # noqa: B007 - its clock reads it
            with run.stage("steps"):
                clock.sleep(0.05)
                grey += 0.1
                run.checkpoint(lambda grey=grey: Grey(grey))
        return Grey(grey)

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        return Grey(float((directory / "grey.txt").read_text()))


class Elapsed:
    """Seconds of a fit, set by hand."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self) -> float:
        return self.seconds


def test_a_state_is_taken_at_the_first_offer_after_each_mark(tmp_path: Path) -> None:
    elapsed = Elapsed()
    taken = Checkpoints(tmp_path, [1.0, 2.0, 4.0, 8.0], elapsed, lambda: None)
    asked = []

    def state() -> Grey:
        asked.append(elapsed.seconds)
        return Grey(0.5)

    for elapsed.seconds in (0.0, 0.9, 1.1, 1.2, 5.0, 7.9, 8.0, 9.0):
        before = taken.spent
        taken.offer(state)
        assert (taken.spent > before) == (len(asked) > 0 and asked[-1] == elapsed.seconds)
    # One step went past two marks: its state serves both.
    assert taken.seconds == asked == [1.1, 5.0, 8.0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["00", "01", "02"]


def test_a_milestone_is_taken_at_once(tmp_path: Path) -> None:
    elapsed = Elapsed()
    taken = Checkpoints(tmp_path, [5.0, 10.0], elapsed, lambda: None)
    for elapsed.seconds in (1.0, 2.0, 3.0, 5.0, 6.0, 7.0):
        taken.offer(lambda: Grey(0.5), milestone=elapsed.seconds in (2.0, 6.0))
    assert taken.seconds == [2.0, 5.0, 6.0]


def test_the_marks_are_those_of_the_charts() -> None:
    assert MARKS[::2][:5] == pytest.approx((4.8, 9.6, 19.2, 38.4, 76.8))
    # For each of the budgets that quality is told at, there is one not long before.
    for budget in (10, 30, 60, 120, 300):
        assert max(mark for mark in MARKS if mark < budget) > 0.7 * budget


def test_taking_a_state_draws_no_random_numbers(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")

    class Draws(Grey):
        def save(self, directory: Path) -> None:
            random.random(), np.random.rand(), torch.rand(1)  # noqa: NPY002 - the generator that is shared

    def drawn() -> tuple[float, float, float]:
        return random.random(), np.random.rand(), float(torch.rand(1))  # noqa: NPY002

    taken = Checkpoints(tmp_path, [0.0], Elapsed(), lambda: None)
    random.seed(1), np.random.seed(1), torch.manual_seed(1)  # noqa: NPY002
    expected = drawn()
    random.seed(1), np.random.seed(1), torch.manual_seed(1)  # noqa: NPY002
    taken.offer(lambda: Draws(0.5))
    assert taken.seconds == [0.0]
    assert drawn() == expected


@pytest.fixture(scope="module")
def submission(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Submission:
    out = tmp_path_factory.mktemp("checkpoints") / "out"
    return run_method(METHOD, balls_directory, out, timing_frames=0, checkpoints=[0.1, 0.2])


def test_saving_states_is_no_part_of_the_fits_time(submission: Submission) -> None:
    record = submission.record
    assert record.status == Status.OK
    assert record.checkpoint_seconds is not None
    assert record.checkpoint_seconds >= 1.6
    assert record.fit_seconds is not None
    assert 0.4 <= record.stages["steps"] <= record.fit_seconds < record.checkpoint_seconds
    assert [checkpoint.seconds for checkpoint in record.checkpoints] == [0.1, 0.2]


def test_the_views_of_every_state_are_kept_and_checked(submission: Submission, balls: Scene, tmp_path: Path) -> None:
    assert check_submission(submission.directory, balls) == []
    greys = [float(views.alpha("6", 3).mean()) for _, views in submission.checkpoints()]
    assert greys == pytest.approx([0.3, 0.5], abs=0.002)
    assert all(c.storage_bytes and c.storage_bytes >= 3 for c in submission.record.checkpoints)
    import shutil

    broken = Path(shutil.copytree(submission.directory, tmp_path / "broken"))
    (broken / "checkpoints" / "01" / "alpha" / "6" / "000003.png").unlink()
    assert any("checkpoints/01/alpha/6/000003.png" in fault for fault in check_submission(broken, balls))


def test_every_state_is_scored(submission: Submission, balls: Scene, tmp_path: Path) -> None:
    result = score_submission(balls, submission)
    assert [c.seconds for c in result.checkpoints] == [0.1, 0.2]
    assert [c.status for c in result.checkpoints] == ["ok", "ok"]
    spills = [c.metrics["spill"] for c in result.checkpoints]
    assert spills[0] < spills[1] < result.value("spill")
    assert result.checkpoints[0].metrics["lpips"] is None
    assert result.checkpoints[0].metrics.keys() < result.metrics.keys()
    assert Result.load(result.save(tmp_path)) == result


def test_states_are_told_by_psnr_and_miou_alone_as_they_are_scored(
    submission: Submission, balls: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """benchmarks/states.py, for large scenes: with all frames, to what a table shows, as `score`."""
    script = Path(__file__).resolve().parents[2] / "benchmarks" / "states.py"
    words = [str(script), str(submission.directory), "--scene", str(balls.directory), "--every", "1"]
    monkeypatch.setattr(sys, "argv", [*words, "--out", str(tmp_path / "states.csv")])
    assert runpy.run_path(str(script))["main"]() == 0
    header, *rows = [line.split(",") for line in (tmp_path / "states.csv").read_text().splitlines()]
    assert header == ["method", "seconds", "psnr", "miou"]
    result = score_submission(balls, submission)
    states = [state.metrics for state in result.checkpoints]
    states.append({name: result.value(name) for name in ("psnr", "miou")})
    assert len(rows) == len(states)
    for row, state in zip(rows, states):
        assert float(row[2]) == pytest.approx(state["psnr"], abs=0.0051)
        assert float(row[3]) == pytest.approx(state["miou"], abs=0.00051)


def test_a_state_scores_as_a_run_that_ended_there(submission: Submission, balls: Scene, tmp_path: Path) -> None:
    # Eight steps from -.5 end where two from .1 did.
    ended = run_method(METHOD, balls.directory, tmp_path / "out", overrides={"first": -0.5}, timing_frames=0)
    alone = score_submission(balls, ended)
    found = score_submission(balls, submission).checkpoints[0].metrics
    for name in ("psnr", "miou", "spill", "jitter_error"):
        assert found[name] == alone.value(name), name


def test_the_models_of_states_are_not_kept(submission: Submission) -> None:
    assert sorted(path.name for path in (submission.directory / "checkpoints").iterdir()) == ["00", "01"]
    assert {path.name for path in (submission.directory / "checkpoints" / "00").iterdir()} == {"renders", "alpha"}


class BlankAtFirst(Brightens):
    """Its first states have no colours yet."""

    id = "blank_at_first"

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        grey = float((directory / "grey.txt").read_text())
        return Grey(grey if grey > 0.85 else float("nan"))


def test_a_state_without_views_keeps_its_status_and_the_run_is_fine(balls_directory: Path, tmp_path: Path) -> None:
    method = METHOD.replace("Brightens", "BlankAtFirst")
    found = run_method(method, balls_directory, tmp_path / "out", timing_frames=0, checkpoints=[0.1])
    assert found.status == Status.OK
    (checkpoint,) = found.record.checkpoints
    assert checkpoint.status == Status.NOT_FINITE
    assert "NaN" in checkpoint.reason
    assert found.checkpoints() == []
    assert not (tmp_path / "out" / "checkpoints" / "00").exists()
    result = score_submission(Scene.open(balls_directory), found)
    assert [(c.status, c.metrics) for c in result.checkpoints] == [("not_finite", {})]


class Ends(Brightens):
    """Crashes after its states were taken."""

    id = "ends"

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Fitted:
        super().fit(scene, config, run)
        raise RuntimeError("no memory for the last step")


def test_a_run_that_fails_keeps_no_states(balls_directory: Path, tmp_path: Path) -> None:
    method = METHOD.replace("Brightens", "Ends")
    found = run_method(method, balls_directory, tmp_path / "out", timing_frames=0, checkpoints=[0.1])
    assert found.status == Status.CRASHED
    assert found.record.checkpoints == []
    assert not (tmp_path / "out" / "checkpoints").exists()
    assert check_submission(tmp_path / "out") == []


def test_the_command_takes_states_of_a_long_fit_only(
    balls_directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", METHOD, str(balls_directory), str(tmp_path / "out"), "--checkpoints", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["checkpoints"], record["checkpoint_seconds"]) == ([], 0.0)


def test_the_oracle_has_no_fit(balls_directory: Path, tmp_path: Path) -> None:
    with pytest.raises(SplashbenchError, match="no presets, settings, seeds, device, model or fit"):
        run_method("oracle", balls_directory, tmp_path / "out", checkpoints=MARKS)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"folder": "checkpoints/../renders"}, "folder"),
        ({"folder": "checkpoints/00"}, "one folder"),
        ({"seconds": 0.0}, "must not fall"),
        ({"seconds": float("nan")}, "seconds"),
        ({"seconds": -1.0}, "seconds"),
    ],
)
def test_records_that_lie_are_refused(submission: Submission, change: dict, said: str) -> None:
    data = submission.record.model_dump(mode="json")
    data["checkpoints"][1] |= change
    with pytest.raises(ValueError, match=said):
        Record.model_validate(data)


@pytest.mark.parametrize("change", [{"seconds": 0.0}, {"seconds": 1e16}, {"metrics": {"psnr": 1e300}}])
def test_results_with_impossible_states_are_refused(
    submission: Submission, balls: Scene, tmp_path: Path, change: dict
) -> None:
    path = score_submission(balls, submission).save(tmp_path)
    data = read_json(path)
    data["checkpoints"][1] |= change
    write_json(path, data)
    with pytest.raises(SplashbenchError, match="checkpoints"):
        load_results(tmp_path)

"""Timesteps withheld from a method: what it sees, what is rendered, what is scored, and where such results stand."""

import json
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Fitted, Method, MethodConfig, Render, Run
from splashbench.harness.runner import run_method
from splashbench.harness.training_copy import make_training_copy
from splashbench.scene import Camera, Particles, Scene, TrainingScene
from splashbench.score import score_submission
from splashbench.submission.withheld import kept_timesteps, scored_timesteps, seen_around

METHOD = f"{Path(__file__).resolve()}:Clock"


class Clock(Method):
    """Shows how bright the time is, and says what it was shown."""

    id, title = "clock", "the time as a grey"
    Config: ClassVar[type[MethodConfig]] = MethodConfig

    def fit(self, scene: TrainingScene, config: MethodConfig, run: Run) -> Fitted:
        files = sorted(path.stem for path in (scene.directory / "ims" / scene.train[0]).iterdir())
        return Hands({"times": scene.times.tolist(), "frames": scene.frames, "files": files})

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        return Hands(json.loads((directory / "seen.json").read_text()))


class Hands(Fitted):
    def __init__(self, seen: dict) -> None:
        self.seen = seen

    def render(self, camera: Camera, time: float) -> Render:
        return Render(np.full((camera.height, camera.width, 3), time), np.zeros((camera.height, camera.width)))

    def particles(self) -> Particles | None:
        n = len(self.seen["times"])
        return Particles(np.zeros((n, 1, 3)), np.ones((n, 1), bool))

    def save(self, directory: Path) -> None:
        (directory / "seen.json").write_text(json.dumps(self.seen))


def test_which_timesteps() -> None:
    assert kept_timesteps(7, "odd") == (0, 2, 4, 6)
    assert scored_timesteps(7, "odd") == (1, 3, 5)
    # The last one of an even number lies outside what was seen.
    assert scored_timesteps(8, "odd") == (1, 3, 5)
    assert kept_timesteps(3, None) == scored_timesteps(3, None) == (0, 1, 2)


def test_each_third_and_some_at_random() -> None:
    assert kept_timesteps(8, "keep_1_of_3") == (0, 3, 6)
    assert scored_timesteps(8, "keep_1_of_3") == (1, 2, 4, 5)
    kept = {percent: kept_timesteps(40, f"drop_{percent}_percent") for percent in (10, 35, 99)}
    assert [len(steps) for steps in kept.values()] == [36, 26, 2]
    for steps in kept.values():
        assert steps == tuple(sorted(steps))
        assert {0, 39} <= set(steps)
    assert set(kept[99]) < set(kept[35]) < set(kept[10])
    gaps = np.diff(kept[35])
    assert gaps.max() >= 3 > gaps.min()
    assert set(scored_timesteps(40, "drop_35_percent")) == set(range(40)) - set(kept[35])
    assert seen_around(4, 8, "keep_1_of_3") == (3, 6)
    assert seen_around(7, 8, "keep_1_of_3") == (6, None)


@pytest.mark.parametrize("word", ["even", "keep_1_of_1", "keep_1_of_0", "drop_0_percent", "drop_100_percent", "odd\n"])
def test_a_word_that_says_nothing_is_refused(word: str, balls: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SplashbenchError, match="which timesteps to withhold"):
        kept_timesteps(8, word)
    with pytest.raises(SystemExit):
        main(["run", "hull_points", str(balls.directory), "OUT", "--withhold", word])
    assert "keep_1_of_3" in capsys.readouterr().err


def test_the_method_sees_every_second_timestep_and_nothing_of_the_others(balls: Scene, tmp_path: Path) -> None:
    view = Scene.open(make_training_copy(balls, tmp_path / "view", (0, 2, 4, 6)))
    assert view.frames == balls.frames[::2]
    np.testing.assert_array_equal(view.times, balls.times[::2])
    for name in balls.train:
        np.testing.assert_array_equal(view.image(name, 1), balls.image(name, 2))
        np.testing.assert_array_equal(view.mask(name, 3), balls.mask(name, 6))
    stems = {path.stem for path in (tmp_path / "view" / "ims").rglob("*.*") if path.is_symlink()}
    assert stems == set(balls.frames[::2])


@pytest.fixture(scope="module")
def result(balls: Scene, balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    place = tmp_path_factory.mktemp("withheld")
    words = ["run", METHOD, str(balls_directory), str(place / "odd"), "--withhold", "odd", "--timing-frames", "0"]
    assert main(words) == 0
    run_method(METHOD, balls_directory, place / "all", timing_frames=0)
    return place / "odd", place / "all"


def test_all_timesteps_are_rendered_at_their_own_times(result: tuple[Path, Path], balls: Scene) -> None:
    from splashbench.submission import Submission

    odd, whole = (Submission.open(path) for path in result)
    for t in range(balls.n_frames):
        shown = odd.rendering(balls.test[0], t)
        np.testing.assert_array_equal(shown, whole.rendering(balls.test[0], t))
        assert int(shown[0, 0, 0]) == round(255 * float(balls.times[t]))
    seen = json.loads((result[0] / "model" / "seen.json").read_text())
    assert seen["times"] == balls.times[::2].tolist()
    assert main(["check", str(result[0]), "--scene", str(balls.directory)]) == 0


def test_the_withheld_ones_alone_are_scored(result: tuple[Path, Path], balls: Scene, tmp_path: Path) -> None:
    from splashbench.submission import Submission

    odd, whole = (score_submission(balls, Submission.open(path)) for path in result)
    view = balls.test[0]
    of_odd, of_all = odd.metrics["psnr"].views[view].frames, whole.metrics["psnr"].views[view].frames
    assert of_odd == tuple(value if t in (1, 3, 5) else None for t, value in enumerate(of_all))
    assert odd.metrics["psnr"].skipped_frames == 0
    assert odd.value("psnr") != whole.value("psnr")
    assert odd.value("sigma_d") is None
    for scored in (odd, whole):
        scored.save(tmp_path / "results")
    assert main(["leaderboard", str(tmp_path / "results"), str(tmp_path / "board")]) == 0
    board = (tmp_path / "board" / "leaderboard.csv").read_text()
    assert "v1, odd timesteps withheld" in board
    assert len(board.splitlines()) == 3


def test_faded_is_the_mean_of_the_renders_before_and_after(result: tuple[Path, Path], balls: Scene) -> None:
    from splashbench.submission import Submission
    from splashbench.submission.faded import FadedSubmission

    odd, whole = (Submission.open(path) for path in result)
    faded = FadedSubmission(odd, balls)
    for t in range(balls.n_frames):
        # What grows evenly with time is half way in between what it was and will be, by the clock.
        here, own = (source.rendering(balls.test[0], t).astype(int) for source in (faded, odd))
        assert np.abs(here - own).max() <= (1 if t in (1, 3, 5) else 0)
        np.testing.assert_array_equal(faded.alpha(balls.test[0], t), odd.alpha(balls.test[0], t))
    scored = score_submission(balls, faded)
    assert (scored.method, scored.control, scored.withheld) == ("clock_faded", True, "odd")
    assert scored.value("psnr") == pytest.approx(score_submission(balls, odd).value("psnr"), abs=0.1)
    assert scored.value("fit_seconds") is None
    with pytest.raises(SplashbenchError, match="no withheld timesteps"):
        FadedSubmission(whole, balls)


def test_faded_weighs_by_nearness_in_time(tmp_path: Path) -> None:
    from splashbench.submission import Submission
    from splashbench.submission.faded import FadedSubmission
    from splashbench.synth.balls import write_balls_scene

    write_balls_scene(tmp_path / "scene", n_frames=3, delays={"6": 0.05})
    scene = Scene.open(tmp_path / "scene")
    run_method(METHOD, scene.directory, tmp_path / "odd", timing_frames=0, withheld="odd")
    faded = FadedSubmission(Submission.open(tmp_path / "odd"), scene)
    for name in scene.test:
        shown = faded.rendering(name, 1).astype(int)
        assert np.abs(shown - round(255 * float(scene.camera_times[name][1]))).max() <= 1


def test_two_timesteps_are_too_few(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from splashbench.synth.balls import write_balls_scene

    write_balls_scene(tmp_path / "two", n_frames=2)
    assert main(["run", "hull_points", str(tmp_path / "two"), str(tmp_path / "out"), "--withhold", "odd"]) == 1
    assert "takes three" in capsys.readouterr().err


def test_a_recording_too_short_for_it_is_refused(balls: Scene, tmp_path: Path, capsys) -> None:
    words = ["run", "hull_points", str(balls.directory), str(tmp_path / "out"), "--withhold", "keep_1_of_900"]
    assert main(words) == 1
    assert "leaves none between two that are seen" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_faded_reaches_over_wider_gaps(balls: Scene, tmp_path: Path) -> None:
    from splashbench.submission import Submission
    from splashbench.submission.faded import FadedSubmission

    run_method(METHOD, balls.directory, tmp_path / "third", timing_frames=0, withheld="keep_1_of_3")
    faded = FadedSubmission(Submission.open(tmp_path / "third"), balls)
    name = balls.test[0]
    for t in scored_timesteps(balls.n_frames, "keep_1_of_3"):
        shown = faded.rendering(name, t).astype(int)
        assert np.abs(shown - round(255 * float(balls.camera_times[name][t]))).max() <= 1

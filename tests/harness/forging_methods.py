"""Methods that try to write their own outcome, clock or renders. Given to `run` as FILE.py:CLASS."""

import gc
import json
import os
import shutil
import subprocess
import sys
import time as clock
from collections.abc import Callable
from pathlib import Path

from splashbench.harness.channel import FIT_ENDS, GOES_ON, PAUSED, SAVED, Channel
from splashbench.harness.contract import Fitted, Render, Run
from splashbench.scene import Camera, Particles, TrainingScene

sys.path.insert(0, str(Path(__file__).parent))
from example_methods import Good, _Settings


def channel() -> Channel:
    """The harness's end of the line, found in this process's memory."""
    return next(thing for thing in gc.get_objects() if isinstance(thing, Channel))


class WritesOutcome(Good):
    """Leaves an outcome where the harness once read one, and ends its process."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        outcome = {"status": "ok", "seconds": 0.001, "settings": {"blue": 1.0}}
        for folder in (run.directory, run.directory.parent):
            (folder / "outcome.json").write_text(json.dumps(outcome))
        os._exit(0)


class EndsEarly(Good):
    """Tells the end of the fit at its start, and goes on."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        line = channel()
        line.mark(FIT_ENDS)
        line.mark(SAVED)
        line.finish({"status": "ok"})
        clock.sleep(3)
        request = json.loads((run.directory.parent / "request.json").read_text())
        super().fit(scene, config, run).save(Path(request["model"]))
        os._exit(0)


class EndsTwice(Good):
    """Tells the end of the fit at its start, and lets the harness tell it once more."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        channel().mark(FIT_ENDS)
        clock.sleep(1)
        return super().fit(scene, config, run)


class ClaimsPauses(Good):
    """Says that a state is saved while it fits."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        line = channel()
        line.mark(PAUSED)
        clock.sleep(1)
        line.mark(GOES_ON)
        return super().fit(scene, config, run)


class LeavesPipeForLog(Good):
    """Puts pipes where the harness reads what is printed, and how far the fit is."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        for name in ("log", "progress"):
            (run.directory.parent / name).unlink(missing_ok=True)
            os.mkfifo(run.directory.parent / name)
        return super().fit(scene, config, run)


class LeavesFolderForLog(Good):
    """Puts folders there."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        for name in ("log", "progress"):
            (run.directory.parent / name).unlink(missing_ok=True)
            (run.directory.parent / name).mkdir()
        return super().fit(scene, config, run)


class OffersMilestones(Good):
    """Calls every step one behind which nothing comes for long."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        fitted = super().fit(scene, config, run)
        for _ in range(130):
            run.checkpoint(lambda: fitted, milestone=True)
        return fitted


class ClaimsOverhead(Good):
    """Says that all of its time went into reading what was fitted before."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        clock.sleep(1)
        run._overhead_seconds = 1e6
        run.reused["everything"] = 0.0
        return super().fit(scene, config, run)


class RendersNothing(Good):
    """Tells that it has rendered, and ends its process."""

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        channel().finish({"status": "ok", "render_fps": 1e9})
        os._exit(0)


class ChangesModel(Good):
    """Makes its model larger once its bytes were counted."""

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        (directory / "more.bin").write_bytes(b"0" * 5000)
        return super().load(directory, scene)


class KeepsInScratch(Good):
    """Leaves most of its model in the scratch folder of the fit."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        (run.directory / "rest.bin").write_bytes(b"0" * 5000)
        fitted = super().fit(scene, config, run)
        save = fitted.save

        def with_pointer(directory: Path) -> None:
            save(directory)
            (directory / "rest.txt").write_text(str(run.directory / "rest.bin"))

        fitted.save = with_pointer  # type: ignore[method-assign]
        return fitted

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        Path((directory / "rest.txt").read_text()).read_bytes()
        return super().load(directory, scene)


class LeavesDaemon(Good):
    """Starts a process of another session and environment, which would go on fitting."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        code = "import time\nwhile True: time.sleep(1)"
        subprocess.Popen(
            ["/usr/bin/env", "-i", sys.executable, "-c", code, os.environ["SPLASHBENCH_TEST_MARK"]],
            start_new_session=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        return super().fit(scene, config, run)


class _SavesMore(Fitted):
    """A fitted model that leaves something else beside its files, as `leave` does."""

    def __init__(self, fitted: Fitted, leave: Callable[[Path], None]) -> None:
        self._fitted, self._leave = fitted, leave

    def render(self, camera: Camera, time: float) -> Render:
        return self._fitted.render(camera, time)

    def particles(self) -> Particles | None:
        return self._fitted.particles()

    def save(self, directory: Path) -> None:
        self._fitted.save(directory)
        self._leave(directory)


class SavesPipe(Good):
    """Leaves a pipe in its model, which waits for whoever opens it."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        return _SavesMore(super().fit(scene, config, run), lambda folder: os.mkfifo(folder / "weights.npz"))


class SavesLink(Good):
    """Leaves a link to a file that is nobody's business."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        return _SavesMore(super().fit(scene, config, run), lambda folder: (folder / "more").symlink_to("/proc/kcore"))


class SavesElsewhere(Good):
    """Puts a link in the place of its model's folder."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        def move(folder: Path) -> None:
            shutil.move(folder, run.directory / "elsewhere")
            folder.symlink_to(run.directory / "elsewhere")

        return _SavesMore(super().fit(scene, config, run), move)


class MovesModel(Good):
    """Puts a link to the same model in the place of its folder, while it is rendered."""

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        fitted = super().load(directory, scene)
        shutil.move(directory, directory.parent.parent / "elsewhere")
        directory.symlink_to(directory.parent.parent / "elsewhere")
        return fitted


class RendersElsewhere(Good):
    """Has its pictures written into a folder of its own."""

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        (directory.parent.parent / "elsewhere").mkdir()
        (directory.parent / "renders").symlink_to(directory.parent.parent / "elsewhere")
        return super().load(directory, scene)


class TellsNaN(Good):
    """Has a stage that took no number of seconds."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        run.stages["first"] = float("nan")
        return super().fit(scene, config, run)


class RemovesScratch(Good):
    """Removes whatever the run has for the while: its log, its copy of the scene, the request."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        shutil.rmtree(run.directory.parent)
        return super().fit(scene, config, run)


class ForgetsViews(Good):
    """Takes test camera 7 out of its copy of the scene, so that it has fewer views to render."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        path = scene.directory / "test_meta.json"
        split = json.loads(path.read_text())
        for key in ("k", "w2c", "fn"):
            split[key] = [of_frame[:1] for of_frame in split[key]]
        path.write_text(json.dumps(split))
        path = scene.directory / "scene.json"
        meta = json.loads(path.read_text())
        meta["sizes"].pop("7")
        path.write_text(json.dumps(meta))
        return super().fit(scene, config, run)

"""Methods for the tests of studies: fits of no time whose figures follow from settings and seed."""

import json
import os
import time as clock
from pathlib import Path
from typing import ClassVar

import numpy as np

from splashbench.harness.contract import Fitted, Method, MethodConfig, Render, Run
from splashbench.scene import Camera, Particles, TrainingScene


class Settings(MethodConfig):
    presets: ClassVar[dict] = {"best": {}, "dark": {"grey": 0.1}}
    grey: float = 0.5
    #: grey levels per seed
    wobble: float = 0.0
    fail_on_seed: int | None = None
    #: seconds that the shared part takes
    shared_seconds: float = 0.0
    #: a file in which every fit leaves a line
    log: str = ""


class Grey(Method):
    """One grey; a level of its own for each seed."""

    id, title, version, Config = "grey", "one grey", "3", Settings

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Fitted:
        if config.log:
            with Path(config.log).open("a", encoding="utf-8") as stream:
                stream.write(f"{config.grey} {run.seed}\n")
        if config.fail_on_seed == run.seed:
            raise RuntimeError("this seed does not work")

        def fit() -> float:
            clock.sleep(config.shared_seconds)
            return float(os.getpid())

        key = {"shared_seconds": config.shared_seconds}
        shared = run.reuse("part", scene, key, fit, _save, lambda directory: float((directory / "pid").read_text()))
        covered = sum(int(scene.mask(name, t).sum()) for name in scene.train for t in range(scene.n_frames))
        return Model(config.grey + config.wobble * run.seed, scene.n_frames, shared, covered)

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        said = json.loads((directory / "model.json").read_text())
        return Model(said["grey"], scene.n_frames, said["shared"], said["covered"])


class Cautious(Grey):
    """The same, where cameras show about the same; else it gives up."""

    id, title, version, Config = "cautious", "one grey of equal pictures", "1", Settings

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Fitted:
        shown = [float(scene.image(name, 0).mean()) for name in scene.train]
        if max(shown) - min(shown) > 60:
            raise RuntimeError("so bright, and so dark")
        return super().fit(scene, config, run)


def _save(value: float, directory: Path) -> None:
    (directory / "pid").write_text(str(value))


class Model(Fitted):
    """`covered`: pixels of liquid seen in training, which gives the number of particles."""

    def __init__(self, grey: float, n_frames: int, shared: float, covered: int) -> None:
        self.grey, self.n_frames, self.shared, self.covered = grey, n_frames, shared, covered

    def render(self, camera: Camera, time: float) -> Render:
        size = (camera.height, camera.width)
        return Render(np.full((*size, 3), self.grey, np.float32), np.ones(size, np.float32))

    def particles(self) -> Particles:
        count = max(1, self.covered // 100)
        return Particles(np.zeros((self.n_frames, count, 3)), np.ones((self.n_frames, count), bool))

    def save(self, directory: Path) -> None:
        said = {"grey": self.grey, "shared": self.shared, "covered": self.covered}
        (directory / "model.json").write_text(json.dumps(said))


class LadderSettings(Settings):
    """Settings of `Growing`, and its ladder."""

    capacity: ClassVar[dict] = {"size": (1, 2, 4, 8)}
    #: of the model in kilobytes, of its fit in hundredths of a second
    size: int = 1
    #: from this size on no fit comes through
    fails_from: int = 1000
    #: from this size on test views become worse
    overfits_from: int = 1000
    #: whether the model can show training views
    shows_training_views: bool = True


class Growing(Grey):
    """Shows training views the better the larger it is, and test views up to a size. Its model is its size."""

    id, title, version, Config = "growing", "a size", "1", LadderSettings

    def fit(self, scene: TrainingScene, config: LadderSettings, run: Run) -> Fitted:
        if config.log:
            with Path(config.log).open("a", encoding="utf-8") as stream:
                stream.write(f"{config.size} {run.seed}\n")
        if config.size >= config.fails_from:
            raise RuntimeError("too large")
        clock.sleep(0.01 * config.size)
        return Grown(scene, config.model_dump())

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        return Grown(scene, json.loads((directory / "model.json").read_text()))


class Grown(Fitted):
    """What `Growing` fitted: `said` are its settings."""

    def __init__(self, scene: TrainingScene, said: dict) -> None:
        self.scene, self.said = scene, said

    def render(self, camera: Camera, time: float) -> Render:
        size, alpha = self.said["size"], np.ones((camera.height, camera.width), np.float32)
        if camera.name in self.scene.train:
            if not self.said["shows_training_views"]:
                raise RuntimeError("for test views only")
            t = int(np.abs(self.scene.camera_times[camera.name] - time).argmin())
            truth = self.scene.image(camera.name, t).astype(np.float32) / 255
            return Render(np.clip(truth + 0.3 / size, 0, 1), alpha)
        # Of the balls a grey of .3 shows the most, and brighter ones the less the brighter they are.
        good = min(size, 4) - max(0, size - self.said["overfits_from"])
        return Render(np.full((camera.height, camera.width, 3), 1 - 0.175 * good, np.float32), alpha)

    def particles(self) -> Particles | None:
        return None

    def save(self, directory: Path) -> None:
        (directory / "model.json").write_text(json.dumps(self.said))
        (directory / "weight.bin").write_bytes(bytes(1000 * self.said["size"]))


class Accelerated(Grey):
    """The same, for which SPLASHBENCH_TEST_GPU stands for a GPU. It notes which ones it is given."""

    id, title, version, devices = "accelerated", "one grey on a GPU", "1", ("cpu", "cuda")

    def device_fault(self, device: str) -> str | None:
        return None if device == "cpu" or os.environ.get("SPLASHBENCH_TEST_GPU") else "there is none"

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Fitted:
        run.note("gpus", os.environ.get("CUDA_VISIBLE_DEVICES", "not said") or "none")
        return super().fit(scene, config, run)

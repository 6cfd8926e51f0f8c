"""A method that misbehaves in the way that its setting names, for the tests of studies here and on Ray."""

import os
import signal
import sys
import time as clock
from pathlib import Path
from typing import ClassVar

import numpy as np

from splashbench.harness.contract import Fitted, Method, MethodConfig, Render, Run
from splashbench.scene import Camera, Particles, TrainingScene


class Settings(MethodConfig):
    presets: ClassVar[dict] = {"best": {}}
    how: str = "well"
    #: a file in which every fit leaves a line
    log: str = ""
    #: seconds of the fit
    seconds: float = 0.0


def sleeper(log: str) -> None:
    """Become a process that nothing but a kill ends, with nothing of where it comes from in its environment."""
    code = f"import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(600) # {log}"
    os.execve(sys.executable, [sys.executable, "-c", code], {})


class Misbehaving(Method):
    id, title, version, Config = "misbehaving", "as it likes", "1", Settings

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Fitted:
        if config.log:
            with Path(config.log).open("a", encoding="utf-8") as stream:
                stream.write(f"{config.how} {run.seed}\n")
        clock.sleep(config.seconds)
        if config.how == "crash":
            os.abort()
        if config.how == "hang":
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            if os.fork() == 0:
                os.setsid()
                sleeper(config.log)
            clock.sleep(600)
        if config.how == "leave children" and os.fork() == 0:
            os.setsid()
            if os.fork() == 0:
                sleeper(config.log)
            os._exit(0)
        if config.how == "eat memory":
            held = []
            while True:
                held.append(b"1" * 50_000_000)
                clock.sleep(0.02)
        if config.how == "write into the scene":
            path = next((scene.directory / "ims").rglob("*.png")).resolve()
            path.write_bytes(path.read_bytes() + b"0")
        return Model(config.how, scene.n_frames, run.seed)

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        return Model((directory / "how").read_text(), scene.n_frames, int((directory / "seed").read_text()))


class Model(Fitted):
    def __init__(self, how: str, n_frames: int, seed: int) -> None:
        self.how, self.n_frames, self.seed = how, n_frames, seed

    def render(self, camera: Camera, time: float) -> Render:
        size = (camera.height, camera.width)
        return Render(np.full((*size, 3), 0.1 * (self.seed % 10), np.float32), np.ones(size, np.float32))

    def particles(self) -> Particles | None:
        return None

    def save(self, directory: Path) -> None:
        (directory / "how").write_text(self.how)
        (directory / "seed").write_text(str(self.seed))
        if self.how == "fill the disk":
            with (directory / "large").open("wb") as stream:
                while True:
                    stream.write(bytes(1 << 20))

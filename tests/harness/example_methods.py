"""Methods that behave and misbehave, for the tests of the harness. Given to `run` as FILE.py:CLASS."""

import os
import time as clock
from pathlib import Path
from typing import ClassVar

import numpy as np

from splashbench.harness.contract import Fitted, Method, MethodConfig, Render, Run, Support
from splashbench.scene import Camera, Particles, TrainingScene


class _Settings(MethodConfig):
    presets: ClassVar[dict] = {"best": {}, "blue": {"blue": 1.0}}
    blue: float = 0.25


class _Flat(Fitted):
    """One colour everywhere; two particles that stay."""

    def __init__(self, blue: float, n_frames: int) -> None:
        self.blue, self.n_frames = blue, n_frames

    def render(self, camera: Camera, time: float) -> Render:
        rgb = np.zeros((camera.height, camera.width, 3), np.float32)
        rgb[..., 2] = self.blue
        return Render(rgb, np.full(rgb.shape[:2], 0.5, np.float32))

    def particles(self) -> Particles | None:
        return Particles(np.zeros((self.n_frames, 2, 3)), np.ones((self.n_frames, 2), bool))

    def save(self, directory: Path) -> None:
        (directory / "static").mkdir()
        (directory / "static" / "background.bin").write_bytes(b"0" * 1000)
        (directory / "blue.txt").write_text(str(self.blue))


class Good(Method):
    """Does what the contract says."""

    id, title, Config = "good", "one colour", _Settings

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        run.progress(0.5, "halfway")
        return _Flat(config.blue, scene.n_frames)

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        return _Flat(float((directory / "blue.txt").read_text()), scene.n_frames)


class Unsupported(Good):
    """Takes no scene."""

    def supports(self, scene: TrainingScene) -> Support:
        return Support(False, "needs eight cameras")


class Crash(Good):
    """Raises."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        raise RuntimeError("the matrix is singular")


class Die(Good):
    """Ends its process without a word."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        os._exit(7)


class Killed(Good):
    """Ends as when the kernel runs out of memory."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        os.kill(os.getpid(), 9)
        raise AssertionError


class Hang(Good):
    """Never ends, and starts a process of its own."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        if os.fork() == 0:
            (run.directory / "child").write_text(str(os.getpid()))
        while True:
            clock.sleep(1)


class OutOfMemory(Good):
    """Asks for more memory than there is."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        raise MemoryError("cannot allocate 10 TiB")


class OutOfDeviceMemory(Good):
    """Fails as PyTorch does where a GPU has no memory left."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        raise RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB")


class NotFinite(Good):
    """One NaN pixel in one frame."""

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        fitted = super().load(directory, scene)
        original = fitted.render

        def render(camera: Camera, time: float) -> Render:
            result = original(camera, time)
            if time > scene.times[2]:
                result.rgb[3, 4, 1] = np.nan
            return result

        fitted.render = render  # type: ignore[method-assign]
        return fitted


class WrongSize(Good):
    """Renders at half the size."""

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        fitted = super().load(directory, scene)
        original = fitted.render
        fitted.render = lambda camera, time: original(camera.scaled(0.5), time)  # type: ignore[method-assign]
        return fitted


class TooFewFrames(Good):
    """Has nothing to show for the later timesteps."""

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        fitted = super().load(directory, scene)
        original = fitted.render
        fitted.render = lambda camera, time: original(camera, time) if time < 0.1 else None  # type: ignore[method-assign,assignment,return-value]
        return fitted


class Peek(Good):
    """Looks for test images on the disk it was given."""

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        found = sorted(path.name for path in (scene.directory / "ims").iterdir())
        assert found == list(scene.train), found
        assert sorted(path.name for path in (scene.directory / "seg").iterdir()) == list(scene.train)
        assert not (scene.directory / "truth").exists()
        return super().fit(scene, config, run)


class Integers(Good):
    """Renders 0 to 255, the commonest mistake."""

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        fitted = super().load(directory, scene)
        original = fitted.render

        def render(camera: Camera, time: float) -> Render:
            result = original(camera, time)
            return Render(result.rgb * 255, result.alpha)

        fitted.render = render  # type: ignore[method-assign]
        return fitted


class Clock(Good):
    """Its blue is the time it is asked for, in seconds."""

    id = "clock"

    def fit(self, scene: TrainingScene, config: _Settings, run: Run) -> Fitted:
        return _Clock(config.blue, scene.n_frames)

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        return _Clock(0.0, scene.n_frames)


class _Clock(_Flat):
    def render(self, camera: Camera, time: float) -> Render:
        self.blue = time
        return super().render(camera, time)

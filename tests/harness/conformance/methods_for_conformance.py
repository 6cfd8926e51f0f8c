"""A method that keeps the contract, and methods that each break one of its clauses; given as FILE.py:CLASS."""

import json
import os
import pickle
import subprocess
import time as clock
from pathlib import Path
from typing import ClassVar

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Fitted, Method, MethodConfig, Render, Run, Support
from splashbench.scene import Camera, Particles, TrainingScene


class Settings(MethodConfig):
    presets: ClassVar[dict] = {"best": {"steps": 6}, "quick": {}}
    steps: int = 3
    #: a file that the methods that write elsewhere write
    place: str = ""


class Sky(Method):
    """Colours every pixel by the direction of its ray: a seeded pattern in the mean colour of the training views."""

    id, title, Config = "sky", "a sky", Settings
    Model: ClassVar[type]

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> "Model":
        for step in range(config.steps):
            self.step(scene, config, run, step)
        mean = np.mean([scene.image(name, 0).mean(axis=(0, 1)) for name in scene.train], axis=0) / 255
        return self.model(mean, self.rng(run).uniform(0, 6, 3), scene)

    def step(self, scene: TrainingScene, config: Settings, run: Run, step: int) -> None:
        run.progress(step / config.steps, "looking up")

    def rng(self, run: Run) -> np.random.Generator:
        return np.random.default_rng(run.seed)

    def model(self, mean: np.ndarray, phase: np.ndarray, scene: TrainingScene) -> "Model":
        return self.Model(mean, phase, scene.n_frames)

    def load(self, directory: Path, scene: TrainingScene) -> "Model":
        with np.load(directory / "model.npz", allow_pickle=False) as data:
            return self.model(data["mean"], data["phase"], scene)


class Model(Fitted):
    def __init__(self, mean: np.ndarray, phase: np.ndarray, n_frames: int) -> None:
        self.mean, self.phase, self.n_frames = mean, phase, n_frames

    def render(self, camera: Camera, time: float) -> Render:
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T @ camera.w2c[:3, :3]
        wave = 0.3 * np.sin(9 * rays + self.phase + time)
        return Render(np.clip(self.mean + wave, 0, 1).astype(np.float32), np.full(u.shape, 0.5, np.float32))

    def particles(self) -> Particles | None:
        return Particles(np.zeros((self.n_frames, 2, 3)), np.ones((self.n_frames, 2), bool))

    def save(self, directory: Path) -> None:
        np.savez(directory / "model.npz", mean=self.mean, phase=self.phase)


Sky.Model = Model


# --- metadata


class Titleless(Sky):
    title = " "


class SecretiveSettings(Settings):
    def model_dump_json(self, **options: object) -> str:  # type: ignore[override]
        return Settings().model_dump_json(**options)  # type: ignore[arg-type]


class ForgetsSettings(Sky):
    Config = SecretiveSettings


class BadPreset(Sky):
    class Config(Settings):
        presets: ClassVar[dict] = {"best": {}, "quick": {}, "slow": {"step": 1}}


# --- progress


class Silent(Sky):
    def step(self, scene: TrainingScene, config: Settings, run: Run, step: int) -> None:
        pass


class Wordless(Sky):
    def step(self, scene: TrainingScene, config: Settings, run: Run, step: int) -> None:
        run.progress(step / config.steps)


class Backwards(Sky):
    def step(self, scene: TrainingScene, config: Settings, run: Run, step: int) -> None:
        run.progress(1 - step / config.steps, "looking down")


class Percent(Sky):
    def step(self, scene: TrainingScene, config: Settings, run: Run, step: int) -> None:
        run.progress(100 * step / config.steps, "looking up")


# --- files and loading


class Pickles(Sky):
    class Model(Model):
        def save(self, directory: Path) -> None:
            with (directory / "model").open("wb") as stream:
                pickle.dump((self.mean, self.phase), stream)

    def load(self, directory: Path, scene: TrainingScene) -> Model:
        with (directory / "model").open("rb") as stream:
            return self.model(*pickle.load(stream), scene)


class Rounds(Sky):
    class Model(Model):
        def save(self, directory: Path) -> None:
            np.savez(directory / "model.npz", mean=self.mean.astype(np.float16), phase=self.phase)


class SavesElsewhere(Sky):
    """The folder that is saved has only the name of another one."""

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Model:
        fitted = super().fit(scene, config, run)
        fitted.save(run.directory)

        def save(directory: Path) -> None:
            (directory / "where.txt").write_text(str(run.directory))

        fitted.save = save  # type: ignore[method-assign]
        return fitted

    def load(self, directory: Path, scene: TrainingScene) -> Model:
        return super().load(Path((directory / "where.txt").read_text()), scene)


# --- rendering


class Counts(Sky):
    """Each render is a little brighter than the one before."""

    class Model(Model):
        def render(self, camera: Camera, time: float) -> Render:
            self.mean = self.mean + 0.001
            return super().render(camera, time)

    def model(self, mean: np.ndarray, phase: np.ndarray, scene: TrainingScene) -> Model:
        return self.Model(mean.copy(), phase, scene.n_frames)


class OneSize(Sky):
    """Renders at the size that the first view asked for."""

    class Model(Model):
        first: Camera | None = None

        def render(self, camera: Camera, time: float) -> Render:
            self.first = self.first or camera
            return super().render(self.first, time)

    def model(self, mean: np.ndarray, phase: np.ndarray, scene: TrainingScene) -> Model:
        model = self.Model(mean, phase, scene.n_frames)
        model.first = next(iter(scene.test_cameras.values()))
        return model


class Centred(Sky):
    """Takes the principal point for the middle of the image."""

    class Model(Model):
        def render(self, camera: Camera, time: float) -> Render:
            K = camera.K.copy()
            K[:2, 2] = camera.width / 2, camera.height / 2
            return super().render(Camera(camera.name, camera.width, camera.height, K, camera.w2c), time)


class FramesOnly(Sky):
    """Knows nothing between the timesteps."""

    class Model(Model):
        times: ClassVar[list] = []

        def render(self, camera: Camera, time: float) -> Render:
            self.times.index(time)
            return super().render(camera, time)

    def model(self, mean: np.ndarray, phase: np.ndarray, scene: TrainingScene) -> Model:
        model = self.Model(mean, phase, scene.n_frames)
        model.times[:] = scene.times.tolist()
        return model


class NotANumber(Sky):
    class Model(Model):
        def render(self, camera: Camera, time: float) -> Render:
            render = super().render(camera, time)
            render.rgb[3, 4, 1] = np.nan
            return render


class FewParticles(Sky):
    def model(self, mean: np.ndarray, phase: np.ndarray, scene: TrainingScene) -> Model:
        return Model(mean, phase, scene.n_frames - 1)


class PhiAsAnArray(Sky):
    class Model(Model):
        def signed_distance(self) -> None:
            return np.zeros((4, 4, 4))  # type: ignore[return-value]


# --- seeds


class Unseeded(Sky):
    def rng(self, run: Run) -> np.random.Generator:
        return np.random.default_rng()


class OneSeed(Sky):
    def rng(self, run: Run) -> np.random.Generator:
        return {0: np.random.default_rng(0)}[run.seed]


# --- test views


class Peeks(Sky):
    """Follows the link of a training image to the scene and takes a test image's colour, where there is one."""

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Model:
        fitted = super().fit(scene, config, run)
        seen = self.peek(self.test_image(scene))
        if seen is not None:
            fitted.mean = np.asarray(seen).mean(axis=(0, 1)) / 255
        return fitted

    def test_image(self, scene: TrainingScene) -> Path:
        image = min((scene.directory / "ims" / scene.train[0]).iterdir()).resolve()
        return image.parents[1] / scene.test[0] / image.name

    def peek(self, image: Path) -> object:
        from PIL import Image, UnidentifiedImageError

        try:
            return Image.open(image).convert("RGB")
        except UnidentifiedImageError:
            return None


class PeeksNatively(Peeks):
    def peek(self, image: Path) -> object:
        import cv2

        return cv2.imread(str(image))


class PeeksInVain(Peeks):
    def peek(self, image: Path) -> object:
        image.read_bytes()


class PeeksNativelyInVain(Peeks):
    def peek(self, image: Path) -> object:
        subprocess.run(["cat", str(image)], stdout=subprocess.DEVNULL, check=True)


class Lists(Peeks):
    """Looks where the test views might be."""

    def peek(self, image: Path) -> object:
        sorted(image.parents[1].iterdir())


class PeeksWhenLoaded(Peeks):
    """Asks for the test image only when it loads."""

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Model:
        return Sky.fit(self, scene, config, run)

    def load(self, directory: Path, scene: TrainingScene) -> Model:
        model = super().load(directory, scene)
        seen = self.peek(self.test_image(scene))
        if seen is not None:
            model.mean = np.asarray(seen).mean(axis=(0, 1)) / 255
        return model


# --- files elsewhere, processes


class Litters(Sky):
    def step(self, scene: TrainingScene, config: Settings, run: Run, step: int) -> None:
        super().step(scene, config, run, step)
        Path(config.place).write_text("mine")


class LittersFromAFork(Litters):
    """The file is written by a process that the method forks."""

    def step(self, scene: TrainingScene, config: Settings, run: Run, step: int) -> None:
        Sky.step(self, scene, config, run, step)
        child = os.fork()
        if child == 0:
            Path(config.place).write_text("mine")
            os._exit(0)
        os.waitpid(child, 0)


class Scribbles(Sky):
    """Brightens a training image in place: through the link, it is the scene's own."""

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Model:
        path = min((scene.directory / "ims" / scene.train[0]).iterdir())
        fitted = super().fit(scene, config, run)
        with path.open("ab") as stream:
            stream.write(b"\0")
        return fitted


class KeepsNotes(Sky):
    """Writes into the folder that it was given as the scene."""

    def step(self, scene: TrainingScene, config: Settings, run: Run, step: int) -> None:
        super().step(scene, config, run, step)
        (scene.directory / "notes.json").write_text(json.dumps({"step": step}))


class LeavesProcess(Sky):
    def step(self, scene: TrainingScene, config: Settings, run: Run, step: int) -> None:
        super().step(scene, config, run, step)
        if step == 0:
            subprocess.Popen(["sleep", "300"], start_new_session=True)


class Slow(Sky):
    """For whoever wants to stop it."""

    def step(self, scene: TrainingScene, config: Settings, run: Run, step: int) -> None:
        super().step(scene, config, run, step)
        if config.place:
            Path(config.place).touch()
            clock.sleep(300)


class Offers(Sky):
    """Offers its state at every step, and takes long enough for two of them."""

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Model:
        self.phase = np.zeros(3)
        for step in range(config.steps):
            self.step(scene, config, run, step)
            clock.sleep(0.2)
            self.phase = self.phase + self.rng(run).uniform(0, 1, 3)
            run.checkpoint(lambda: self.state(scene))
        return self.model(np.full(3, 0.5), self.phase, scene)

    def state(self, scene: TrainingScene) -> Model:
        return self.model(np.full(3, 0.5), self.phase, scene)


class OffersAndChanges(Offers):
    """Goes on from a rounded state once it was asked for it."""

    def state(self, scene: TrainingScene) -> Model:
        self.phase = self.phase.round(1)
        return super().state(scene)


class OffersTooEarly(Offers):
    """Its first state is none."""

    def state(self, scene: TrainingScene) -> Model:
        model = super().state(scene)
        if self.phase.max() < 1:
            model.mean = np.full(3, np.nan)
        return model


# --- scenes at the edge


class NeedsFrames(Sky):
    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Model:
        assert scene.times[1] > scene.times[0]
        return super().fit(scene, config, run)


class NeedsLiquid(Sky):
    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Model:
        covered = sum(scene.mask(name, t).sum() for name in scene.train for t in range(scene.n_frames))
        1 / int(covered)
        return super().fit(scene, config, run)


class SaysSo(NeedsLiquid):
    """Refuses both with a reason, in the two ways there are."""

    def supports(self, scene: TrainingScene) -> Support:
        return Support(scene.n_frames > 1, "needs two timesteps")

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Model:
        try:
            return super().fit(scene, config, run)
        except ZeroDivisionError:
            raise SplashbenchError("there is no liquid in the masks; look at seg/") from None


class Mute(Sky):
    """Refuses everything, and does not say why."""

    def supports(self, scene: TrainingScene) -> Support:
        return Support(False)


# --- budgets


class Padded(Model):
    """Stores bytes that nobody needs."""

    padding = 50_000

    def save(self, directory: Path) -> None:
        super().save(directory)
        (directory / "padding").write_bytes(bytes(self.padding))


class Spendthrift(Sky):
    """Says that it keeps to bytes, and does not."""

    Model = Padded
    budgets = ("storage_bytes",)


class Thrifty(Sky):
    """Takes a second, and 50 kB; fewer where it is asked to."""

    Model = Padded
    budgets = ("seconds", "storage_bytes", "memory_bytes")

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Model:
        fitted = super().fit(scene, config, run)
        clock.sleep(min(1.0, 0.5 * (run.budget.seconds or 2)))
        fitted.padding = 1000 if run.budget.storage_bytes else Padded.padding
        return fitted


class Late(Sky):
    """Says that it keeps to seconds, and does not."""

    budgets = ("seconds",)

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Model:
        clock.sleep(1.0)
        return super().fit(scene, config, run)


class Misspelt(Sky):
    budgets = ("storage",)


class GivesUp(Sky):
    """Keeps to its budget by having nothing to show."""

    budgets = ("storage_bytes",)

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> Model:
        if run.budget.limits:
            raise SplashbenchError("so few bytes are no model; give more")
        return super().fit(scene, config, run)

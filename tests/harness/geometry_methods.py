"""Methods that hand in a signed distance, for the tests of the harness. Given to `run` as FILE.py:CLASS."""

from pathlib import Path

import numpy as np

from splashbench.harness.contract import Fitted, Method, MethodConfig, Render, Run
from splashbench.scene import Camera, Particles, SignedDistance, TrainingScene
from splashbench.scene.particles import MAX_PARTICLES


class _Cube(Fitted):
    """A cube of liquid that no picture shows."""

    def __init__(self, n_frames: int) -> None:
        self.n_frames = n_frames

    def render(self, camera: Camera, time: float) -> Render:
        size = (camera.height, camera.width)
        return Render(np.zeros((*size, 3), np.float32), np.zeros(size, np.float32))

    def particles(self) -> Particles | None:
        return None

    def signed_distance(self) -> SignedDistance | None:
        phi = np.full((self.n_frames, 6, 6, 6), 1.0)
        phi[:, 2:4, 2:4, 2:4] = -0.5
        return SignedDistance.of(phi, np.array([0.1, 0.2, 0.3]), 0.05)

    def save(self, directory: Path) -> None:
        (directory / "model.txt").write_text("cube")


class Geometry(Method):
    """Hands in geometry and no particles."""

    id, title, Config = "geometry", "a cube", MethodConfig

    def fit(self, scene: TrainingScene, config: MethodConfig, run: Run) -> Fitted:
        return _Cube(scene.n_frames)

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        return _Cube(scene.n_frames)


class ShortGeometry(Geometry):
    """Forgets a timestep."""

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        return _Cube(scene.n_frames - 1)


class _Dust(_Cube):
    """More particles than a file may hold."""

    def particles(self) -> Particles:
        positions = np.zeros((self.n_frames, MAX_PARTICLES + 1, 3), np.float32)
        positions[:, :, 0] = np.arange(MAX_PARTICLES + 1)
        return Particles(positions, np.ones(positions.shape[:2], bool))


class Dust(Geometry):
    """Hands in too many particles."""

    def load(self, directory: Path, scene: TrainingScene) -> Fitted:
        return _Dust(scene.n_frames)

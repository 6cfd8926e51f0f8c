"""The views that a submission holds, where there is no model to render others."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Fitted, Render
from splashbench.scene import Camera, Particles, TrainingScene
from splashbench.submission import Submission
from splashbench.submission.submission import render_path
from splashbench.submission.withheld import kept_timesteps

# How far from a timestep a time may be to be that timestep, in shares of the time between two.
_SAME = 1e-3


class StoredViews(Fitted):
    """Renders of the test cameras at the timesteps, read from the submission. remedy: why there is nothing else."""

    def __init__(self, submission: Submission, scene: TrainingScene, remedy: str) -> None:
        self._submission, self._scene, self._remedy = submission, scene, remedy

    def render(self, camera: Camera, time: float) -> Render:
        """The stored view. Raises SplashbenchError for a camera that is no test camera, and between timesteps."""
        times = self._scene.camera_times.get(camera.name, self._scene.times)
        t = int(np.abs(times - time).argmin())
        step = float(np.diff(self._scene.times).min()) if len(self._scene.times) > 1 else 1.0
        directory = self._submission.directory
        here = self._scene.test_cameras.get(camera.name)
        same = here is not None and np.array_equal(here.w2c, camera.w2c) and np.array_equal(here.K, camera.K)
        # A time of another camera's clock is near this one's own.
        near = min(abs(times[t] - time), abs(self._scene.times[t] - time)) <= _SAME * step
        # Renders bear the scene's numbers, and the scene known here may have the timesteps alone that the method saw.
        number = self._number(camera.name, t) if same else t
        if not same or not near or not render_path(directory, "renders", camera.name, number).is_file():
            raise SplashbenchError(
                f"{directory} {self._remedy} (it has test views {', '.join(self._scene.test)} at the timesteps alone)"
            )
        rgb = self._submission.rendering(camera.name, number).astype(np.float32) / np.float32(255)
        return Render(rgb, self._submission.alpha(camera.name, number))

    def _number(self, camera: str, t: int) -> int:
        """The number in the whole scene of timestep `t` of those that are known here."""
        withheld = self._submission.identity.withheld
        if withheld is None:
            return t
        folder = render_path(self._submission.directory, "renders", camera, 0).parent
        kept = kept_timesteps(len(list(folder.glob("*.png"))), withheld)
        return kept[t] if t < len(kept) else t

    def particles(self) -> Particles | None:
        """The submission's particles."""
        return self._submission.particles()

    def save(self, directory: Path) -> None:
        """There is nothing to save."""
        raise SplashbenchError(f"{self._submission.directory} {self._remedy}")

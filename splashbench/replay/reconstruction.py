"""A fitted reconstruction: the model that a submission keeps, its cameras and its times."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError, one_line
from splashbench.harness.contract import Fitted, Render
from splashbench.harness.discovery import load_method, registered
from splashbench.harness.training_copy import make_training_copy
from splashbench.replay.stored_views import StoredViews
from splashbench.scene import Camera, Gaussians, Particles, Scene, SignedDistance, TrainingScene, VelocityField
from splashbench.submission import Status, Submission
from splashbench.submission.cameras import CAMERAS, read_cameras
from splashbench.submission.withheld import kept_timesteps

Answer = TypeVar("Answer")

_NO_MODEL = "keeps no model; run the method again, without --no-model"


class Reconstruction:
    """A liquid that was reconstructed. Use `splashbench.load`.

    Attributes:
        submission: what it was read from. name: of the method, as in charts.
        scene: the Scene where it was given, else None: then there are no photographs to compare with.
        cameras: name -> Camera, training cameras first. train, test: their names.
        times: [T] seconds, the timesteps that the method saw. times_source: as of a Scene; "nominal" is an order alone.
        fitted: the method's model, or the stored views where no model is kept.
    """

    def __init__(self, submission: Submission, fitted: Fitted, known: TrainingScene, scene: Scene | None) -> None:
        self.submission, self.fitted, self.scene = submission, fitted, scene
        self.name = submission.identity.method
        self.train, self.test = tuple(known.train), tuple(known.test)
        self.cameras: dict[str, Camera] = {**known.cameras, **known.test_cameras}
        self.times: NDArray[np.float64] = known.times
        self.times_source = known.times_source
        self.camera_times = known.camera_times
        self.gravity, self.metres_per_unit = known.gravity, known.metres_per_unit
        self._known = known

    def __repr__(self) -> str:
        identity = self.submission.identity
        span = f"{len(self.times)} timesteps from {self.times[0]:.3f} to {self.times[-1]:.3f} s"
        cameras = f"{len(self.train)} training and {len(self.test)} test cameras"
        return f"<Reconstruction {identity.method} ({identity.preset}) of {identity.scene}: {span}, {cameras}>"

    @property
    def has_model(self) -> bool:
        """Whether it can be rendered from anywhere; else there are the submission's own views alone."""
        return not isinstance(self.fitted, StoredViews)

    def shown_by(self, fitted: Fitted) -> Reconstruction:
        """The same liquid, rendered by another model, such as one of another dye."""
        return Reconstruction(self.submission, fitted, self._known, self.scene)

    def camera(self, name: str) -> Camera:
        """The scene's camera `name`. Raises SplashbenchError where there is none."""
        if name not in self.cameras:
            raise SplashbenchError(f"there is no camera {name[:40]!r}; choose one of {', '.join(self.cameras)}")
        return self.cameras[name]

    def render(self, camera: Camera | str, time: float) -> Render:
        """The view of `camera`, one of the scene's by name or any other, at `time` in seconds.

        Any time within the recording will do, between timesteps too; a step beyond either end the first or last
        timestep is shown, and farther out SplashbenchError is raised. So it is for other cameras than the test cameras,
        and between timesteps, where there is no model.
        """
        self._require_recorded(time)
        seen_by = self.camera(camera) if isinstance(camera, str) else camera

        def rendered() -> Render:
            view = self.fitted.render(seen_by, float(time))
            size, shapes = (seen_by.height, seen_by.width), (np.shape(view.rgb), np.shape(view.alpha))
            if shapes != ((*size, 3), size):
                raise ValueError(f"pictures of shape {shapes[0]} and {shapes[1]} for a camera of {size}")
            if not (np.isfinite(view.rgb).all() and np.isfinite(view.alpha).all()):
                raise ValueError("pictures with values that are not finite")
            return view

        return self._asked(f"the view of camera {seen_by.name} at {time:.4g} s", rendered)

    def _asked(self, what: str, answer: Callable[[], Answer]) -> Answer:
        """`answer`, which asks the method for `what`. Raises SplashbenchError where the method fails."""
        try:
            return answer()
        except (SplashbenchError, MemoryError):
            raise
        except Exception as error:  # a stranger's code, or a model that nobody foresaw
            raise SplashbenchError(
                f"method {self.submission.identity.method} cannot give {what} of {self.submission.directory} "
                f"({one_line(f'{type(error).__name__}: {error}')}); test the method, or run it again"
            ) from error

    def _require_recorded(self, time: float) -> None:
        """Raise SplashbenchError for a time that is not of the recording; cameras' own times may lie a step beyond."""
        first, last = float(self.times[0]), float(self.times[-1])
        step = float(np.diff(self.times).max()) if len(self.times) > 1 else 1.0
        if not first - step <= time <= last + step:
            raise SplashbenchError(f"{time:g} s is not of the recording, which lasts from {first:.3f} to {last:.3f} s")

    def empty_view(self, camera: Camera | str) -> NDArray[np.float32] | None:
        """What the view would be without liquid, float32 [H, W, 3], sRGB in [0, 1]; None where that is not known."""
        seen_by = self.camera(camera) if isinstance(camera, str) else camera
        return self._asked("the view without liquid", lambda: self.fitted.empty_view(seen_by))

    def gaussians(self, time: float, eye: NDArray | None = None) -> Gaussians | None:
        """The liquid's Gaussians at `time`, coloured as seen from `eye` [3] (scene units; the cameras' mean place)."""
        self._require_recorded(time)
        seen_from = self.eye if eye is None else np.asarray(eye, dtype=np.float64)
        return self._asked(f"Gaussians at {time:.4g} s", lambda: self.fitted.gaussians(float(time), seen_from))

    def static_gaussians(self, eye: NDArray | None = None) -> Gaussians | None:
        """The background's Gaussians, as `gaussians`; None where the method keeps no background apart."""
        seen_from = self.eye if eye is None else np.asarray(eye, dtype=np.float64)
        return self._asked("the background's Gaussians", lambda: self.fitted.static_gaussians(seen_from))

    @cached_property
    def eye(self) -> NDArray[np.float64]:
        """The mean place of the training cameras [3], scene units."""
        return np.asarray(np.mean([self.cameras[name].center for name in self.train], axis=0))

    @cached_property
    def _particles(self) -> Particles | None:
        stored = self.submission.particles()
        # A run that withholds timesteps hands in none, while its model has those of the timesteps that it saw.
        return self._asked("particles", self.fitted.particles) if stored is None else stored

    def particles(self) -> Particles | None:
        """The method's particles on the timesteps, or None. Raises SplashbenchError for those of other timesteps."""
        particles = self._particles
        if particles is not None:
            self._require_timesteps("particles.npz", particles.n_frames)
        return particles

    def _require_timesteps(self, file: str, count: int) -> None:
        """Raise SplashbenchError unless the submission's `file` has as many instants as there are timesteps."""
        if count != len(self.times):
            raise SplashbenchError(
                f"{self.submission.directory / file} has {count} instants, and its scene {len(self.times)} timesteps; "
                "run the method again"
            )

    @cached_property
    def _distances(self) -> SignedDistance | None:
        return self.submission.geometry()

    def surface(self, time: float) -> SignedDistance | None:
        """The liquid's signed distance at `time` (one instant), or None for a method that hands in none.

        Between timesteps it is the method's own, else the mean of the two around, weighted by nearness.
        """
        self._require_recorded(time)
        made = self._asked(f"the surface at {time:.4g} s", lambda: self.fitted.surface(float(time)))
        if made is not None:
            return made
        distances = self._distances
        if distances is None:
            return None
        self._require_timesteps("geometry.npz", distances.n_frames)
        if len(self.times) == 1:
            t, share = 0, 0.0
        else:
            inside = float(np.clip(time, self.times[0], self.times[-1]))
            t = int(np.clip(np.searchsorted(self.times, inside, side="right") - 1, 0, len(self.times) - 2))
            share = (inside - self.times[t]) / (self.times[t + 1] - self.times[t])
        if share < 1e-6:
            return SignedDistance(distances.phi[t : t + 1], distances.origin, distances.voxel)
        blended = (1 - share) * distances.phi[t].astype(np.float32) + share * distances.phi[t + 1]
        steps = np.rint(blended).astype(np.int8)
        steps[(steps == 0) & (blended < 0)] = -1
        return SignedDistance(steps[None], distances.origin, distances.voxel)

    def velocity(self, time: float) -> VelocityField | None:
        """The liquid's velocity at `time` on a grid, or None for a method without one."""
        self._require_recorded(time)
        return self._asked(f"the velocity at {time:.4g} s", lambda: self.fitted.velocity(float(time)))


def load(
    submission: Path | str, scene: Scene | Path | str | None = None, verify: bool = True, method: str | None = None
) -> Reconstruction:
    """Open what `splashbench run` wrote, to be rendered from anywhere at any time.

    Args:
        submission: its folder.
        scene: the scene, or its folder. Methods whose opacity of the liquid comes from masks need it, and so do
            photographs to compare with; for splashsplat it may be left out.
        verify: whether files must have the digests that SHA256SUMS states.
        method: `FILE.py:CLASS` of a method that is not installed, which runs its code.

    Example: `splashbench.load("submissions/bowl").render("3", time=2.5).rgb` is an image [H, W, 3] in [0, 1].

    Raises SplashbenchError for a folder that is no submission, a run that failed, a method that is not installed, a
    scene that is another, or files that are damaged.
    """
    opened = Submission.open(Path(submission), verify=verify)
    identity = opened.identity
    if opened.status != Status.OK:
        raise SplashbenchError(
            f"{submission} is of a run that ended with status {opened.status.value}; nothing to show"
        )
    whole = scene if scene is None or isinstance(scene, Scene) else Scene.open(Path(scene))
    if whole is not None and whole.digest != identity.scene_digest:
        raise SplashbenchError(
            f"{submission} was made for another version of scene {identity.scene} than {whole.directory}; give the "
            "scene it was run on"
        )
    known = _known_scene(opened, whole)
    model = opened.directory / "model"
    if not model.is_dir():
        return Reconstruction(opened, StoredViews(opened, known, _NO_MODEL), known, whole)
    if method is None and identity.method not in registered():
        remedy = f"is of method {identity.method}, which is not installed here; install it to see other views"
        return Reconstruction(opened, StoredViews(opened, known, remedy), known, whole)
    loader = load_method(method or identity.method)
    if loader.id != identity.method:
        raise SplashbenchError(
            f"{submission} is of method {identity.method}, and {method} is {loader.id}; give its own"
        )
    try:
        fitted = loader.load(model, known)
    except SplashbenchError:
        raise
    except Exception as error:
        said = f"{type(error).__name__}: {error}"
        raise SplashbenchError(f"{model} cannot be loaded by {loader.id} {loader.version} ({said})") from error
    return Reconstruction(opened, fitted, known, whole)


def _known_scene(submission: Submission, scene: Scene | None) -> TrainingScene:
    """What the method is told when its model is loaded."""
    identity = submission.identity
    if scene is not None and identity.withheld is None:
        return scene.training()
    if scene is not None:
        scratch = Path(tempfile.mkdtemp(prefix="splashbench-"))
        kept = kept_timesteps(scene.n_frames, identity.withheld)
        known = Scene.open(make_training_copy(scene, scratch / "scene", kept)).training()
        weakref.finalize(known, shutil.rmtree, scratch, ignore_errors=True)  # links and small files
        return known
    absent = read_cameras(submission.directory)
    if absent is None:
        raise SplashbenchError(
            f"{submission.directory} has no {CAMERAS}, as it was written by an earlier version; give its scene "
            "(--scene, or scene=...)"
        )
    return absent

"""cameras.json of a submission: the cameras and times of its scene, so that its model can be shown without the scene.

It holds what a method is told of a scene besides images and masks. A model whose rendering needs those says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from splashbench.errors import SplashbenchError, one_line
from splashbench.files import read_model
from splashbench.scene import Camera, ContainerMesh, Scene, TrainingScene

CAMERAS = "cameras.json"
_MAX_FRAMES, _MAX_CAMERAS, _MAX_SIDE = 100_000, 1000, 32_768
_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][\w.-]{0,99}$")]
_Number = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]
_Row = Annotated[list[_Number], Field(min_length=3, max_length=4)]
_Times = Annotated[list[_Number], Field(min_length=1, max_length=_MAX_FRAMES)]


class _View(BaseModel):
    """A camera of the scene: pixels, intrinsics 3x3, world-to-camera 4x4, and its own times where they are known."""

    model_config = ConfigDict(extra="forbid")
    name: _Name
    width: int = Field(gt=0, le=_MAX_SIDE)
    height: int = Field(gt=0, le=_MAX_SIDE)
    K: list[_Row] = Field(min_length=3, max_length=3)
    w2c: list[_Row] = Field(min_length=4, max_length=4)
    test: bool
    times: _Times | None = None


class SceneViews(BaseModel):
    """cameras.json."""

    model_config = ConfigDict(extra="forbid")
    schema_version: Literal[1] = 1
    scene: str = Field(max_length=1000)
    times: _Times
    times_source: str = Field(max_length=100)
    gravity: list[_Number] | None = Field(default=None, min_length=3, max_length=3)
    metres_per_unit: float | None = Field(default=None, ge=1e-9, le=1e9, allow_inf_nan=False)
    container_transparent: bool | None = None
    is_released: bool = False
    cameras: list[_View] = Field(min_length=1, max_length=_MAX_CAMERAS)


def scene_views(scene: Scene, kept: Sequence[int] | None = None) -> SceneViews:
    """What cameras.json says of `scene`. kept: the timesteps that the method saw; all by default.

    Raises SplashbenchError for a scene that it has no room for; to be called before hours go into a fit.
    """
    try:
        return _scene_views(scene, kept)
    except ValidationError as error:
        first = error.errors()[0]
        place = " ".join(map(str, first["loc"]))
        raise SplashbenchError(
            f"{scene.directory}: a submission cannot say its cameras ({place}: {one_line(first['msg'])}); change them"
        ) from None


def _scene_views(scene: Scene, kept: Sequence[int] | None) -> SceneViews:
    steps = list(range(scene.n_frames) if kept is None else kept)
    views = [
        _View(
            name=name,
            width=camera.width,
            height=camera.height,
            K=camera.K.tolist(),
            w2c=camera.w2c.tolist(),
            test=name in scene.test,
            times=None
            if np.array_equal(scene.camera_times[name], scene.times)
            else scene.camera_times[name][steps].tolist(),
        )
        for name, camera in scene.cameras.items()
    ]
    return SceneViews(
        scene=scene.name,
        times=scene.times[steps].tolist(),
        times_source=scene.times_source,
        gravity=None if scene.gravity is None else scene.gravity.tolist(),
        metres_per_unit=scene.metres_per_unit,
        container_transparent=scene.container_transparent,
        is_released=scene.is_released,
        cameras=views,
    )


def read_cameras(directory: Path) -> AbsentScene | None:
    """The scene that cameras.json of a submission tells of; None where there is no such file.

    Raises SplashbenchError naming the file where it is none.
    """
    path = Path(directory) / CAMERAS
    return AbsentScene(path, read_model(path, SceneViews)) if path.is_file() else None


def _require_sense(path: Path, views: SceneViews) -> None:
    """Raise SplashbenchError for what each field allows and all of them together do not."""
    names = [view.name for view in views.cameras]
    faults = {
        "two cameras have one name": len(set(names)) < len(names),
        "there is no training camera, or no test camera": len({view.test for view in views.cameras}) < 2,
        "a K is not that of a pinhole without skew": any(
            [len(row) for row in view.K] != [3, 3, 3] or view.K[2] != [0, 0, 1] or view.K[0][1] or view.K[1][0]
            for view in views.cameras
        ),
        "a w2c does not end in 0 0 0 1": any(
            [len(row) for row in view.w2c] != [4] * 4 or view.w2c[3] != [0, 0, 0, 1] for view in views.cameras
        ),
        "gravity has no direction": views.gravity is not None and not np.linalg.norm(views.gravity) > 1e-6,
    }
    for fault, found in faults.items():
        if found:
            raise SplashbenchError(f"{path}: {fault}; run the method again")


class AbsentScene(TrainingScene):
    """A scene of which a submission knows cameras and times alone: images and masks are elsewhere."""

    def __init__(self, path: Path, views: SceneViews) -> None:
        self._path = path
        self.name, self.directory = views.scene, path.parent
        self.train = tuple(view.name for view in views.cameras if not view.test)
        self.test = tuple(view.name for view in views.cameras if view.test)
        _require_sense(path, views)
        try:
            cameras = {
                view.name: Camera(view.name, view.width, view.height, np.array(view.K), np.array(view.w2c))
                for view in views.cameras
            }
        except ValueError as error:
            raise SplashbenchError(f"{path}: {error}; run the method again") from None
        self.cameras = {name: cameras[name] for name in self.train}
        self.test_cameras = {name: cameras[name] for name in self.test}
        self.times = np.array(views.times, dtype=np.float64)
        self.n_frames = len(self.times)
        self.frames = tuple(f"{t:06d}" for t in range(self.n_frames))
        self.times_source = views.times_source
        own = {view.name: self.times if view.times is None else np.array(view.times) for view in views.cameras}
        if any(times.shape != self.times.shape or (np.diff(times) <= 0).any() for times in own.values()):
            raise SplashbenchError(f"{path}: its times do not rise, or cameras differ in their number; run again")
        self.camera_times = own
        self.gravity = None if views.gravity is None else np.array(views.gravity)
        self.metres_per_unit, self.is_released = views.metres_per_unit, views.is_released
        self.container_transparent = views.container_transparent
        self.variation = ""

    def _absent(self, what: str) -> SplashbenchError:
        return SplashbenchError(f"{what} of scene {self.name} are needed here, and not in a submission; give the scene")

    def image(self, camera: str, t: int) -> NDArray[np.uint8]:
        raise self._absent("images")

    def mask(self, camera: str, t: int) -> NDArray[np.bool_]:
        raise self._absent("masks")

    def container_mask(self, camera: str) -> NDArray[np.bool_] | None:
        raise self._absent("container masks")

    def container_mesh(self) -> ContainerMesh | None:
        raise self._absent("the container's mesh and the like")

    def initial_points(self) -> NDArray[np.float32] | None:
        raise self._absent("sparse points")

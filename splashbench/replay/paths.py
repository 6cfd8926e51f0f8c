"""Camera paths: a camera for every frame of a video. Orbits, and nerfstudio's camera-path JSON read and written.

nerfstudio's viewer writes `camera_path`, a list of `camera_to_world` (4x4 row by row, OpenGL axes: x right, y up,
z backward), `fov` (vertical, degrees) and `aspect`, with `render_width`, `render_height`, `fps` and `seconds`. Its
cameras have square pixels and their principal point in the centre. For those that have not, and for times in seconds,
there are further keys here, which nerfstudio ignores.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field

from splashbench.errors import SplashbenchError
from splashbench.files import read_model, write_json
from splashbench.scene import Camera, look_at

MAX_FRAMES, MAX_SIDE, MAX_FPS = 100_000, 8192, 1000.0

# OpenGL's camera axes (x right, y up, z backward) as OpenCV's (x right, y down, z forward), and the other way.
_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
# Largest gap between the azimuths of neighbouring cameras, in degrees, around which there are cameras everywhere.
_ALL_AROUND = 90.0
# An arc of so few radians is rounding.
_STILL = 1e-6
# How near to the poles an orbit may be: there the picture has no up.
_STEEPEST = 89.0

_Number = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]
_Focal = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)]


@dataclass(frozen=True)
class CameraPath:
    """A camera for every frame of a video.

    Attributes:
        cameras: N of one size, at least one.
        times: [N] seconds on the scene's clock, or None where the path says nothing of them.
        fps: frames a second.

    Raises ValueError for cameras that differ in size, other numbers of times, and times or rates that are no numbers.
    """

    cameras: tuple[Camera, ...]
    times: NDArray[np.float64] | None
    fps: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple(self.cameras))
        if not 1 <= len(self.cameras) <= MAX_FRAMES:
            raise ValueError(f"a path has 1 to {MAX_FRAMES} cameras, not {len(self.cameras)}")
        sizes = {(camera.width, camera.height) for camera in self.cameras}
        if len(sizes) > 1:
            raise ValueError(f"the cameras of a path have one size, not {len(sizes)}")
        if self.times is not None:
            times = np.array(self.times, dtype=np.float64)
            if times.shape != (len(self.cameras),) or not np.isfinite(times).all():
                raise ValueError(f"a path of {len(self.cameras)} cameras has as many times, which are numbers")
            object.__setattr__(self, "times", times)
        if not 0 < self.fps <= MAX_FPS:
            raise ValueError(f"a path has up to {MAX_FPS:g} frames a second, not {self.fps}")

    def __len__(self) -> int:
        return len(self.cameras)


class _Frame(BaseModel):
    """A frame of `camera_path`. Keys beyond nerfstudio's: `time` in seconds, and fl_x, fl_y, cx, cy in pixels."""

    model_config = ConfigDict(extra="ignore")
    camera_to_world: list[_Number] = Field(min_length=16, max_length=16)
    fov: float = Field(gt=0, lt=180, allow_inf_nan=False)
    render_time: float | None = Field(default=None, ge=0, le=1, allow_inf_nan=False)
    time: _Number | None = None
    fl_x: _Focal | None = None
    fl_y: _Focal | None = None
    cx: _Number | None = None
    cy: _Number | None = None


class _File(BaseModel):
    """A camera path as nerfstudio's viewer writes it; its key frames are not needed."""

    model_config = ConfigDict(extra="ignore")
    camera_path: list[_Frame] = Field(min_length=1, max_length=MAX_FRAMES)
    render_width: int = Field(ge=1, le=MAX_SIDE)
    render_height: int = Field(ge=1, le=MAX_SIDE)
    fps: float = Field(gt=0, le=MAX_FPS, allow_inf_nan=False)
    camera_type: str = Field(default="perspective", max_length=100)


def read_camera_path(path: Path, span: tuple[float, float] | None = None) -> CameraPath:
    """Read a camera path that nerfstudio's viewer or `write_camera_path` wrote.

    Args:
        span: seconds of the recording's first and last instant, which nerfstudio calls 0 and 1 (`render_time`). Without
            it, or where not every frame has a time, the path has none.

    Raises SplashbenchError naming the file and its first fault.
    """
    path = Path(path)
    data = read_model(path, _File)
    if data.camera_type.lower() != "perspective":
        raise SplashbenchError(f"{path}: camera_type is {data.camera_type}; save the path with perspective cameras")
    cameras = [_camera(path, k, frame, data) for k, frame in enumerate(data.camera_path)]
    times: list[float | None] = [frame.time for frame in data.camera_path]
    if span is not None:
        start, end = span
        times = [
            start + frame.render_time * (end - start) if time is None and frame.render_time is not None else time
            for time, frame in zip(times, data.camera_path)
        ]
    known = [time for time in times if time is not None]
    try:
        return CameraPath(tuple(cameras), np.array(known) if len(known) == len(times) else None, data.fps)
    except ValueError as error:
        raise SplashbenchError(f"{path}: {error}; fix the file") from None


def _camera(path: Path, k: int, frame: _Frame, data: _File) -> Camera:
    width, height = data.render_width, data.render_height
    focal = height / (2 * math.tan(math.radians(frame.fov) / 2))
    fx, fy = frame.fl_x or focal, frame.fl_y or focal
    cx, cy = width / 2 if frame.cx is None else frame.cx, height / 2 if frame.cy is None else frame.cy
    try:
        w2c = np.linalg.inv(np.reshape(frame.camera_to_world, (4, 4)) @ _AXES)
        return Camera(f"path_{k:06d}", width, height, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), w2c)
    except (ValueError, np.linalg.LinAlgError):
        raise SplashbenchError(
            f"{path}: camera_path.{k}: camera_to_world is no rotation and place, in 4x4 row by row; fix this entry"
        ) from None


def write_camera_path(path: Path, cameras: Sequence[Camera], times: Sequence[float], fps: float) -> None:
    """Write a camera path as nerfstudio's viewer does, with `time` in seconds beside each frame; whole or not at all.

    Args:
        cameras: N of one size. times: [N] seconds on the scene's clock. fps: frames a second.

    `read_camera_path` gives the same cameras and times. Where a camera's pixels are not square or its principal point
    is off the centre, fl_x, fl_y, cx and cy say so in pixels; nerfstudio then shows the nearest that it can.
    Raises SplashbenchError for what is no path, see `CameraPath`.
    """
    try:
        whole = CameraPath(tuple(cameras), np.asarray(times, dtype=np.float64), float(fps))
    except ValueError as error:
        raise SplashbenchError(f"{path} cannot be written: {error}") from None
    width, height = whole.cameras[0].width, whole.cameras[0].height
    assert whole.times is not None
    frames = [_frame(camera, time) for camera, time in zip(whole.cameras, whole.times)]
    write_json(
        Path(path),
        {
            "camera_type": "perspective",
            "render_width": width,
            "render_height": height,
            "fps": whole.fps,
            "seconds": len(whole) / whole.fps,
            "is_cycle": False,
            "smoothness_value": 0.0,
            "default_fov": frames[0]["fov"],
            "default_transition_sec": 1 / whole.fps,
            # nerfstudio's viewer opens the key frames, its renderer the path.
            "keyframes": [
                {"matrix": frame["camera_to_world"], "fov": frame["fov"], "aspect": frame["aspect"]} for frame in frames
            ],
            "camera_path": frames,
        },
    )


def _frame(camera: Camera, time: float) -> dict[str, Any]:
    fx, fy, cx, cy = (float(camera.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    frame: dict[str, Any] = {
        "camera_to_world": (np.linalg.inv(camera.w2c) @ _AXES).ravel().tolist(),
        "fov": math.degrees(2 * math.atan(camera.height / (2 * fy))),
        "aspect": camera.width / camera.height,
        "time": float(time),
    }
    if (fx, cx, cy) != (fy, camera.width / 2, camera.height / 2):
        frame |= {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    return frame


def orbit(
    cameras: Sequence[Camera],
    target: ArrayLike,
    up: ArrayLike,
    frames: int,
    *,
    degrees: float | None = None,
    height: float | None = None,
    fps: float = 30.0,
) -> CameraPath:
    """A path of `frames` cameras around `target` [3] (scene units) at the distance of `cameras`, looking at it.

    Args:
        cameras: those that saw the scene; the orbit has the median of their distances and focal lengths.
        up: direction [3].
        degrees: of azimuth that the orbit covers, about the middle of the cameras' arc; by default that arc, since
            nothing was seen from behind it, or a circle where there are cameras all around. 360 is a circle.
        height: degrees above the horizon of `target`; by default the cameras' median.

    An arc is swept forth and back, slowing down at its ends, so that the video may be played in a loop; a circle is
    gone round once. Raises SplashbenchError where there is no camera beside `target`, and for an arc of 0.
    """
    center, vertical = np.asarray(target, dtype=np.float64), np.asarray(up, dtype=np.float64)
    vertical = vertical / np.linalg.norm(vertical)
    offsets = np.array([camera.center - center for camera in cameras])
    level = offsets - np.outer(offsets @ vertical, vertical)
    distances = np.linalg.norm(offsets, axis=1)
    beside = np.linalg.norm(level, axis=1) > 1e-6 * np.maximum(distances, 1e-12)
    if not beside.any():
        raise SplashbenchError("every camera is right above or below the liquid; give a view or a path, not an orbit")
    first = level[beside][0] / np.linalg.norm(level[beside][0])
    second = np.cross(vertical, first)
    middle, arc = _arc(np.arctan2(level[beside] @ second, level[beside] @ first))
    elevations = np.degrees(np.arcsin(np.clip(offsets @ vertical / np.maximum(distances, 1e-12), -1, 1)))
    elevation = math.radians(float(np.clip(np.median(elevations) if height is None else height, -_STEEPEST, _STEEPEST)))
    sweep = arc if degrees is None else math.radians(degrees)
    if not sweep > _STILL:
        raise SplashbenchError(
            "the training cameras look from one direction, so that there is no arc to move along; give the orbit's own "
            "(--orbit-degrees)"
        )
    phase = np.arange(frames) / frames
    circle = sweep >= 2 * math.pi - 1e-9
    angles = middle + (sweep * (phase - 0.5) if circle else -sweep / 2 * np.cos(2 * np.pi * phase))
    like = cameras[len(cameras) // 2]
    focal = float(np.median([camera.K[1, 1] * like.height / camera.height for camera in cameras]))
    K = np.array([[focal, 0, like.width / 2], [0, focal, like.height / 2], [0, 0, 1]])
    around = np.outer(np.cos(angles), first) + np.outer(np.sin(angles), second)
    eyes = center + np.median(distances) * (math.cos(elevation) * around + math.sin(elevation) * vertical)
    path = [Camera("orbit", like.width, like.height, K, look_at(eye, center, vertical)) for eye in eyes]
    return CameraPath(tuple(path), None, fps)


def _arc(azimuths: NDArray[np.float64]) -> tuple[float, float]:
    """The middle and the extent, in radians, of the arc that `azimuths` lie on: all but the largest gap between two."""
    rising = np.sort(np.mod(azimuths, 2 * np.pi))
    gaps = np.diff(np.append(rising, rising[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    if gaps[widest] <= math.radians(_ALL_AROUND):
        return float(rising[0]), 2 * math.pi
    start, extent = rising[(widest + 1) % len(rising)], 2 * math.pi - gaps[widest]
    return float(start + extent / 2), float(extent)

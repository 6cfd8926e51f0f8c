"""The files of a scene: the released layout's `*_meta.json` (Dynamic 3D Gaussians) and our optional scene.json.

The released layout is canonical (docs/scene_format.md), so the real dataset needs no conversion. scene.json holds
what the release lacks; it is optional.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from splashbench.errors import SplashbenchError
from splashbench.files import MAX_PIXELS, read_json, validate_model

# A camera folder and a file in it, and nothing that could lead out of `ims/`.
_IMAGE_PATH = re.compile(r"[A-Za-z0-9_][\w-]*/[A-Za-z0-9_][\w.-]*\.(?:jpg|jpeg|png|JPG|PNG)")
# Cameras are fixed. A difference beyond rounding is a moving camera, which is not supported.
_STATIC_TOLERANCE = 1e-6
# Of what a pose's last row may be off from 0 0 0 1.
_POSE_ROUNDING = 1e-6
# Pixels, scene units or seconds: nothing real comes near, and sums and squares stay finite.
LARGEST = 1e9


class _MetaFile(BaseModel):
    """The raw shape of train_meta.json and test_meta.json; other keys are allowed, as other writers add some."""

    model_config = ConfigDict(extra="ignore")
    w: int = Field(gt=0)
    h: int = Field(gt=0)
    k: list[list[list[list[float]]]]
    w2c: list[list[list[list[float]]]]
    fn: list[list[str]]


class SplitFile:
    """One `*_meta.json`, checked: static cameras and the image path of each frame and camera.

    Attributes:
        names: camera names, in file order.
        K, w2c: [C, 3, 3] and [C, 4, 4].
        paths: camera name -> image paths relative to `ims/`, a frame each.
        size: the (width, height) the file states for its images.
    """

    def __init__(self, path: Path) -> None:
        meta = validate_model(path, _MetaFile, read_json(path))
        n_frames = len(meta.fn)
        n_cameras = len(meta.fn[0]) if n_frames else 0
        if not n_frames or any(len(row) != n_cameras for row in meta.fn):
            raise SplashbenchError(f"{path}: fn must hold one list of image paths per frame, all of one length")
        intrinsics = static_matrices(path, "k", meta.k, (n_frames, n_cameras, 3, 3))
        w2c = static_matrices(path, "w2c", meta.w2c, (n_frames, n_cameras, 4, 4))
        for row in meta.fn:
            for name in row:
                if not _IMAGE_PATH.fullmatch(name) or ".." in name:
                    raise SplashbenchError(f"{path}: fn names {name!r}, not CAMERA/FRAME.jpg; fix the entry")
        self.names = tuple(name.split("/")[0] for name in meta.fn[0])
        if len(set(self.names)) != n_cameras:
            raise SplashbenchError(f"{path}: fn lists a camera twice in one frame; fix the entry")
        self.paths: dict[str, list[str]] = {name: [] for name in self.names}
        for t, row in enumerate(meta.fn):
            for c, name in enumerate(row):
                if name.split("/")[0] != self.names[c]:
                    raise SplashbenchError(f"{path}: fn changes the order of cameras at frame {t}; keep one order")
                self.paths[self.names[c]].append(name)
        for names in self.paths.values():
            if len(set(names)) != n_frames:
                twice = Counter(names).most_common(1)[0][0]
                raise SplashbenchError(f"{path}: fn names {twice} in two frames; fix the entry")
        self.K, self.w2c, self.size, self.n_frames = intrinsics, w2c, (meta.w, meta.h), n_frames


def static_matrices(path: Path, key: str, values: list, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """The first frame's matrices [C, ...] of `values`, after checking shape, finiteness and that nothing moves."""
    expected = "x".join(map(str, shape))
    try:
        array = np.array(values, dtype=np.float64)
    except ValueError:
        raise SplashbenchError(
            f"{path}: {key} is ragged; it must be {expected} (frames, cameras, rows, columns)"
        ) from None
    if array.shape != shape:
        actual = "x".join(map(str, array.shape))
        raise SplashbenchError(f"{path}: {key} is {actual}; it must be {expected} (frames, cameras, rows, columns)")
    if not np.isfinite(array).all() or np.abs(array).max(initial=0.0) > LARGEST:
        raise SplashbenchError(
            f"{path}: {key} has entries that are not finite or beyond {LARGEST:g}; write the calibration again"
        )
    scale = max(1.0, float(np.abs(array[0]).max(initial=0.0)))
    if np.abs(array - array[0]).max(initial=0.0) > _STATIC_TOLERANCE * scale:
        raise SplashbenchError(f"{path}: {key} changes between frames; moving cameras are not supported")
    return array[0]


class SceneMeta(BaseModel):
    """scene.json: what the released layout lacks. Every field may be null, for what is unknown.

    times: seconds of each timestep on the reference camera's clock. camera_times: each camera's own exposure times.
    sizes: image (width, height) per camera. metres_per_unit: metric scale. gravity: unit vector along which things
    fall, scene coordinates. container_mesh: path within the scene; container_pose: mesh-to-scene 4x4.
    container_transparent: whether the liquid is seen through the container.
    """

    model_config = ConfigDict(extra="forbid")
    schema_version: Literal[1] = 1
    name: str = Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}$")
    times: list[float] | None = None
    camera_times: dict[str, list[float]] | None = None
    sizes: dict[str, tuple[int, int]] | None = None
    metres_per_unit: float | None = Field(default=None, ge=1e-9, le=1e9, allow_inf_nan=False)
    gravity: tuple[float, float, float] | None = None
    container_mesh: str | None = None
    container_pose: list[list[float]] | None = None
    container_transparent: bool | None = None
    provenance: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> SceneMeta:
        if self.times is not None:
            _check_times("times", self.times)
        for camera, times in (self.camera_times or {}).items():
            _check_times(f"camera_times of camera {camera}", times)
        if self.gravity is not None and not abs(math.hypot(*self.gravity) - 1) <= 1e-3:
            raise ValueError("gravity must be a unit vector")
        if self.container_pose is not None:
            if [len(row) for row in self.container_pose] != [4] * 4:
                raise ValueError("container_pose must be 4x4")
            if not np.isfinite(self.container_pose).all():
                raise ValueError("container_pose must be finite")
            if np.abs(np.array(self.container_pose[3]) - [0, 0, 0, 1]).max() > _POSE_ROUNDING:
                raise ValueError("container_pose must end in 0 0 0 1; it may be transposed")
        for camera, (width, height) in (self.sizes or {}).items():
            if not (0 < width <= 65536 and 0 < height <= 65536 and width * height <= MAX_PIXELS):
                raise ValueError(f"sizes: camera {camera} has {width}x{height} pixels")
        return self


def plain_name(text: str) -> str:
    """`text`, such as a folder's name, as a name that `SceneMeta` takes: other characters become "_"."""
    return re.sub(r"[^A-Za-z0-9_.-]+|^[.-]+", "_", text)[:100] or "_"


def _check_times(what: str, times: list[float]) -> None:
    array = np.asarray(times, dtype=np.float64)
    if not (np.abs(array) <= LARGEST).all() or (np.diff(array) <= 0).any():
        raise ValueError(f"{what} must be finite and strictly increasing")

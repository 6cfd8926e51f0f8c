"""Blender's cameras: the transforms_*.json of NeRF's synthetic scenes, of which NeuroFluid's are a kind.

One camera, its horizontal field of view, and for each frame an image and a camera-to-world matrix in OpenGL's
convention (x right, y up, the camera looks along -z). The principal point is the image's centre.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator

from splashbench.errors import SplashbenchError
from splashbench.files import read_model
from splashbench.scene.layout import LARGEST, static_matrices

# A file below the view's folder, and nothing that could lead out of it.
_PATH = re.compile(r"(?:\./)?(?:[A-Za-z0-9_][\w-]*/){0,8}[A-Za-z0-9_][\w.-]*", re.ASCII)
_NUMBER = re.compile(r"(\d{1,9})(?:\.npz|\.png)?$", re.ASCII)
# OpenGL's camera axes (x right, y up, z backward) as OpenCV's (x right, y down, z forward).
_TO_OPENCV = np.diag([1.0, -1.0, -1.0])


class TransformsFrame(BaseModel):
    """One frame: `file_path` is the image without its ending .png, `particle_path` the state of the simulation."""

    model_config = ConfigDict(extra="ignore")
    file_path: str = Field(max_length=1000)
    particle_path: str | None = Field(default=None, max_length=1000)
    transform_matrix: list[list[float]]

    @field_validator("file_path", "particle_path")
    @classmethod
    def _inside(cls, path: str | None) -> str | None:
        if path is not None and (not _PATH.fullmatch(path) or ".." in path):
            raise ValueError(f"{path[:100]!r} is no path of a file below the view's folder")
        return path


class Transforms(BaseModel):
    """One transforms_*.json; other keys are ignored, `bounding_box` among them."""

    model_config = ConfigDict(extra="ignore")
    camera_angle_x: float = Field(gt=0, lt=np.pi)
    frames: list[TransformsFrame] = Field(min_length=1)


def read_transforms(path: Path) -> Transforms:
    """Read and check the file. Raises SplashbenchError that names it."""
    if not path.is_file():
        raise SplashbenchError(f"{path} is missing; restore it, or remove the view's folder")
    return read_model(path, Transforms)


def shared_frames(views: Mapping[str, Transforms]) -> tuple[list[int], dict[str, list[TransformsFrame]]]:
    """Numbers of the frames that all views have, in order, and each view's frames of these numbers.

    A frame's number is the one at the end of its particles' file name, which counts the simulation's states; else,
    where a name has none or two have the same, that of its image; else its place in the list.
    """
    numbered = _numbered(views)
    shared = sorted(set.intersection(*(set(frames) for frames in numbered.values())))
    return shared, {name: [frames[number] for number in shared] for name, frames in numbered.items()}


def _numbered(views: Mapping[str, Transforms]) -> dict[str, dict[int, TransformsFrame]]:
    names: tuple[Callable[[TransformsFrame], str | None], ...] = (lambda f: f.particle_path, lambda f: f.file_path)
    for name_of in names:
        numbered = {view: _by_number(transforms.frames, name_of) for view, transforms in views.items()}
        complete = {view: frames for view, frames in numbered.items() if frames is not None}
        if len(complete) == len(views):
            return complete
    return {view: dict(enumerate(transforms.frames)) for view, transforms in views.items()}


def _by_number(
    frames: Sequence[TransformsFrame], name_of: Callable[[TransformsFrame], str | None]
) -> dict[int, TransformsFrame] | None:
    """The frames by the number at the end of their name; None where one has none or two have the same."""
    matches = [_NUMBER.search(name_of(frame) or "") for frame in frames]
    numbered = {int(match[1]): frame for match, frame in zip(matches, frames) if match}
    return numbered if len(numbered) == len(frames) else None


def intrinsics(path: Path, camera_angle_x: float, size: tuple[int, int]) -> NDArray[np.float64]:
    """K [3, 3] in pixels for images of `size` (width, height); pixels are square and their centres lie at +0.5."""
    width, height = size
    focal = 0.5 * width / np.tan(0.5 * camera_angle_x)
    if not 0 < focal <= LARGEST:
        raise SplashbenchError(f"{path}: camera_angle_x {camera_angle_x:g} is no angle of view; fix the entry")
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def world_to_camera(path: Path, frames: Sequence[TransformsFrame]) -> NDArray[np.float64]:
    """w2c [4, 4] in OpenCV's convention of the camera of `frames`, which must stand still.

    A camera object that is scaled in Blender leaves its scale in the matrix; directions are the same without it.
    """
    matrices = [[frame.transform_matrix] for frame in frames]
    (pose,) = static_matrices(path, "transform_matrix", matrices, (len(frames), 1, 4, 4))
    scale = np.cbrt(np.linalg.det(pose[:3, :3]))
    if not scale > 1 / LARGEST:
        raise SplashbenchError(f"{path}: transform_matrix does not hold a rotation; restore the file")
    rotation = (pose[:3, :3] / scale @ _TO_OPENCV).T
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = rotation, -rotation @ pose[:3, 3]
    return w2c

"""Key frames of a camera path, and the smooth path through them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from splashbench.errors import SplashbenchError
from splashbench.viewer.geometry import View

#: Frames a second of the path.
FPS = 30.0
#: Key frames of a path, at the most.
MOST_KEYFRAMES = 200


@dataclass(frozen=True)
class Keyframe:
    """A view, and the time of the recording that is seen from it, seconds."""

    view: View
    time: float


def path_through(keyframes: list[Keyframe], seconds: float, fps: float = FPS) -> list[Keyframe]:
    """A frame for each 1 / `fps` of a second, from the first key frame to the last with `seconds` between two.

    Places, fields of view and times never overshoot a key frame (monotone cubics); views turn at a steady rate.
    Raises SplashbenchError for fewer than two key frames.
    """
    if len(keyframes) < 2:
        raise SplashbenchError("a camera path needs two key frames or more; add another")
    knots = np.arange(len(keyframes)) * seconds
    at = np.linspace(0, knots[-1], max(2, round(knots[-1] * fps) + 1))
    views = [keyframe.view for keyframe in keyframes]
    reaches = [float(np.linalg.norm(view.look_at - view.position)) for view in views]
    columns = [
        [*view.position, view.fov, reach, keyframe.time] for view, reach, keyframe in zip(views, reaches, keyframes)
    ]
    values: NDArray[np.float64] = PchipInterpolator(knots, np.array(columns))(at)
    rotations = Slerp(knots, Rotation.from_matrix([view.rotation() for view in views]))(at).as_matrix()
    return [
        Keyframe(View(row[:3], row[:3] + turned[:, 2] * row[4], -turned[:, 1], float(row[3])), float(row[5]))
        for row, turned in zip(values, rotations)
    ]

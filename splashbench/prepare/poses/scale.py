"""What gives a scene its metres, its up and its origin, where several things could.

Up and origin: the marker, where session.toml has one; else the board, which then must lie flat; else a container
that was placed in the reconstruction and stands upright. A marker comes before the board because it is described only
where the board does not lie flat in the static scene.

Metres: the board that placed the cameras, where it did; else the board in the static scene, the marker, the measured
distance between two cameras, the container. The order is by how exactly each is known: a print to a tenth of a
millimetre, with many corners before one with four; a distance between the centres of two lenses to millimetres; a
container by the outlines of its masks. All are recorded, since two that disagree show that one of them is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Literal

import numpy as np

from splashbench.alignment import Similarity
from splashbench.errors import SplashbenchError
from splashbench.prepare.calibration.lens import Array
from splashbench.prepare.poses.metric import MetricFrame
from splashbench.prepare.poses.structure_from_motion import Poses

Source = Literal["extrinsics", "board", "marker", "distance", "container"]


@dataclass(frozen=True, eq=False)
class Upright:
    """Which way is up and where the scene begins, in the frame of structure from motion.

    `up`: [3], of any length; `origin`: [3]. `metres_per_unit`: of structure from motion, where the size of what stands
    upright is known.
    """

    up: Array
    origin: Array
    metres_per_unit: float | None = None


@dataclass(frozen=True)
class SceneFrame:
    """The scene frame and where it comes from: metres, +y up, right-handed.

    `scales`: source -> metres per unit of structure from motion, of every source there is, `scale_source`'s among them.
    `scale_sigma`: standard deviation of a print's scale as a share of it, as far as its corners tell.
    """

    scene_from_sfm: Similarity
    scale_source: Source
    up_source: Source
    scales: dict[str, float]
    scale_sigma: dict[str, float] = field(default_factory=dict)
    board: MetricFrame | None = None
    marker: MetricFrame | None = None

    @property
    def prints(self) -> dict[str, MetricFrame]:
        """What the prints in the scene gave, by name: the board, the marker."""
        frames = {"board": self.board, "marker": self.marker}
        return {name: frame for name, frame in frames.items() if frame is not None}

    @property
    def scale_disagreement(self) -> float | None:
        """The largest difference between two sources of scale as a share of it; None with fewer than two."""
        pairs = combinations(self.scales.values(), 2)
        return max((abs(a / b - 1) for a, b in pairs), default=None)


def scene_frame(upright: Upright, metres_per_unit: float) -> Similarity:
    """The scene frame with +y along `up` and its origin at `origin`, both in structure from motion's frame.

    Raises ValueError where `up` has no length.
    """
    length = float(np.linalg.norm(upright.up))
    if not np.isfinite(length) or length <= 0:
        raise ValueError("up has no direction")
    y = np.asarray(upright.up, np.float64) / length
    along = np.eye(3)[np.argmin(np.abs(y))]  # the axis of structure from motion that is nearest to level
    x = along - (along @ y) * y
    x /= np.linalg.norm(x)
    rotation = np.stack([x, y, np.cross(x, y)])
    return Similarity(metres_per_unit, rotation, -metres_per_unit * rotation @ np.asarray(upright.origin, np.float64))


def distance_scale(poses: Poses, cameras: tuple[str, str], metres: float) -> float:
    """Metres per unit, from the measured distance between the lens centres of two posed cameras."""
    first, second = (-poses.w2c[camera][:3, :3].T @ poses.w2c[camera][:3, 3] for camera in cameras)
    apart = float(np.linalg.norm(first - second))
    if apart <= 0:
        raise SplashbenchError(
            f"session.toml: cameras {cameras[0]} and {cameras[1]} of [distance] come out in one place; give two that"
            " stand apart"
        )
    return metres / apart


def choose_frame(
    board: MetricFrame | None,
    marker: MetricFrame | None,
    distance: float | None,
    container: Upright | None = None,
    own_scale: float | None = None,
) -> SceneFrame:
    """The scene frame by the precedence above; `distance`: metres per unit by `distance_scale`; `own_scale`: that of
    poses that have one.

    Raises SplashbenchError, in one line with its remedy, where nothing gives up, or nothing gives metres.
    """
    prints: dict[Source, MetricFrame] = {}
    if board is not None:
        prints["board"] = board
    if marker is not None:
        prints["marker"] = marker
    scales: dict[Source, float] = {} if own_scale is None else {"extrinsics": own_scale}
    scales |= {source: frame.scene_from_sfm.scale for source, frame in prints.items()}
    if distance is not None:
        scales["distance"] = distance
    if container is not None and container.metres_per_unit is not None:
        scales["container"] = container.metres_per_unit
    up_source: Source = "marker" if marker is not None else "board" if board is not None else "container"
    if up_source == "container" and container is None:
        raise SplashbenchError(
            "session.toml: nothing gives the scene its up; lay the board flat where several cameras see it, or lay an"
            " ArUco marker there and describe it under [marker]"
        )
    if not scales:
        raise SplashbenchError(
            "session.toml: nothing gives the scene its metres; lay the board or a [marker] where several cameras see"
            " it, or measure between two lenses and write it under [distance]"
        )
    scale_source = next(iter(scales))
    if up_source == "container":
        assert container is not None
        frame = scene_frame(container, scales[scale_source])
    else:
        frame = rescaled(prints[up_source].scene_from_sfm, scales[scale_source])
    return SceneFrame(
        scene_from_sfm=frame,
        scale_source=scale_source,
        up_source=up_source,
        scales={str(source): scale for source, scale in scales.items()},
        scale_sigma={str(source): print_frame.scale_sigma for source, print_frame in prints.items()},
        board=board,
        marker=marker,
    )


def rescaled(similarity: Similarity, metres_per_unit: float) -> Similarity:
    """The same axes and origin with another scale."""
    factor = metres_per_unit / similarity.scale
    return replace(similarity, scale=metres_per_unit, translation=factor * similarity.translation)

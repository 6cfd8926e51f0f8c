"""Cameras that no rig has: each entry of the calibration is a number, and what they say together is absurd.

`splashbench scene check` lists these. A scene that has one still opens: a person may want to look at it.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from splashbench.scene.camera import Camera
from splashbench.scene.scene import Scene

#: Metric scale, and how far cameras stand from what they look at, metres: from a droplet's world to a lake's.
METRES_PER_UNIT, CAMERA_METRES = (1e-6, 1e3), (1e-3, 1e3)
#: Angle of view of an image's width or height, and of its middle to the optical axis (a crop moves it), degrees.
VIEW_DEGREES, MOST_OFF_AXIS_DEGREES = (0.05, 175.0), 80.0
_MOST_ASPECT = 5.0  # of focal lengths: pixels are about square
_ROUNDING = 1e-6
# Lines of sight at a smaller angle do not tell where they meet.
_LEAST_ANGLE_DEGREES = 2.0
# Pairs grow by the square; so many cameras tell where a scene is.
_MOST_CAMERAS = 100


def calibration_faults(scene: Scene) -> list[str]:
    """A line for every camera of `scene` that is absurd, equals another or looks away, and for an absurd scale."""
    cameras = list(scene.cameras.values())
    faults = [f"{scene.directory}: camera {camera.name}: {fault}" for camera in cameras if (fault := _absurd(camera))]
    if faults:
        return faults  # what they look at means nothing then
    faults = [
        f"{scene.directory}: cameras {first} and {second} are one: K and w2c are equal; restore the calibration"
        for first, second in _equal_pairs(cameras)
    ]
    middle = _middle(cameras[:_MOST_CAMERAS])
    away = [] if middle is None else [camera.name for camera in cameras if not _shows(camera, middle)]
    # Where most do not show it, it is not what they look at: cameras side by side meet nowhere.
    if len(away) < len(cameras) / 2:
        faults += [
            f"{scene.directory}: camera {name} looks away from where the others look; check its w2c and its K"
            for name in away
        ]
    return faults + _scale_faults(scene, middle)


def _absurd(camera: Camera) -> str:
    """What is wrong with one camera; empty where nothing is."""
    fx, fy = camera.K[0, 0], camera.K[1, 1]
    if abs(camera.K[0, 1]) > _ROUNDING * fx:
        return "K has skew, which no lens has and no renderer here draws; undistort its images to a plain pinhole"
    for side, focal in ((camera.width, fx), (camera.height, fy)):
        angle = 2 * np.degrees(np.arctan(side / (2 * focal)))
        if not VIEW_DEGREES[0] <= angle <= VIEW_DEGREES[1]:
            return f"its angle of view is {angle:.3g} degrees, not {VIEW_DEGREES[0]:g} to {VIEW_DEGREES[1]:g}"
    if not 1 / _MOST_ASPECT <= fx / fy <= _MOST_ASPECT:
        return f"its focal lengths are {fx:.4g} and {fy:.4g} pixels, which no lens has"
    x, y, _ = _line_of_sight(camera) @ camera.w2c[:3, :3].T
    if np.degrees(np.arcsin(min(1.0, np.hypot(x, y)))) > MOST_OFF_AXIS_DEGREES:
        return "its principal point lies far outside the image"
    return ""


def _equal_pairs(cameras: list[Camera]) -> list[tuple[str, str]]:
    """Names of every camera with the first one that maps all points to the same pixels."""
    pairs: list[tuple[str, str]] = []
    seen: dict[bytes, str] = {}
    for camera in cameras:
        projection = camera.projection / np.abs(camera.projection).max()
        key = np.round(projection / _ROUNDING).astype(np.int64).tobytes()
        if key in seen:
            pairs.append((seen[key], camera.name))
        seen.setdefault(key, camera.name)
    return pairs


def _line_of_sight(camera: Camera) -> NDArray[np.float64]:
    """Unit vector [3], world, from the camera through the middle of its image, which a crop moves off the axis."""
    x = (camera.width / 2 - camera.K[0, 2]) / camera.K[0, 0]
    y = (camera.height / 2 - camera.K[1, 2]) / camera.K[1, 1]
    direction = np.array([x, y, 1.0]) @ camera.w2c[:3, :3]
    return direction / np.linalg.norm(direction)


def _middle(cameras: list[Camera]) -> NDArray[np.float64] | None:
    """Where the cameras look, [3] scene units: the median of where two lines of sight are nearest to each other.

    None where no two of them meet at an angle that tells.
    """
    places = []
    for first, second in combinations(cameras, 2):
        a, b = _line_of_sight(first), _line_of_sight(second)
        normal = np.cross(a, b)
        squared = float(normal @ normal)
        if squared < np.sin(np.radians(_LEAST_ANGLE_DEGREES)) ** 2:
            continue
        between = second.center - first.center
        along_a = np.linalg.det(np.stack([between, b, normal])) / squared
        along_b = np.linalg.det(np.stack([between, a, normal])) / squared
        places.append((first.center + along_a * a + second.center + along_b * b) / 2)
    return np.median(places, axis=0) if places else None


def _shows(camera: Camera, point: NDArray[np.float64]) -> bool:
    """Whether `point` lies before the camera, in its image or within another image's width of it."""
    (pixel,), (depth,) = camera.project(point[None])
    size = np.array([camera.width, camera.height])
    return bool(depth > 0 and (np.abs(pixel - size / 2) <= 1.5 * size).all())


def _scale_faults(scene: Scene, middle: NDArray[np.float64] | None) -> list[str]:
    scale = scene.metres_per_unit
    if scale is None:
        return []
    place = f"{scene.directory / 'scene.json'}: metres_per_unit is {scale:g}"
    if not METRES_PER_UNIT[0] <= scale <= METRES_PER_UNIT[1]:
        return [f"{place}, not {METRES_PER_UNIT[0]:g} to {METRES_PER_UNIT[1]:g}; state the scene's true scale"]
    if middle is None:
        return []
    metres = scale * float(np.median([np.linalg.norm(camera.center - middle) for camera in scene.cameras.values()]))
    if CAMERA_METRES[0] <= metres <= CAMERA_METRES[1]:
        return []
    return [f"{place}, by which the cameras stand {metres:.3g} m from what they look at; state the scene's true scale"]

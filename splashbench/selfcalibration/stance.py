"""Cameras that were knocked during a recording: when, and how they are turned from then on.

Plates of the first and of the last frames are compared, and where they differ, every frame with the first ones. A
turn about the camera's centre moves all of a picture by one homography, whatever is in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from splashbench.background.clean_plate import CleanPlate
from splashbench.background.median import masked_median
from splashbench.parallel import each
from splashbench.scene import Camera
from splashbench.scene.scene import TrainingScene

from .features import Features, features_of, matched

# Frames of a plate, at either end, and pixels beside liquid that it leaves out.
_FRAMES, _MARGIN = 3, 2
# A camera stands still where a typical point moves by less, in pixels of an image of 240; points that have to be there,
# and how far they may be from one turn, typically.
_STILL, _LEAST_POINTS, _AGREE = 0.3, 30, 0.5


@dataclass(frozen=True)
class Knock:
    """From the timestep `frame` on the camera looks elsewhere: a point it saw at pixel x before, it sees at
    K @ rotation @ inv(K) @ x. rotation: [3, 3]."""

    frame: int
    rotation: NDArray[np.float64]

    @property
    def degrees(self) -> float:
        return float(np.degrees(Rotation.from_matrix(self.rotation).magnitude()))


def find_knock(scene: TrainingScene, name: str) -> Knock | None:
    """When camera `name` was knocked, None where it was not, or where too little is seen to tell."""
    camera, last = scene.cameras[name], scene.n_frames
    if last < 2 * _FRAMES:
        return None
    scale = max(camera.width, camera.height) / 240
    start = features_of(_plate(scene, name, range(_FRAMES)))
    end = features_of(_plate(scene, name, range(last - _FRAMES, last)))
    turn = _turn(start, end, camera, scale)
    if turn is None or _moved(turn, camera) < _STILL * scale:
        return None
    # Each frame by itself, nearer to the one or to the other.
    after = []
    for t in range(last):
        there = _turn(start, features_of(_plate(scene, name, [t])), camera, scale)
        after.append(np.nan if there is None else _moved(there, camera))
    known = np.flatnonzero(np.isfinite(after))
    moved = np.array(after)[known]
    jumps = [np.abs(moved[:k] - np.median(moved[:k])).sum() + np.abs(moved[k:] - np.median(moved[k:])).sum()
             for k in range(1, len(moved))]  # fmt: skip
    if not jumps:
        return None
    return Knock(int(known[int(np.argmin(jumps)) + 1]), turn)


def _plate(scene: TrainingScene, name: str, frames: range | list[int]) -> CleanPlate:
    disc = np.ones((2 * _MARGIN + 1, 2 * _MARGIN + 1), np.uint8)
    dry = np.stack([cv2.dilate(scene.mask(name, t).astype(np.uint8), disc) == 0 for t in frames])
    images = np.stack(each(lambda t: scene.image(name, t), frames))
    return CleanPlate(scene.cameras[name], masked_median(images, dry), np.asarray(dry.any(axis=0)))


def _turn(first: Features, second: Features, camera: Camera, scale: float) -> NDArray[np.float64] | None:
    """The turn of the camera between two plates of it, [3, 3]."""
    pairs = matched(first, second)
    if len(pairs) < _LEAST_POINTS:
        return None
    rays = [
        np.concatenate([found.pixels[pairs[:, side]], np.ones((len(pairs), 1))], axis=1) @ np.linalg.inv(camera.K).T
        for side, found in enumerate((first, second))
    ]
    before, after = (ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays)
    rotation, kept = np.eye(3), np.ones(len(pairs), dtype=bool)
    for _ in range(5):
        rotation = Rotation.align_vectors(after[kept], before[kept])[0].as_matrix()
        errors = np.linalg.norm(after - before @ rotation.T, axis=1) * camera.K[0, 0]
        kept = errors <= max(3 * float(np.median(errors)), 0.05 * scale)
        if kept.sum() < _LEAST_POINTS:
            return None
    return rotation if float(np.median(errors)) < _AGREE * scale else None


def _moved(rotation: NDArray[np.float64], camera: Camera) -> float:
    """By how many pixels the middle of the image moves, or its edges."""
    places = np.array([[x, y, 1.0] for x in (0, camera.width / 2, camera.width) for y in (0, camera.height)])
    seen = places @ (camera.K @ rotation @ np.linalg.inv(camera.K)).T
    return float(np.median(np.linalg.norm(seen[:, :2] / seen[:, 2:] - places[:, :2], axis=1)))

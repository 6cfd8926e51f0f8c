"""What training views show in common: points of the still surroundings, found and matched by SIFT on clean plates.

SIFT is OpenCV's. Matches are mutual, distinct (Lowe's ratio test), and near the epipolar lines of the cameras as told;
those that a few wrong cameras would allow are left to whoever fits them to sort out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.background.clean_plate import CleanPlate
from splashbench.scene import Camera

# Features of smaller plates are looked for in enlarged ones, and of larger ones in reduced ones (pixels, longest side).
_ENLARGED_BELOW, _LONGEST_SIDE = 500, 1000
_FEATURES, _CONTRAST = 2000, 0.01
# Of the angle between descriptors: the best match against the second best.
_RATIO = 0.8
#: How far from its epipolar line a match may be, as a share of the image's longest side: what cameras may be off by.
_EPIPOLAR_SHARE = 0.06


@dataclass(frozen=True)
class Features:
    """Of one plate. pixels: float64 [N, 2], in the camera's own. descriptors: float32 [N, 128], of unit length."""

    pixels: NDArray[np.float64]
    descriptors: NDArray[np.float32]


@dataclass(frozen=True)
class Tracks:
    """Points that two or more views show. pixels: float64 [N, V, 2], NaN where a view shows none of a point."""

    views: tuple[str, ...]
    pixels: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """bool [N, V]."""
        return np.isfinite(self.pixels[..., 0])

    def kept(self, which: NDArray[np.intp]) -> Tracks:
        """Those in the rows `which`."""
        return Tracks(self.views, self.pixels[which])


def features_of(plate: CleanPlate, margin: int = 2) -> Features:
    """The features of `plate`, none within `margin` pixels of what it does not show."""
    longest = max(plate.image.shape[:2])
    factor = 2.0 if longest < _ENLARGED_BELOW else min(1.0, _LONGEST_SIDE / longest)
    image = plate.image
    if factor != 1.0:
        smooth = cv2.INTER_CUBIC if factor > 1 else cv2.INTER_AREA
        image = np.asarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=smooth))
    shown = cv2.erode(plate.seen.astype(np.uint8), np.ones((2 * margin + 1, 2 * margin + 1), np.uint8))
    shown = cv2.resize(shown, image.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    points, found = _sift().detectAndCompute(image, shown)
    if found is None or not len(points):
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    # OpenCV counts from the middle of the first pixel.
    ratio = np.array(image.shape[1::-1]) / np.array(plate.image.shape[1::-1])
    pixels = (np.array([point.pt for point in points]) + 0.5) / ratio
    lengths = np.linalg.norm(found, axis=1, keepdims=True)
    return Features(pixels, (found / np.maximum(lengths, 1e-9)).astype(np.float32))


def _sift() -> Any:
    # Untyped in OpenCV's own stubs. Without the last, points are a quarter of a pixel to the right and below.
    create = getattr(cv2, "SIFT_create")  # noqa: B009
    return create(_FEATURES, contrastThreshold=_CONTRAST, enable_precise_upscale=True)


def matched(first: Features, second: Features) -> NDArray[np.intp]:
    """Rows of both [M, 2]: mutual nearest neighbours that are distinct in both directions."""
    if len(first.pixels) < 2 or len(second.pixels) < 2:
        return np.zeros((0, 2), dtype=np.intp)
    likeness = first.descriptors @ second.descriptors.T
    forward, there = _distinct(likeness)
    backward, back = _distinct(likeness.T)
    rows = np.flatnonzero(forward)
    rows = rows[backward[there[rows]] & (back[there[rows]] == rows)]
    return np.stack([rows, there[rows]], axis=1)


def _distinct(likeness: NDArray[np.float32]) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """Of each row, whether its best column is distinct, and that column."""
    rows, best = np.arange(len(likeness)), likeness.argmax(axis=1)
    nearest = likeness[rows, best]
    # A partition would copy what is large, and take twice the time or more.
    likeness[rows, best] = -np.inf
    second = likeness.max(axis=1)
    likeness[rows, best] = nearest
    angle = np.arccos(np.clip(nearest, -1, 1))
    return angle < _RATIO * np.arccos(np.clip(second, -1, 1)), best


def find_tracks(plates: Mapping[str, CleanPlate], cameras: Mapping[str, Camera]) -> Tracks:
    """What the views of `plates` show in common, by `cameras` as they are told."""
    views = tuple(plates)
    features = {name: features_of(plate) for name, plate in plates.items()}
    starts = np.cumsum([0, *(len(features[name].pixels) for name in views)])
    links: list[NDArray[np.intp]] = []
    for a, b in combinations(range(len(views)), 2):
        pairs = matched(features[views[a]], features[views[b]])
        first, second = features[views[a]].pixels[pairs[:, 0]], features[views[b]].pixels[pairs[:, 1]]
        camera = cameras[views[b]]
        reach = _EPIPOLAR_SHARE * max(camera.width, camera.height)
        near = np.abs(epipolar_distance(cameras[views[a]], camera, first, second)) < reach
        links.append(pairs[near] + [starts[a], starts[b]])
    owner = np.repeat(np.arange(len(views)), np.diff(starts))
    pixels = np.concatenate([features[name].pixels for name in views])
    found = np.concatenate(links) if links else np.zeros((0, 2), np.intp)
    return Tracks(views, _joined(found, owner, pixels, len(views)))


def epipolar_distance(
    first: Camera, second: Camera, pixels: NDArray[np.float64], others: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Signed distance in pixels of `others` [N, 2] of `second` from the epipolar lines of `pixels` of `first`."""
    relative = second.w2c @ np.linalg.inv(first.w2c)
    x, y, z = relative[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ relative[:3, :3]
    fundamental = np.linalg.inv(second.K).T @ essential @ np.linalg.inv(first.K)
    lines = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ fundamental.T
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    return np.asarray((lines[:, :2] * others).sum(axis=1) + lines[:, 2])


def _joined(
    links: NDArray[np.intp], owner: NDArray[np.intp], pixels: NDArray[np.float64], n_views: int
) -> NDArray[np.float64]:
    """Links between features as tracks [N, V, 2]; those that would show one view two points are left out."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(owner)
    if not len(links):
        return np.zeros((0, n_views, 2))
    graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    linked = np.unique(links)
    names, track = np.unique(label[linked], return_inverse=True)
    tally = np.zeros((len(names), n_views), dtype=int)
    np.add.at(tally, (track, owner[linked]), 1)
    found = np.full((len(names), n_views, 2), np.nan)
    found[track, owner[linked]] = pixels[linked]
    return found[(tally <= 1).all(axis=1)]

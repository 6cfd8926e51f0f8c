"""Dense inverse depth of every clean plate by plane sweep: at the right depth, other views show a pixel's colour.

For planes of constant depth the other plates are warped into a view by homographies. Each plane costs the colour
difference to the two views that agree best, so that a view to which the pixel is hidden does no harm. The costs are
smoothed along the image's own edges (cost-volume filtering, Hosni et al. 2011), and the cheapest plane wins.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.background.clean_plate import CleanPlate
from splashbench.scene import Camera

PLANES = 96
# Differences above this share of full scale are all alike: the pixel is hidden, or glistens.
_TRUNCATION = 0.12
# A place that no other view shows: worse than agreement, better than disagreement. One that a single view confirms
# is worse than one that two confirm, but hardly.
_UNSEEN = 0.06
_ALONE = 0.01
_RADIUS = 5
_EDGE_VARIANCE = 1e-4
# How much leaving the whole sweep's range costs against what the sparse points say, in colour difference.
_PRIOR = 0.03
# Sparse points are triangulated to a fraction of a pixel: where their depth costs this little more, it is theirs.
_INDISTINCT = 0.003

Map = NDArray[np.float32]
_MEAN_COLOR = np.array([[1, 1, 1, 0]], np.float32) / 3


def inverse_depth(
    reference: int, plates: list[CleanPlate], low: float, high: float, prior: Map | None
) -> tuple[Map, Map]:
    """Inverse depth [H, W] of plate number `reference`, looked for between `low` and `high`; and how much the colours
    of the two views that agree best differ there, [H, W], in the mean of the pixels around, as a share of full scale.

    prior: [H, W] inverse depths that break ties where the images say little, or None.
    """
    plate = plates[reference]
    others = [other for i, other in enumerate(plates) if i != reference]
    planes = np.linspace(low, high, PLANES, dtype=np.float32)
    image, *sources = (np.dstack([p.floats(), p.seen.astype(np.float32)]) for p in (plate, *others))
    volume = np.empty((PLANES, *plate.seen.shape), np.float32)
    guide = cv2.ximgproc.createGuidedFilter(plate.floats(), _RADIUS, _EDGE_VARIANCE)
    for k, plane in enumerate(planes):
        best = np.full(plate.seen.shape, _UNSEEN, np.float32)
        second = best.copy()
        for other, source in zip(others, sources):
            cost = _difference(image, source, for_opencv(plane_homography(plate.camera, other.camera, plane)))
            np.minimum(second, np.maximum(best, cost), out=second)
            np.minimum(best, cost, out=best)
        second = np.minimum(second, best + _ALONE)
        cost = 0.5 * (best + second) * plate.seen
        if prior is not None:
            cost += _PRIOR * np.abs(plane - prior) / (planes[-1] - planes[0])
        guide.filter(cost, volume[k])
    inverse, cost = _minimum(volume, planes)
    if prior is None:
        return inverse, cost
    return np.where(_costs_at(volume, planes, prior) < cost + _INDISTINCT, prior, inverse), cost


def _difference(image: Map, source: Map, homography: NDArray[np.float64]) -> Map:
    """Mean absolute colour difference [H, W] of two plates with `seen` as fourth channel, truncated."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(source, homography, image.shape[1::-1], flags=flags)
    difference = cv2.transform(cv2.absdiff(image, warped), _MEAN_COLOR)
    return np.where(warped[..., 3] > 0.99, np.minimum(difference, _TRUNCATION), np.float32(_UNSEEN))


def plane_homography(target: Camera, source: Camera, inverse: float) -> NDArray[np.float64]:
    """Pixels of `target` to pixels of `source`, [3, 3], over the plane at inverse depth `inverse` facing `target`."""
    relative = source.w2c @ np.linalg.inv(target.w2c)
    # x' ~ R x + t with z = 1 / inverse, that is (R + inverse t e_z^T) x up to scale.
    between = relative[:3, :3] + inverse * np.outer(relative[:3, 3], [0.0, 0.0, 1.0])
    return np.asarray(source.K @ between @ np.linalg.inv(target.K))


def for_opencv(homography: NDArray) -> NDArray[np.float64]:
    """The same map for OpenCV, whose pixel centres lie at whole numbers instead of +0.5."""
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    return np.asarray(np.linalg.inv(half) @ homography @ half)


def _minimum(volume: Map, planes: Map) -> tuple[Map, Map]:
    """Inverse depth of least cost, to a fraction of a plane by the parabola through its neighbours, and that cost."""
    best = np.clip(volume.argmin(axis=0), 1, len(planes) - 2)
    before, at, after = (np.take_along_axis(volume, (best + step)[None], axis=0)[0] for step in (-1, 0, 1))
    curvature = before - 2 * at + after
    shift = np.where(curvature > 1e-9, 0.5 * (before - after) / np.maximum(curvature, 1e-9), 0)
    inverse: Map = planes[best] + np.clip(shift, -1, 1).astype(np.float32) * (planes[1] - planes[0])
    return inverse, at


def _costs_at(volume: Map, planes: Map, inverse: Map) -> Map:
    """Costs [H, W] at any inverse depths [H, W] within the sweep's range, between planes linearly."""
    position = np.clip((inverse - planes[0]) / (planes[1] - planes[0]), 0, len(planes) - 1)
    below = np.minimum(position.astype(np.int64), len(planes) - 2)
    low, high = (np.take_along_axis(volume, (below + step)[None], axis=0)[0] for step in (0, 1))
    costs: Map = low + (position - below).astype(np.float32) * (high - low)
    return costs

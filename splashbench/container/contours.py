"""Outlines of silhouettes, to a fraction of a pixel.

A silhouette is blurred a little, and its outline taken at one half (marching squares). So a jagged edge becomes the
line about which it jumps. Rendered and segmented silhouettes are treated alike, hence the blur favours neither. Where
the image's border cuts a silhouette there is no outline: the border is not the object's edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.arrays import Floats

# Pixels: standard deviation of the blur, and the strip along the image's border without an outline.
_BLUR = 1.0
_BORDER = 2.0
# Of one outline; of more, evenly spaced ones are taken.
_MAX_POINTS = 3000


@dataclass(frozen=True, eq=False)
class Contour:
    """`points` [N, 2] in pixels (u, v; pixel centres at +0.5) with unit `normals` [N, 2] that point outwards."""

    points: Floats
    normals: Floats

    @cached_property
    def tree(self) -> Any:
        """Search tree over the points."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    def distances_to(self, other: Contour) -> Floats:
        """Distance [N] of each point to the other outline, pixels; inf where the other is empty."""
        if not len(other.points):
            return np.full(len(self.points), np.inf)
        if not len(self.points):
            return np.zeros(0)
        _, nearest = other.tree.query(self.points, k=min(2, len(other.points)))
        nearest = nearest.reshape(len(self.points), -1)
        first, second = other.points[nearest[:, 0]], other.points[nearest[:, -1]]
        # To the line through the two nearest points, not to the points, between which the outline runs on.
        along = second - first
        length = np.maximum(np.einsum("ij,ij->i", along, along), 1e-12)
        gap = self.points - first
        share = np.clip(np.einsum("ij,ij->i", gap, along) / length, 0.0, 1.0)
        return np.linalg.norm(gap - share[:, None] * along, axis=1)


def find_contour(silhouette: NDArray) -> Contour:
    """The outline of a silhouette [H, W]: bool, or float from 0 to 1 where pixels are partly covered."""
    import cv2
    from skimage.measure import find_contours

    height, width = silhouette.shape
    blurred = cv2.GaussianBlur(silhouette.astype(np.float32), (0, 0), _BLUR, borderType=cv2.BORDER_REPLICATE)
    if min(height, width) < 2 or blurred.min() >= 0.5 or blurred.max() <= 0.5:
        return Contour(np.zeros((0, 2)), np.zeros((0, 2)))
    pieces = find_contours(blurred, 0.5)
    points = np.concatenate(pieces)[:, ::-1] + 0.5 if pieces else np.zeros((0, 2))
    inside = (points >= _BORDER).all(axis=1) & (points <= np.array([width, height]) - _BORDER).all(axis=1)
    points = points[inside]
    if not len(points):  # it runs along the border alone
        return Contour(np.zeros((0, 2)), np.zeros((0, 2)))
    points = points[:: max(1, -(-len(points) // _MAX_POINTS))]
    # Sobel's gradient points into the silhouette.
    column, row = (points - 0.5).astype(np.float32).T
    gradient = np.stack(
        [
            cv2.remap(cv2.Sobel(blurred, cv2.CV_32F, *order), column[:, None], row[:, None], cv2.INTER_LINEAR).reshape(
                -1
            )
            for order in ((1, 0), (0, 1))
        ],
        axis=1,
    ).astype(np.float64)
    length = np.linalg.norm(gradient, axis=1)
    sharp = length > 1e-6
    return Contour(points[sharp], -gradient[sharp] / length[sharp, None])


def intersection_over_union(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Overlap of two masks [H, W]; 1 where both are empty."""
    union = int((a | b).sum())
    return int((a & b).sum()) / union if union else 1.0

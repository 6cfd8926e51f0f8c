"""Carving on photographs: the dinosaur of Middlebury's multi-view stereo data, whose bounding box is published.

Silhouettes by the data's own recipe: brighter than 0.19, dilated by 10 pixels, eroded by 7, on the images that it
lists as good. The lower y face is not in reach of any hull of these views: the cameras stand in a ring around the
y axis, above, and all look down, so that the cone below the feet is hidden from all of them.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from splashbench.observe import SignedDistanceFields, signed_distance_fields
from splashbench.scene.camera import Camera

LOW = np.array([-0.061897, -0.018874, -0.057845])
HIGH = np.array([0.010897, 0.068227, 0.015495])
THRESHOLD, DILATED, ERODED = 0.19, 10, 7


class Dinosaur:
    """One frame of silhouettes, as `signed_distance_fields` wants them."""

    name = "dinoSparseRing"
    n_frames = 1

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        words = (folder / "dinoSR_good_silhouette_images.txt").read_text().split()
        self.train = tuple(word for word in words if word.endswith(".png"))
        rows = [line.split() for line in (folder / "dinoSR_par.txt").read_text().splitlines()[1:]]
        self.cameras = {row[0]: self._camera(row) for row in rows if row and row[0] in self.train}

    def _camera(self, row: list[str]) -> Camera:
        height, width = self._grey(row[0]).shape
        numbers = np.array(row[1:], np.float64)
        K, w2c = numbers[:9].reshape(3, 3), np.eye(4)
        K[:2, 2] += 0.5  # its pixel centres are whole numbers
        w2c[:3, :3], w2c[:3, 3] = numbers[9:18].reshape(3, 3), numbers[18:]
        return Camera(row[0], width, height, K, w2c)

    def _grey(self, camera: str) -> np.ndarray:
        return cv2.imread(str(self.folder / camera), cv2.IMREAD_GRAYSCALE)

    def mask(self, camera: str, t: int) -> np.ndarray:
        bright = (self._grey(camera) > THRESHOLD * 255).astype(np.uint8)
        margin = 2 * DILATED
        wide = cv2.copyMakeBorder(bright, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=0)
        closed = cv2.erode(cv2.dilate(wide, disk(DILATED)), disk(ERODED))
        return closed[margin:-margin, margin:-margin].astype(bool)


def disk(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def box(fields: SignedDistanceFields) -> tuple[np.ndarray, np.ndarray]:
    """Where the hull's surface (phi = 0) lies farthest out on each axis, between the nodes: low [3] and high [3]."""
    low, high = np.zeros(3), np.zeros(3)
    for axis in range(3):
        nearest = fields.phi[0].min(axis=tuple(other for other in range(3) if other != axis))
        first, last = np.nonzero(nearest < 0)[0][[0, -1]]
        low[axis] = first - nearest[first] / (nearest[first] - nearest[first - 1])
        high[axis] = last + nearest[last] / (nearest[last] - nearest[last + 1])
    return fields.origin + fields.voxel * low, fields.origin + fields.voxel * high


def test_the_hull_has_the_published_bounding_box(test_data: Path) -> None:
    folder = test_data / "real/hull/dinoSparseRing"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not at hand")
    dinosaur = Dinosaur(folder)
    assert len(dinosaur.train) == 15
    low, high = box(signed_distance_fields(dinosaur, cells_longest_axis=96))
    error = np.concatenate([low - LOW, high - HIGH])
    assert (np.abs(error) <= 1e-3).sum() >= 5, f"millimetres off, low x y z and high x y z: {error * 1e3}"
    # A hull holds its object, so the sixth face can only lie outside it.
    assert error[1] < 1e-3

"""Finding the ChArUco board in an image, and telling true detections from false ones.

The board serves twice: moved in front of each camera it gives the intrinsics (`intrinsics`), and lying flat on the
table it gives metres and the direction of gravity (`metric`). Written against OpenCV 5, where `CharucoDetector` alone
remains.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.prepare.arrays import Indices
from splashbench.prepare.lens import OPENCV_PIXEL_SHIFT, Array

MIN_CORNERS = 6  # a homography has eight unknowns: six corners leave enough residual to judge it
# Markers of a small image are a few pixels wide; below this width the image is doubled before detection.
SMALL_IMAGE_WIDTH = 1000
# A true board bends under the lens, a false one does not fit at all. In units of the board's size in the image.
MAX_HOMOGRAPHY_RESIDUAL = 0.03


class BoardLayout(Protocol):
    """What the session says about its board: the `[board]` table of session.toml."""

    squares_x: int
    squares_y: int
    square_metres: float
    marker_metres: float
    dictionary: str
    legacy: bool
    inverted: bool


@dataclass(frozen=True, eq=False)
class BoardView:
    """The board's corners seen in one image.

    `ids`: [N] corner numbers; `points`: [N, 2] metres on the board (x right, y down, from its top left); `pixels`:
    [N, 2], pixel centres at +0.5.
    """

    ids: Indices
    points: Array
    pixels: Array

    def homography_residual(self) -> float:
        """RMS distance of the corners to the best homography from the board, over the board's diagonal in the image.

        A homography through wrong corners fails by a large part of the board's size, lens distortion by a few percent.
        Infinite where no homography fits.
        """
        homography, _ = cv2.findHomography(self.points, self.pixels, 0)
        if homography is None:
            return float("inf")
        mapped = np.column_stack([self.points, np.ones(len(self.points))]) @ homography.T
        if np.any(np.abs(mapped[:, 2]) < 1e-12):
            return float("inf")
        error = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - self.pixels, axis=1)
        diagonal = float(np.linalg.norm(np.ptp(self.pixels, axis=0)))
        return float(np.sqrt(np.mean(error**2))) / max(diagonal, 1e-9)


class BoardDetector:
    """Finds one board's corners in images."""

    def __init__(self, layout: BoardLayout) -> None:
        dictionary = getattr(cv2.aruco, layout.dictionary, None)
        if not isinstance(dictionary, int) or not layout.dictionary.startswith("DICT_"):
            raise SplashbenchError(
                f"session.toml: unknown board dictionary {layout.dictionary!r}; use an OpenCV name such as DICT_4X4_50"
            )
        self.layout = layout
        self.board = cv2.aruco.CharucoBoard(
            (layout.squares_x, layout.squares_y),
            layout.square_metres,
            layout.marker_metres,
            cv2.aruco.getPredefinedDictionary(dictionary),
        )
        self.board.setLegacyPattern(layout.legacy)
        self._detector = cv2.aruco.CharucoDetector(self.board)
        self.corners = np.asarray(self.board.getChessboardCorners(), np.float64)[:, :2]

    def detect(self, image: NDArray[np.uint8]) -> BoardView | None:
        """The board in `image` ([H, W, 3] RGB or [H, W] grey), or None where fewer than six of its corners are
        found."""
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        if self.layout.inverted:
            grey = cv2.bitwise_not(grey)
        zoom = 2 if grey.shape[1] < SMALL_IMAGE_WIDTH else 1
        if zoom > 1:
            grey = cv2.resize(grey, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
        corners, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) < MIN_CORNERS:
            return None
        numbers = np.asarray(ids, np.int64).ravel()
        pixels = (np.asarray(corners, np.float64).reshape(-1, 2) + OPENCV_PIXEL_SHIFT) / zoom
        points = self.corners[numbers]
        if _collinear(points):
            return None
        return BoardView(numbers, points, pixels)

    def detect_true(self, image: NDArray[np.uint8]) -> BoardView | None:
        """As `detect`, without the detections whose corners do not lie on a plane seen in perspective."""
        view = self.detect(image)
        if view is None or view.homography_residual() > MAX_HOMOGRAPHY_RESIDUAL:
            return None
        return view


def _collinear(points: Array) -> bool:
    """Whether board points [N, 2] lie on one line, which determines no homography."""
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(spread[-1] < 1e-6 * max(spread[0], 1e-12))

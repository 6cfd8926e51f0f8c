"""Finding the calibration board in an image, and telling true detections from false ones.

The board serves twice: moved in front of each camera it gives the intrinsics (`intrinsics`), and lying flat on the
table it gives metres and the direction of gravity (`metric`). ChArUco boards are found here, written against OpenCV 5,
where `CharucoDetector` alone remains; plain checkerboards in `checkerboard`. `checkerboard.board_detector` picks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.arrays import Indices
from splashbench.errors import SplashbenchError
from splashbench.prepare.calibration.lens import OPENCV_PIXEL_SHIFT, Array

MIN_CORNERS = 6  # a homography has eight unknowns: six corners leave enough residual to judge it
# Markers of a small image are a few pixels wide; below this width the image is doubled before detection.
SMALL_IMAGE_WIDTH = 1000
# A true board bends under the lens, a false one does not fit at all: RMS residual over the board's size in the image,
# and over the image's longer side. The first judges small boards; a large one can hide a misread row in it.
MAX_HOMOGRAPHY_RESIDUAL = 0.03
MAX_HOMOGRAPHY_RESIDUAL_OF_IMAGE = 0.02


class BoardLayout(Protocol):
    """What the session says about its board: the `[board]` table of session.toml.

    `marker_metres` and `dictionary` are None for a checkerboard.
    """

    kind: Literal["charuco", "checkerboard"]
    squares_x: int
    squares_y: int
    square_metres: float
    marker_metres: float | None
    dictionary: str | None
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

    @property
    def diagonal(self) -> float:
        """Diagonal of the box around the corners, pixels."""
        return float(np.linalg.norm(np.ptp(self.pixels, axis=0)))

    def homography_residual_px(self) -> float:
        """RMS distance of the corners to the best homography from the board, pixels; infinite where none fits."""
        homography, _ = cv2.findHomography(self.points, self.pixels, 0)
        if homography is None:
            return float("inf")
        mapped = np.column_stack([self.points, np.ones(len(self.points))]) @ homography.T
        if np.any(np.abs(mapped[:, 2]) < 1e-12):
            return float("inf")
        error = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - self.pixels, axis=1)
        return float(np.sqrt(np.mean(error**2)))

    def homography_residual(self) -> float:
        """As `homography_residual_px`, over the board's diagonal in the image.

        A homography through wrong corners fails by a large part of the board's size, lens distortion by a few percent.
        """
        return self.homography_residual_px() / max(self.diagonal, 1e-9)

    def lies_on_a_plane(self, size: tuple[int, int]) -> bool:
        """Whether a plane in perspective explains the corners in an image of `size` (width, height), up to lens
        distortion."""
        residual = self.homography_residual_px()
        limits = (MAX_HOMOGRAPHY_RESIDUAL * self.diagonal, MAX_HOMOGRAPHY_RESIDUAL_OF_IMAGE * max(size))
        return residual <= min(limits)


class Detector(Protocol):
    """Finds the corners of one board in images. `corners`: [N, 2] metres on the board, by number."""

    layout: BoardLayout
    corners: Array

    def detect(self, image: NDArray[np.uint8]) -> BoardView | None:
        """What looks like the board in `image` ([H, W, 3] RGB or [H, W] grey); None where nothing does."""

    def detect_true(self, image: NDArray[np.uint8]) -> BoardView | None:
        """As `detect`, without the detections whose corners do not lie on a plane seen in perspective."""


class BoardDetector:
    """Finds a ChArUco board's corners in images."""

    def __init__(self, layout: BoardLayout) -> None:
        name = layout.dictionary or ""
        dictionary = getattr(cv2.aruco, name, None)
        if not isinstance(dictionary, int) or not name.startswith("DICT_") or layout.marker_metres is None:
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
        grey = to_grey(image, self.layout.inverted)
        zoom = 2 if grey.shape[1] < SMALL_IMAGE_WIDTH else 1
        if zoom > 1:
            grey = cv2.resize(grey, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
        corners, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) < MIN_CORNERS:
            return None
        numbers = np.asarray(ids, np.int64).ravel()
        pixels = (np.asarray(corners, np.float64).reshape(-1, 2) + OPENCV_PIXEL_SHIFT) / zoom
        points = self.corners[numbers]
        return None if collinear(points) else BoardView(numbers, points, pixels)

    def detect_true(self, image: NDArray[np.uint8]) -> BoardView | None:
        """As `detect`, without the detections whose corners do not lie on a plane seen in perspective."""
        view = self.detect(image)
        return view if view is not None and view.lies_on_a_plane(image_size(image)) else None


def to_grey(image: NDArray[np.uint8], inverted: bool) -> NDArray[np.uint8]:
    """Grey levels [H, W] of an image [H, W, 3] or [H, W], as those of a board with dark squares on white."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.bitwise_not(grey) if inverted else grey, np.uint8)


def image_size(image: NDArray[np.uint8]) -> tuple[int, int]:
    """(width, height) of an image array."""
    return image.shape[1], image.shape[0]


def collinear(points: Array) -> bool:
    """Whether board points [N, 2] lie on one line, which determines no homography."""
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(spread[-1] < 1e-6 * max(spread[0], 1e-12))

"""Finding one ArUco marker in an image: the small print that gives metres, gravity and the origin without a board.

The marker lies flat and face up in the static scene. It is seen as a board of four corners, so that `metric` aligns it
as it does the ChArUco board.
"""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.prepare.calibration.board import SMALL_IMAGE_WIDTH, BoardLayout, BoardView
from splashbench.prepare.calibration.lens import Array


class MarkerLayout(Protocol):
    """What the session says about its marker: the `[marker]` table of session.toml."""

    dictionary: str
    id: int
    metres: float


def marker_corners(metres: float) -> Array:
    """The corners of a marker with sides of `metres`: [4, 2], clockwise from its top left, x right, y down."""
    return metres * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def is_on_board(marker: MarkerLayout, board: BoardLayout) -> bool:
    """Whether the board carries a marker of the same pattern, in whatever dictionary either is named: the board's would
    be taken for the marker."""
    if board.dictionary is None:
        return False
    marker_dictionary, board_dictionary = (
        cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)) for name in (marker.dictionary, board.dictionary)
    )
    if marker_dictionary.markerSize != board_dictionary.markerSize:
        return False
    # bytesList: [markers, bytes, 4 turns of the marker].
    turns = board_dictionary.bytesList[: board.squares_x * board.squares_y // 2]
    return bool((turns == marker_dictionary.bytesList[marker.id][None, :, :1]).all(axis=1).any())


class MarkerDetector:
    """Finds one marker's corners in images. Raises SplashbenchError where there is no such marker."""

    def __init__(self, layout: MarkerLayout) -> None:
        dictionary = getattr(cv2.aruco, layout.dictionary, None)
        if not isinstance(dictionary, int) or not layout.dictionary.startswith("DICT_"):
            raise SplashbenchError(
                f"session.toml: unknown marker dictionary {layout.dictionary!r}; use an OpenCV name such as DICT_4X4_50"
            )
        predefined = cv2.aruco.getPredefinedDictionary(dictionary)
        count = len(predefined.bytesList)
        if not 0 <= layout.id < count:
            raise SplashbenchError(
                f"session.toml: {layout.dictionary} has no marker {layout.id}; its numbers are 0 to {count - 1}"
            )
        self.layout = layout
        self.corners = marker_corners(layout.metres)
        parameters = cv2.aruco.DetectorParameters()
        # Lines fitted to the marker's sides. The corners that OpenCV refines one by one lie up to 0.6 px inside, which
        # makes a marker 130 px wide 0.4% small.
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
        self._detector = cv2.aruco.ArucoDetector(predefined, parameters)

    def detect(self, image: NDArray[np.uint8]) -> BoardView | None:
        """The marker in `image` ([H, W, 3] RGB or [H, W] grey); None where it is not seen, or seen twice."""
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        zoom = 2 if grey.shape[1] < SMALL_IMAGE_WIDTH else 1
        if zoom > 1:
            grey = cv2.resize(grey, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
        corners, ids, _ = self._detector.detectMarkers(grey)
        if ids is None:
            return None
        sightings = np.nonzero(np.asarray(ids).ravel() == self.layout.id)[0]
        if len(sightings) != 1:
            return None
        # This refinement alone in OpenCV has pixel centres at +0.5, as here.
        pixels = np.asarray(corners[int(sightings[0])], np.float64).reshape(4, 2) / zoom
        return BoardView(np.arange(4), self.corners, pixels)

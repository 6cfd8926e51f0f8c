"""Which board was filmed: its kind, dictionary, squares and layout, found by trying; its size has to be measured.

A board of w x h squares carries floor(w h / 2) markers, numbered from 0, so the largest number seen leaves few sizes.
The right one is that whose corners OpenCV finds most of, on a plane in perspective. A board without markers may be a
plain checkerboard (`checkerboard_guess`). A board whose markers can be read only in a mirror was filmed or printed
mirrored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.prepare.calibration.board import BoardView
from splashbench.prepare.calibration.lens import OPENCV_PIXEL_SHIFT
from splashbench.prepare.init.checkerboard_guess import guess_squares
from splashbench.prepare.init.inspection import MarkerFinder, Markers

WIDTH = 1280  # enough to read markers by, and quick
_SMALLEST, _LARGEST = 3, 30  # squares along a side
_UNSEEN = 2  # markers beyond the highest number seen: over a whole clip, hardly more stay out of sight
_SIZES = (50, 100, 250, 1000)
_CLEAREST = 2  # frames by which layouts are compared
_FLAT = 0.02  # homography residual of a true board, in units of its size in the image
_MIN_CORNERS = 4


@dataclass(frozen=True)
class BoardGuess:
    """A board as session.toml describes it, but for its size. `marker_share`: a marker's side over a square's.

    `mirrored`: its markers are read only in a mirror. A checkerboard has neither `dictionary` nor `marker_share`, and
    what is mirrored or inverted about it cannot be seen.
    """

    squares_x: int
    squares_y: int
    dictionary: str | None
    legacy: bool
    inverted: bool
    marker_share: float | None
    kind: Literal["charuco", "checkerboard"] = "charuco"
    mirrored: bool = False


@dataclass(frozen=True)
class _Picture:
    """A frame in which the board is dark on light, and its markers."""

    image: NDArray[np.uint8]
    markers: Markers


def guess_board(images: Sequence[NDArray[np.uint8]]) -> BoardGuess | None:
    """The board seen in images [H, W] grey; None where none explains them."""
    shrunk = [_shrunk(image) for image in images]
    guess = _guess_charuco(shrunk)
    if guess is not None:
        return guess
    guess = _guess_charuco([np.ascontiguousarray(image[:, ::-1]) for image in shrunk])
    if guess is not None:
        return replace(guess, mirrored=True)
    squares = guess_squares(shrunk)
    return None if squares is None else BoardGuess(*squares, None, False, False, None, "checkerboard")


def _guess_charuco(shrunk: Sequence[NDArray[np.uint8]]) -> BoardGuess | None:
    """The ChArUco board; None where no marker pattern explains the images."""
    finder = MarkerFinder()
    if shrunk:
        finder.settle(shrunk)
    if finder.dictionary is None:
        return None
    seen = [
        _Picture(np.asarray(cv2.bitwise_not(image)) if finder.inverted else image, finder.find(image))
        for image in shrunk
    ]
    numbers = np.concatenate([picture.markers.ids for picture in seen])
    # A number read once in all frames is as likely a misreading.
    often = [int(number) for number in np.unique(numbers) if (numbers == number).sum() > 1]
    if not often:
        return None
    pictures = sorted(seen, key=lambda picture: -len(picture.markers.ids))[:_CLEAREST]
    best: tuple[float, BoardGuess] | None = None
    for squares_x in range(_SMALLEST, _LARGEST + 1):
        for squares_y in range(_SMALLEST, _LARGEST + 1):
            unseen = squares_x * squares_y // 2 - (max(often) + 1)
            if not 0 <= unseen <= _UNSEEN:
                continue
            for legacy in (False, True) if squares_y % 2 == 0 else (False,):
                guess = BoardGuess(squares_x, squares_y, finder.dictionary, legacy, finder.inverted, 0.75)
                # A board that needs more markers than were seen must explain more corners to be believed.
                score = _score(pictures, guess) - 0.5 * unseen
                if score > 0 and (best is None or score > best[0]):
                    best = (score, guess)
    if best is None:
        return None
    guess = best[1]
    smallest = next(size for size in _SIZES if guess.squares_x * guess.squares_y // 2 <= size)
    return replace(
        guess,
        dictionary=finder.dictionary.replace("1000", str(smallest)),
        marker_share=_marker_share(pictures, guess),
    )


def _shrunk(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    scale = WIDTH / image.shape[1]
    return (
        image if scale >= 1 else np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    )


def _corners(picture: _Picture, guess: BoardGuess) -> BoardView | None:
    """The board's corners in a picture, if it is this board."""
    assert guess.dictionary is not None
    assert guess.marker_share is not None
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, guess.dictionary))
    board = cv2.aruco.CharucoBoard((guess.squares_x, guess.squares_y), 1.0, guess.marker_share, dictionary)
    board.setLegacyPattern(guess.legacy)
    detector = cv2.aruco.CharucoDetector(board)
    corners, ids, _, _ = detector.detectBoard(
        picture.image,
        None,
        None,
        tuple(picture.markers.corners[:, None]),
        picture.markers.ids[:, None].astype(np.int32),
    )
    if ids is None or len(ids) < _MIN_CORNERS:
        return None
    numbers = np.asarray(ids, np.int64).ravel()
    points = np.asarray(board.getChessboardCorners(), np.float64)[numbers, :2]
    if np.linalg.matrix_rank(points - points.mean(0)) < 2:
        return None
    return BoardView(numbers, points, np.asarray(corners, np.float64).reshape(-1, 2) + OPENCV_PIXEL_SHIFT)


def _score(pictures: Sequence[_Picture], guess: BoardGuess) -> float:
    """Corners found that lie on a plane in perspective, over all pictures."""
    views = [view for view in (_corners(picture, guess) for picture in pictures) if view is not None]
    return sum(len(view.ids) * max(0.0, 1 - view.homography_residual() / _FLAT) for view in views)


def _marker_share(pictures: Sequence[_Picture], guess: BoardGuess) -> float:
    """A marker's side over a square's, to two decimals: markers measured in the plane that the corners span."""
    sides: list[float] = []
    for picture in pictures:
        view = _corners(picture, guess)
        if view is None:
            continue
        homography, _ = cv2.findHomography(view.pixels - OPENCV_PIXEL_SHIFT, view.points, 0)
        for marker in picture.markers.corners:
            mapped = cv2.perspectiveTransform(np.asarray(marker, np.float64).reshape(1, -1, 2), homography)[0]
            sides += np.linalg.norm(mapped - np.roll(mapped, 1, axis=0), axis=1).tolist()
    return round(float(np.clip(np.median(sides), 0.05, 0.95)), 2) if sides else 0.75

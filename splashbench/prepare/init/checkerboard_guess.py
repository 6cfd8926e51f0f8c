"""How many squares a plain checkerboard has that was filmed: found without knowing its size."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.prepare.calibration.checkerboard import CheckerboardDetector
from splashbench.prepare.session_tables import Board

SIDE = 1000  # longer side of the images searched
MIN_CORNERS = 12  # a tiled floor or a window is now and then taken for a smaller board
AGREEING = 2  # images that must show a board of the size
_FLAGS = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER


def board_corners(image: NDArray[np.uint8]) -> NDArray[np.float32] | None:
    """Inner corners [rows, columns, 2] of whatever checkerboard a grey image [H, W] shows, pixels of it; or None.

    A border that is covered or out of the picture makes the board look smaller.
    """
    zoom = min(1.0, SIDE / max(image.shape))
    small = image if zoom == 1 else cv2.resize(image, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA)
    cv2.setRNGSeed(0)
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), _FLAGS)
    if not found or len(corners) < MIN_CORNERS:
        return None
    return np.asarray(corners, np.float32).reshape(*np.shape(meta)[:2], 2) / np.float32(zoom)


def guess_squares(images: Sequence[NDArray[np.uint8]]) -> tuple[int, int] | None:
    """Squares along the longer and the shorter side of the checkerboard in grey images [H, W]; None without one."""
    sizes: Counter[tuple[int, int]] = Counter()
    for image in images:
        corners = board_corners(image)
        if corners is not None:
            longer, shorter = sorted(corners.shape[:2], reverse=True)
            sizes[(longer + 1, shorter + 1)] += 1
    # The largest first: parts of a board are seen often, more than the board never.
    for squares in sorted(sizes, key=lambda size: -size[0] * size[1]):
        if sizes[squares] < AGREEING or min(squares) < 4 or max(squares) > 100:  # what `Board` allows
            continue
        board = Board(kind="checkerboard", squares_x=squares[0], squares_y=squares[1], square_metres=1.0)
        detector = CheckerboardDetector(board)
        if sum(detector.detect_true(image) is not None for image in images) >= AGREEING:
            return squares
    return None

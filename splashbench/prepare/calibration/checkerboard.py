"""Finding a plain checkerboard in an image, and numbering its corners alike in every image.

Detection: the sector-based detector of Duda and Frese (BMVC 2018) searches a shrunk image, and OpenCV's older one where
that detects nothing. The corners are then refined in the image itself.

Numbering: a checkerboard lacks the marks that number a ChArUco board. Where one side counts an odd and the other an
even number of squares, its colours tell a half turn apart: the first corner is the one beside a dark outermost square
(a light one if `inverted`), with x to the right and y down as the board faces the camera. Otherwise the board looks the
same after a half turn, and a square board of odd count after a quarter turn. Each view is then numbered so that x runs
as nearly as possible to the right in its image.

The intrinsics do not depend on it. Where corners of several views are matched by number, `numbered_alike` turns the
views to agree. Which of the turns they agree on stays open, and so does the scene's direction of x.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.prepare.calibration.board import (
    MIN_CORNERS,
    BoardDetector,
    BoardLayout,
    BoardView,
    Detector,
    collinear,
    image_size,
    to_grey,
)
from splashbench.prepare.calibration.lens import OPENCV_PIXEL_SHIFT, Array, Lens

# Longer sides of the images searched, pixels, and how: boards near the camera are found best in the first, in a third
# of a second; small ones need the second, where an exhaustive search would take many seconds.
SEARCHES = (
    (1000, cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE),
    (2000, cv2.CALIB_CB_NORMALIZE_IMAGE),
)
# The detector matches corners by a randomised search, which now and then ends on corners next to the board: other
# seeds find the board.
SEEDS = (0, 1, 2)
REFINEMENT_WINDOW = 0.25  # half the window, over the distance to the nearest corner
# Refinement that carries a corner further than this, over the same distance, has found another edge or a highlight.
MAX_REFINEMENT = 0.08
# Where corners are checked to be crossings: radius of the circle over the same distance, and by how much the second
# harmonic must exceed the first (measured on photographs: true corners 5 and more, misplaced ones 2 and less).
CROSSING_RADIUS = 0.3
CROSSING_HARMONICS = 3.0
_QUADS = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_FAST_CHECK


class CheckerboardDetector:
    """Finds a checkerboard's inner corners in images. Corners that light or blur has hidden are left out."""

    def __init__(self, layout: BoardLayout) -> None:
        self.layout: BoardLayout = layout
        self.columns, self.rows = layout.squares_x - 1, layout.squares_y - 1
        grid = np.stack(np.meshgrid(np.arange(self.columns), np.arange(self.rows)), axis=-1)
        self.corners: Array = np.asarray((grid.reshape(-1, 2) + 1) * layout.square_metres, np.float64)

    def detect(self, image: NDArray[np.uint8]) -> BoardView | None:
        """What looks most like the board in `image` ([H, W, 3] RGB or [H, W] grey); None where nothing does."""
        return next(self.candidates(image), None)

    def detect_true(self, image: NDArray[np.uint8]) -> BoardView | None:
        """The first candidate whose corners lie on a plane seen in perspective."""
        size = image_size(image)
        return next((view for view in self.candidates(image) if view.lies_on_a_plane(size)), None)

    def candidates(self, image: NDArray[np.uint8]) -> Iterator[BoardView]:
        """What may be the board, the likeliest first; the same for the same image."""
        grey = to_grey(image, self.layout.inverted)
        shape = (self.columns, self.rows)
        for side, flags in SEARCHES:
            zoom = min(1.0, side / max(grey.shape))
            small = grey if zoom == 1 else cv2.resize(grey, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA)
            for seed in SEEDS:
                cv2.setRNGSeed(seed)  # OpenCV's own, which goes on from call to call: results would differ by history
                found, corners = cv2.findChessboardCornersSB(small, shape, flags=flags)
                if not found:
                    break
                yield from self._refined(grey, corners, zoom)
            found, corners = cv2.findChessboardCorners(small, shape, flags=_QUADS)
            if found:
                yield from self._refined(grey, corners, zoom)

    def _refined(self, grey: NDArray[np.uint8], detected: NDArray[np.float32], zoom: float) -> Iterator[BoardView]:
        """The view, with corners as exact as the full image allows; nothing where too few of them stay in place."""
        coarse = (np.asarray(detected, np.float64).reshape(self.rows, self.columns, 2) + OPENCV_PIXEL_SHIFT) / zoom
        spacing = _spacing(coarse).ravel()
        ordered = self._ordered(grey, coarse).reshape(-1)
        pixels = coarse.reshape(-1, 2).copy()
        for k, corner in enumerate(pixels):
            half = max(2, round(REFINEMENT_WINDOW * spacing[k]))
            start = (corner - OPENCV_PIXEL_SHIFT).astype(np.float32).reshape(1, 1, 2)
            stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
            pixels[k] = cv2.cornerSubPix(grey, start, (half, half), (-1, -1), stop).ravel() + OPENCV_PIXEL_SHIFT
        moved = np.linalg.norm(pixels - coarse.reshape(-1, 2), axis=1)
        trusted = (moved <= np.maximum(MAX_REFINEMENT * spacing, 1 / zoom)) & _are_crossings(grey, pixels, spacing)
        numbers = np.flatnonzero(trusted[ordered])
        points = self.corners[numbers]
        if len(numbers) >= MIN_CORNERS and not collinear(points):
            yield BoardView(numbers, points, pixels[ordered[numbers]])

    def _ordered(self, grey: NDArray[np.uint8], grid: Array) -> NDArray[np.int64]:
        """Indices into the corners as found [rows, columns, 2], in the order of the board's numbers."""
        index = np.arange(self.rows * self.columns).reshape(self.rows, self.columns)
        right, down = (grid[:, -1] - grid[:, 0]).mean(0), (grid[-1] - grid[0]).mean(0)
        if right[0] * down[1] - right[1] * down[0] < 0:  # a board facing the camera is never mirrored
            index = index[:, ::-1]
        turns = [np.rot90(index, k) for k in (range(4) if self.rows == self.columns else (0, 2))]
        flat = grid.reshape(-1, 2)
        allowed = [turn for turn in turns if _first_square_is_dark(grey, flat[turn])]
        return max(allowed or turns, key=lambda turn: _rightwards(flat[turn]))


def board_detector(layout: BoardLayout) -> Detector:
    """The detector for a board. Raises SplashbenchError where its dictionary is unknown."""
    return CheckerboardDetector(layout) if layout.kind == "checkerboard" else BoardDetector(layout)


def like_turns(layout: BoardLayout) -> list[NDArray[np.int64]]:
    """Renumberings [N] of a board's corners that no image can tell apart, the first of them none.

    Entry n is the number that corner n gets when the board is turned; quarter turns run clockwise on the print.
    """
    columns, rows = layout.squares_x - 1, layout.squares_y - 1
    index = np.arange(rows * columns).reshape(rows, columns)
    if layout.kind != "checkerboard":
        quarters = [0]
    elif layout.squares_x == layout.squares_y:
        quarters = [0, 1, 2, 3] if layout.squares_x % 2 else [0, 2]
    else:
        quarters = [0] if (layout.squares_x + layout.squares_y) % 2 else [0, 2]
    return [np.rot90(index, k).ravel() for k in quarters]


def numbered_alike(
    views: Sequence[BoardView], lenses: Sequence[Lens], w2c: Sequence[Array], detector: Detector
) -> list[BoardView]:
    """The views of one resting board, renumbered so that a number means the same corner in all of them.

    `w2c`: [4, 4] per view, of any scale. Each view alone tells where the board's x axis points in the world; the views
    are turned until these directions agree. For a board without ambiguity the views come back as they are.
    """
    turns = like_turns(detector.layout)
    if len(turns) == 1 or not views:
        return list(views)
    choices = [[_renumbered(view, turn, detector) for turn in turns] for view in views]
    # [V, turns, 3]: the x axis of the board in the world, after every turn.
    axes = np.array(
        [[_x_axis(view, lens, pose) for view in turned] for turned, lens, pose in zip(choices, lenses, w2c)]
    )
    # The reference that most others agree with after their best turn: one bad view must not turn all others.
    agreement = np.einsum("ai,bki->abk", axes[:, 0], axes)
    reference = int(np.argmax(np.median(agreement.max(axis=2), axis=1)))
    return [turned[int(np.argmax(agreement[reference, v]))] for v, turned in enumerate(choices)]


def _renumbered(view: BoardView, turn: NDArray[np.int64], detector: Detector) -> BoardView:
    numbers = turn[view.ids]
    order = np.argsort(numbers)
    return BoardView(numbers[order], detector.corners[numbers[order]], view.pixels[order])


def _x_axis(view: BoardView, lens: Lens, w2c: Array) -> Array:
    """Direction [3] of the board's x axis in the world, from this view alone; zeros where no pose fits."""
    points = np.column_stack([view.points - view.points.mean(0), np.zeros(len(view.points))])
    solved, rotation, _ = cv2.solvePnP(points, lens.normalise(view.pixels), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    return np.asarray(w2c[:3, :3].T @ cv2.Rodrigues(rotation)[0][:, 0]) if solved else np.zeros(3)


def _spacing(grid: Array) -> Array:
    """Distance of every corner [rows, columns, 2] to its nearest neighbour along a row or column: [rows, columns]."""
    spacing = np.full(grid.shape[:2], np.inf)
    along = np.linalg.norm(np.diff(grid, axis=1), axis=2)
    across = np.linalg.norm(np.diff(grid, axis=0), axis=2)
    for view, distance in (
        (spacing[:, :-1], along),
        (spacing[:, 1:], along),
        (spacing[:-1], across),
        (spacing[1:], across),
    ):
        np.minimum(view, distance, out=view)
    return spacing


def _are_crossings(grey: NDArray[np.uint8], pixels: Array, spacing: Array) -> NDArray[np.bool_]:
    """Whether four squares meet at each of the points [N, 2].

    On a circle around a crossing the grey levels come twice round: their second harmonic is strong, the first zero. On
    an edge, or beside the crossing, the first is the stronger.
    """
    height, width = grey.shape
    to_border = np.minimum(pixels, [width, height] - pixels).min(axis=1) - 1.0
    radius = np.minimum(CROSSING_RADIUS * spacing, to_border)
    angle = np.arange(32) * 2 * np.pi / 32
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    maps = (pixels[:, None] + radius[:, None, None] * circle - OPENCV_PIXEL_SHIFT).astype(np.float32)
    levels = cv2.remap(cv2.blur(grey, (3, 3)), maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    harmonics = np.abs(np.fft.rfft(levels.astype(np.float64), axis=1))
    return np.asarray((radius > 0) & (harmonics[:, 2] > CROSSING_HARMONICS * harmonics[:, 1]))


def _first_square_is_dark(grey: NDArray[np.uint8], grid: Array) -> bool:
    """Whether the board's top left square is dark, by the colours of the squares between the corners [r, c, 2]."""
    centres = (grid[:-1, :-1] + grid[:-1, 1:] + grid[1:, :-1] + grid[1:, 1:]) / 4
    maps = (centres - OPENCV_PIXEL_SHIFT).astype(np.float32)
    levels = cv2.remap(cv2.blur(grey, (3, 3)), maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    rows, columns = np.indices(levels.shape)
    even = (rows + columns) % 2 == 0
    return bool(levels[even].mean() < levels[~even].mean())


def _rightwards(grid: Array) -> float:
    """Cosine between the board's x direction, corners [rows, columns, 2], and the image's."""
    direction = (grid[:, -1] - grid[:, 0]).mean(0)
    return float(direction[0] / max(np.linalg.norm(direction), 1e-9))

"""Checkerboards: corners found where they are and numbered alike, and lenses from photographs with a known truth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.prepare.calibration.board import BoardDetector, BoardView
from splashbench.prepare.calibration.checkerboard import (
    CheckerboardDetector,
    board_detector,
    like_turns,
    numbered_alike,
)
from splashbench.prepare.calibration.intrinsics import calibrate, calibrate_views
from splashbench.prepare.calibration.lens import Lens
from splashbench.prepare.session_tables import Board
from splashbench.prepare.video.stills import Stills

BOARD = Board(kind="checkerboard", squares_x=8, squares_y=5, square_metres=0.03)
REAL_BOARD = Board(kind="checkerboard", squares_x=8, squares_y=5, square_metres=0.06)
SIZE = (640, 480)
TEXELS = 60  # per square


def board_of(squares_x: int, squares_y: int) -> Board:
    return BOARD.model_copy(update={"squares_x": squares_x, "squares_y": squares_y})


def tilted(degrees: float, layout: Board = BOARD) -> np.ndarray:
    """Homography from metres on the board to pixels of a picture in which it lies tilted, turned by `degrees`."""
    lens = np.array([[600.0, 0, 321.0], [0, 600.0, 238.0], [0, 0, 1]])
    turn = cv2.Rodrigues(np.array([0.0, 0.0, np.radians(degrees)]))[0]
    rotation = cv2.Rodrigues(np.array([0.35, -0.3, 0.0]))[0] @ turn
    middle = np.array([layout.squares_x, layout.squares_y, 0.0]) * layout.square_metres / 2
    translation = np.array([0.01, -0.005, 0.45]) - rotation @ middle
    return lens @ np.column_stack([rotation[:, :2], translation])


def picture(homography: np.ndarray, layout: Board = BOARD) -> np.ndarray:
    """The board, its top left square black, on white paper: grey levels [H, W], 3 x 3 samples per pixel."""
    rows, columns = np.mgrid[: layout.squares_y * TEXELS, : layout.squares_x * TEXELS] // TEXELS
    board = np.where((rows + columns) % 2 == 0, 25, 235).astype(np.uint8)
    board = cv2.copyMakeBorder(board, *[TEXELS] * 4, cv2.BORDER_CONSTANT, value=235)
    metres = layout.square_metres / TEXELS
    texel_to_metre = np.array([[metres, 0, metres * (0.5 - TEXELS)], [0, metres, metres * (0.5 - TEXELS)], [0, 0, 1]])
    pixel_to_sample = np.array([[3.0, 0, -0.5], [0, 3.0, -0.5], [0, 0, 1]])
    large = cv2.warpPerspective(
        board, pixel_to_sample @ homography @ texel_to_metre, (3 * SIZE[0], 3 * SIZE[1]), borderValue=120
    )
    return cv2.resize(large, SIZE, interpolation=cv2.INTER_AREA)


def mapped(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    image = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return image[:, :2] / image[:, 2:]


@pytest.mark.parametrize("degrees", [0, 100, 180, 265])
@pytest.mark.parametrize("inverted", [False, True])
def test_corners_are_found_and_numbered_whichever_way_the_board_is_turned(degrees: float, inverted: bool) -> None:
    homography = tilted(degrees)
    image = picture(homography)
    detector = board_detector(BOARD.model_copy(update={"inverted": inverted}))
    view = detector.detect_true(255 - image if inverted else image)
    assert view is not None
    assert view.ids.tolist() == list(range(28))
    np.testing.assert_array_equal(view.points, detector.corners)
    np.testing.assert_allclose(view.pixels, mapped(homography, detector.corners), atol=0.1)


def test_corners_lie_where_those_of_a_charuco_board_of_the_same_squares_do() -> None:
    charuco = BoardDetector(
        Board(squares_x=8, squares_y=5, square_metres=0.03, marker_metres=0.02, dictionary="DICT_4X4_50")
    )
    np.testing.assert_allclose(CheckerboardDetector(BOARD).corners, charuco.corners, atol=1e-7)


def test_board_detector_follows_the_kind() -> None:
    charuco = Board(squares_x=8, squares_y=5, square_metres=0.03, marker_metres=0.02, dictionary="DICT_4X4_50")
    assert isinstance(board_detector(charuco), BoardDetector)
    assert isinstance(board_detector(BOARD), CheckerboardDetector)


def test_a_hidden_corner_is_left_out_not_misplaced() -> None:
    homography = tilted(0)
    image = picture(homography)
    detector = CheckerboardDetector(BOARD)
    true = mapped(homography, detector.corners)
    cv2.circle(image, tuple(np.round(true[0]).astype(int).tolist()), 12, 235, -1)  # glare
    view = detector.detect_true(image)
    assert view is not None
    assert len(view.ids) >= 25
    np.testing.assert_allclose(view.pixels, true[view.ids], atol=0.3)


def test_no_board_is_none() -> None:
    detector = CheckerboardDetector(BOARD)
    assert detector.detect(np.full((480, 640, 3), 128, np.uint8)) is None
    other = board_of(6, 5)
    assert detector.detect_true(picture(tilted(0, other), other)) is None


def test_what_is_found_does_not_depend_on_what_was_done_before() -> None:
    detector, image = CheckerboardDetector(BOARD), picture(tilted(30))
    cv2.setRNGSeed(5)
    first = detector.detect(image)
    cv2.setRNGSeed(6)
    second = detector.detect(image)
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.pixels, second.pixels)


@pytest.mark.parametrize(("squares", "count"), [((8, 5), 1), ((8, 6), 2), ((7, 5), 2), ((6, 6), 2), ((7, 7), 4)])
def test_turns_that_no_image_tells_apart(squares: tuple[int, int], count: int) -> None:
    layout = board_of(*squares)
    turns = like_turns(layout)
    assert len(turns) == count
    detector = CheckerboardDetector(layout)
    colours = {}
    rows, columns = np.mgrid[: layout.squares_y, : layout.squares_x]
    for quarter in range(4):
        turned = np.rot90((rows + columns) % 2, quarter)
        colours[quarter] = turned.shape == rows.shape and np.array_equal(turned, (rows + columns) % 2)
    assert sum(colours.values()) == count
    for turn in turns:  # a renumbering is a rigid turn of the corners
        distances = np.linalg.norm(detector.corners[:, None] - detector.corners[None], axis=2)
        np.testing.assert_allclose(distances[turn][:, turn], distances, atol=1e-12)
    assert (
        like_turns(Board(squares_x=7, squares_y=7, square_metres=0.03, marker_metres=0.02, dictionary="DICT_4X4_50"))[
            1:
        ]
        == []
    )


@pytest.mark.parametrize("squares", [(8, 5), (8, 6), (6, 6), (7, 7)])
def test_views_of_a_resting_board_are_numbered_alike(squares: tuple[int, int]) -> None:
    rng = np.random.default_rng(8)
    layout = board_of(*squares)
    detector = CheckerboardDetector(layout)
    turns = like_turns(layout)
    lens = Lens(640, 480, np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]), np.array([-0.1, 0.02, 0, 0, 0]))
    world = np.column_stack([detector.corners - detector.corners.mean(0), np.zeros(len(detector.corners))])
    views, poses, truth = [], [], []
    for angle in np.radians([0, 40, 110, 170, 230, 300, 301]):
        eye = np.array([0.4 * np.cos(angle), 0.4 * np.sin(angle), -0.45])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross([0.0, 0.0, 1.0], forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = np.eye(4)
        pose[:3] = np.column_stack([rotation, -rotation @ eye])
        seen = np.sort(rng.permutation(len(world))[: len(world) - 3])
        pixels = lens.project(world[seen] @ rotation.T + pose[:3, 3]) + rng.normal(0, 0.3, (len(seen), 2))
        numbers = turns[rng.integers(len(turns))][seen]
        order = np.argsort(numbers)
        views.append(BoardView(numbers[order], detector.corners[numbers[order]], pixels[order]))
        poses.append(pose)
        truth.append(seen[order])
    found = numbered_alike(views, [lens] * len(views), poses, detector)
    # One turn for all views: which one, no image tells.
    agreeing = 0
    for turn in turns:
        agreeing += all(
            np.array_equal(np.sort(turn[true]), view.ids)
            and np.allclose(view.pixels, old.pixels[np.argsort(turn[true])])
            for view, old, true in zip(found, views, truth)
        )
    assert agreeing == 1
    for view in found:
        np.testing.assert_array_equal(view.points, detector.corners[view.ids])


def test_too_few_checkerboards_is_one_line_naming_the_photographs() -> None:
    blank = [np.full((480, 640, 3), 128, np.uint8)] * 2
    with pytest.raises(SplashbenchError, match=r"photos: the 8x5 checkerboard is usable in 0 of 2 frames, 5 are"):
        calibrate(blank, CheckerboardDetector(BOARD), "photos")


@pytest.mark.parametrize(("camera", "truth"), [("01", 1681.2), ("03", 1681.6)])
def test_real_photographs_give_the_focal_length(test_data: Path, camera: str, truth: float) -> None:
    photographs = Stills([test_data / f"real/checkerboard/int_cam{camera}_img"])
    found = calibrate((image for _, image in photographs.frames()), board_detector(REAL_BOARD), "photographs")
    assert (found.lens.width, found.lens.height) == (1088, 1920)
    assert found.n_views == 7
    assert found.n_outliers == 0
    np.testing.assert_allclose(found.lens.K[[0, 1], [0, 1]], truth, rtol=0.006)
    assert found.held_out_rms_px < 0.3
    assert found.focal_sigma_px < 0.005 * truth


def test_a_real_false_detection_is_rejected(test_data: Path) -> None:
    detector = CheckerboardDetector(REAL_BOARD)
    photographs = Stills([test_data / "real/checkerboard/int_cam01_img"])
    images = [image for _, image in photographs.frames()]
    size = (1088, 1920)
    # OpenCV's detector by itself, on the half-size image: some seeds end on corners beside the board.
    grey = cv2.cvtColor(images[5], cv2.COLOR_RGB2GRAY)
    small = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    for seed in range(20):
        cv2.setRNGSeed(seed)
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        found, corners = cv2.findChessboardCornersSB(small, (7, 4), flags=flags)
        assert found
        false = BoardView(np.arange(28), detector.corners, (corners.reshape(-1, 2).astype(np.float64) + 0.5) * 2)
        if false.homography_residual_px() > 50:
            break
    assert false.homography_residual_px() > 50
    assert not false.lies_on_a_plane(size)

    views = [view for image in images if (view := detector.detect_true(image)) is not None]
    assert len(views) == 7
    assert max(view.homography_residual_px() for view in views) < 1.0
    clean = calibrate_views(views, detector, size, "photographs", 7)
    found = calibrate_views([*views[:5], false, *views[5:]], detector, size, "photographs", 8)
    assert found.n_false == 1
    assert found.lens.focal == pytest.approx(clean.lens.focal, rel=1e-3)

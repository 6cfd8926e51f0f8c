"""Lenses from a ChArUco clip: a rendered board with a known lens, false detections, and what the evidence says."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.prepare.calibration.board import BoardDetector, BoardView
from splashbench.prepare.calibration.intrinsics import calibrate, calibrate_views, coverage, spread_out
from splashbench.prepare.calibration.lens import Lens
from splashbench.prepare.session_tables import Board

BOARD = Board(squares_x=8, squares_y=5, square_metres=0.03, marker_metres=0.0225, dictionary="DICT_4X4_50")
WIDTH, HEIGHT = 480, 270
LENS = Lens(
    WIDTH,
    HEIGHT,
    np.array([[400.0, 0.0, 243.0], [0.0, 402.0, 133.0], [0.0, 0.0, 1.0]]),
    np.array([-0.15, 0.04, 0.0005, -0.0003, 0.0]),
)
TEXELS_PER_METRE = 4000
MARGIN_TEXELS = 40


def printed_board(detector: BoardDetector) -> np.ndarray:
    size = (8 * 120, 5 * 120)
    print_ = detector.board.generateImage(size, marginSize=0)
    return cv2.copyMakeBorder(print_, *[MARGIN_TEXELS] * 4, cv2.BORDER_CONSTANT, value=255)


def random_pose(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A tilted board in view: rotation [3, 3] and translation [3] of board to camera."""
    rotation = cv2.Rodrigues(rng.uniform(-1, 1, 3) * np.radians([50, 50, 30]))[0]
    depth = rng.uniform(0.25, 0.6)
    centre = np.array([rng.uniform(-0.45, 0.45) * depth, rng.uniform(-0.25, 0.25) * depth, depth])
    return rotation, centre - rotation @ [0.12, 0.075, 0.0]


def sample_rays(lens: Lens) -> np.ndarray:
    """Rays [9 * H * W, 3] of 3 x 3 samples per pixel."""
    rows, columns = np.mgrid[0 : 3 * lens.height, 0 : 3 * lens.width]
    pixels = np.stack([(columns + 0.5) / 3, (rows + 0.5) / 3], axis=-1).reshape(-1, 2)
    return np.column_stack([lens.normalise(pixels), np.ones(len(pixels))])


def photograph(board: np.ndarray, rays: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """The board as seen along the rays of LENS, averaged per pixel: [H, W] grey levels, float."""
    normal = rotation[:, 2]
    distance = (normal @ translation) / (rays @ normal)
    on_board = (rays * distance[:, None] - translation) @ rotation
    texels = on_board[:, :2] * TEXELS_PER_METRE + MARGIN_TEXELS - 0.5
    maps = texels.astype(np.float32).reshape(3 * HEIGHT, 3 * WIDTH, 2)
    sampled = cv2.remap(board, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=110)
    return sampled.reshape(HEIGHT, 3, WIDTH, 3).mean(axis=(1, 3))


@pytest.fixture(scope="module")
def detector() -> BoardDetector:
    return BoardDetector(BOARD)


@pytest.fixture(scope="module")
def clip(detector: BoardDetector) -> list[np.ndarray]:
    rng = np.random.default_rng(7)
    board, rays = printed_board(detector), sample_rays(LENS)
    frames = []
    for _ in range(28):
        grey = 0.8 * photograph(board, rays, *random_pose(rng)) + 20 + rng.normal(0, 2.5, (HEIGHT, WIDTH))
        frames.append(np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2))
    return frames


def ideal_view(detector: BoardDetector, lens: Lens, rng: np.random.Generator, noise: float = 0.05) -> BoardView:
    """Corners projected through the lens, with noise in pixels; those outside the frame are not seen."""
    while True:
        rotation, translation = random_pose(rng)
        points = np.column_stack([detector.corners, np.zeros(len(detector.corners))])
        pixels = lens.project(points @ rotation.T + translation) + rng.normal(0, noise, (len(points), 2))
        seen = ((pixels > 2) & (pixels < [lens.width - 2, lens.height - 2])).all(axis=1)
        if seen.sum() >= 10:
            return BoardView(np.flatnonzero(seen), detector.corners[seen], pixels[seen])


def test_lens_projection_inverts_and_follows_opencv() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (200, 2)), np.ones(200)])
    pixels = LENS.project(points)
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), LENS.opencv_K(), LENS.distortion)[0]
    # OpenCV's pixel centres are whole numbers, ours at +0.5.
    np.testing.assert_allclose(pixels, expected.reshape(-1, 2) + 0.5, atol=1e-9)
    np.testing.assert_allclose(LENS.normalise(pixels), points[:, :2], atol=1e-9)


def test_corner_of_the_print_is_found_where_it_is(detector: BoardDetector) -> None:
    # Seen square on at 25 pixels per square, corner 0 (one square in from the top left) lies on pixel edges.
    image = np.full((HEIGHT, WIDTH), 255, np.uint8)
    image[20:145, 30:230] = detector.board.generateImage((200, 125), marginSize=0)
    view = detector.detect(image)
    assert view is not None
    assert view.ids[0] == 0
    np.testing.assert_allclose(view.pixels[0], [30 + 25, 20 + 25], atol=0.1)


def test_rendered_clip_gives_the_lens(clip: list[np.ndarray], detector: BoardDetector) -> None:
    found = calibrate(clip, detector, "clip.mp4")
    assert found.n_detected >= 20
    np.testing.assert_allclose(found.lens.K[[0, 1], [0, 1]], [400.0, 402.0], rtol=0.003)
    np.testing.assert_allclose(found.lens.K[:2, 2], [243.0, 133.0], atol=2.0)
    assert found.rms_px < 0.2
    assert found.held_out_rms_px < 0.25
    assert found.focal_sigma_px < 0.005 * 400
    assert found.coverage > 0.6
    # What counts in the end: where the lens puts the rays of the whole image.
    grid = np.stack(np.meshgrid(np.linspace(5, 475, 12), np.linspace(5, 265, 8)), axis=-1).reshape(-1, 2)
    rays = np.column_stack([LENS.normalise(grid), np.ones(len(grid))])
    offset = found.lens.project(rays) - grid
    assert np.sqrt(((offset - offset.mean(axis=0)) ** 2).sum(axis=1).mean()) < 0.5


def test_false_detections_do_not_move_the_focal_length(detector: BoardDetector) -> None:
    rng = np.random.default_rng(3)
    views = [ideal_view(detector, LENS, rng) for _ in range(20)]
    for k in range(3):  # corners misnumbered: no plane explains them
        ids, points, pixels = views[k].ids, views[k].points, views[k].pixels
        views.append(BoardView(ids, points, rng.permutation(pixels)))
    found = calibrate_views(views, detector, (WIDTH, HEIGHT), "clip.mp4", 23)
    assert found.n_false == 3
    assert abs(found.lens.focal / LENS.focal - 1) < 0.003


def test_a_large_board_does_not_hide_a_misread_row(detector: BoardDetector) -> None:
    # Over its own diagonal the residual looks like lens distortion; in pixels of the image it is none.
    points = detector.corners
    pixels = (points - points.min(0)) / np.ptp(points[:, 0]) * 0.9 * WIDTH + 10
    misread = pixels.copy()
    misread[:7, 1] -= 46
    size = (WIDTH, HEIGHT)
    assert BoardView(np.arange(28), points, pixels).lies_on_a_plane(size)
    view = BoardView(np.arange(28), points, misread)
    assert view.homography_residual() == pytest.approx(view.homography_residual_px() / view.diagonal)
    assert view.homography_residual_px() > 0.02 * WIDTH
    assert view.homography_residual() < 0.03
    assert not view.lies_on_a_plane(size)


def test_single_misplaced_corners_are_left_out_and_their_views_kept(detector: BoardDetector) -> None:
    rng = np.random.default_rng(9)
    views = [ideal_view(detector, LENS, rng) for _ in range(12)]
    for k in (0, 3, 7):
        pixels = views[k].pixels.copy()
        pixels[4] += [3.0, -4.0]
        views[k] = BoardView(views[k].ids, views[k].points, pixels)
    found = calibrate_views(views, detector, (WIDTH, HEIGHT), "clip.mp4", 12)
    assert (found.n_views, found.n_outlier_corners) == (12, 3)
    assert found.rms_px < 0.1
    assert abs(found.lens.focal / LENS.focal - 1) < 0.003


def test_five_good_views_are_enough_and_their_deviation_says_how_far(detector: BoardDetector) -> None:
    rng = np.random.default_rng(12)
    views = [ideal_view(detector, LENS, rng) for _ in range(5)]
    found = calibrate_views(views, detector, (WIDTH, HEIGHT), "clip.mp4", 5)
    many = calibrate_views(
        views + [ideal_view(detector, LENS, rng) for _ in range(25)], detector, (WIDTH, HEIGHT), "clip.mp4", 30
    )
    assert abs(found.lens.focal - LENS.focal) < 3 * found.focal_sigma_px
    assert found.focal_sigma_px > 2 * many.focal_sigma_px
    with pytest.raises(SplashbenchError, match="usable in 4 of 4 frames, 5 are needed"):
        calibrate_views(views[:4], detector, (WIDTH, HEIGHT), "clip.mp4", 4)


def test_a_blurred_view_is_left_out(detector: BoardDetector) -> None:
    rng = np.random.default_rng(4)
    views = [ideal_view(detector, LENS, rng) for _ in range(20)]
    views.append(ideal_view(detector, LENS, rng, noise=1.0))
    assert calibrate_views(views, detector, (WIDTH, HEIGHT), "clip.mp4", 21).n_outliers == 1


def test_a_board_that_stays_put_leaves_the_focal_length_open(detector: BoardDetector) -> None:
    # A small residual all the same: that is why the uncertainty and the coverage are gates.
    rng = np.random.default_rng(5)
    view = ideal_view(detector, LENS, rng, noise=0.0)
    views = [BoardView(view.ids, view.points, view.pixels + rng.normal(0, 0.05, view.pixels.shape)) for _ in range(12)]
    found = calibrate_views(views, detector, (WIDTH, HEIGHT), "clip.mp4", 12)
    assert found.rms_px < 0.2
    assert found.coverage < 0.6
    assert found.focal_sigma_px > 0.005 * LENS.focal


def test_too_few_boards_is_one_line_naming_the_clip(detector: BoardDetector) -> None:
    blank = [np.full((HEIGHT, WIDTH, 3), 128, np.uint8)] * 5
    with pytest.raises(SplashbenchError, match=r"GX01\.MP4: the 8x5 ChArUco board is usable in 0 of 5 frames"):
        calibrate(blank, detector, "GX01.MP4")


def test_copies_of_one_view_count_once(detector: BoardDetector) -> None:
    view = ideal_view(detector, LENS, np.random.default_rng(13))
    with pytest.raises(SplashbenchError, match="usable in 1 of 20 frames"):
        calibrate_views([view] * 20, detector, (WIDTH, HEIGHT), "clip.mp4", 20)


def test_unknown_dictionary_is_refused() -> None:
    layout = BOARD.model_copy(update={"dictionary": "DICT_NONSENSE"})
    with pytest.raises(SplashbenchError, match="DICT_NONSENSE"):
        BoardDetector(layout)


def test_spread_out_prefers_different_views(detector: BoardDetector) -> None:
    rng = np.random.default_rng(6)
    different = [ideal_view(detector, LENS, rng) for _ in range(5)]
    copies = [different[0]] * 20
    chosen = spread_out(copies + different, detector, (WIDTH, HEIGHT), 10)
    assert len(chosen) == 5
    assert {id(view) for view in chosen} >= {id(view) for view in different[1:]}


def test_a_flipped_video_is_told_as_such(detector: BoardDetector, clip: list[np.ndarray]) -> None:
    flipped = [np.ascontiguousarray(frame[:, ::-1]) for frame in clip]
    with pytest.raises(SplashbenchError, match=r"the board is seen mirrored.*the video is flipped, or the board was"):
        calibrate(flipped, detector, "cameras/1/intrinsics/GX010001.MP4")
    with pytest.raises(SplashbenchError, match="usable in 0 of 28 frames"):  # no board at all is no mirrored one
        calibrate([np.full_like(frame, 90) for frame in clip], detector, "cameras/1/intrinsics/GX010001.MP4")


def test_photographs_are_called_photographs(detector: BoardDetector, clip: list[np.ndarray], tmp_path: Path) -> None:
    with pytest.raises(SplashbenchError, match=r"2 of 2 photographs.*take photographs of the board again"):
        calibrate(clip[:2], detector, str(tmp_path))


def test_coverage_counts_cells() -> None:
    assert coverage(np.array([[1.0, 1.0], [2.0, 2.0], [479.0, 269.0]]), (WIDTH, HEIGHT)) == 2 / 48


def test_real_inverted_board_is_detected_and_its_poor_coverage_flagged(test_data: Path) -> None:
    from splashbench.prepare.gates import intrinsics_gates
    from splashbench.prepare.video.recording import Recording

    clip = test_data / "real/charuco/calibration/extrinsic/cam_0.mp4"
    board = Board(
        squares_x=4, squares_y=5, square_metres=0.054, marker_metres=0.0405, dictionary="DICT_4X4_1000", inverted=True
    )
    recording = Recording([clip])
    frames = [frame for _, frame in recording.frames(range(0, len(recording.frame_times), 2))]
    upright = BoardDetector(board.model_copy(update={"inverted": False}))
    assert sum(upright.detect(frame) is not None for frame in frames[::10]) == 0
    found = calibrate(frames, BoardDetector(board), str(clip))
    assert found.n_detected > 15
    assert found.rms_px < 0.4
    failed = {gate.name for gate in intrinsics_gates({"0": found}) if not gate.passed}
    assert "board_coverage" in failed


def test_the_same_views_give_the_same_bits(detector: BoardDetector) -> None:
    """OpenCV's own threads would not: they add up in the order in which they finish."""
    lens = Lens(1920, 1080, np.array([[1500.0, 0, 960], [0, 1500, 540], [0, 0, 1]]), np.array([-0.2, 0.05, 0, 0, 0]))
    rng = np.random.default_rng(5)
    views = [ideal_view(detector, lens, rng) for _ in range(30)]
    found = [calibrate_views(views, detector, (1920, 1080), "clip", 30).lens for _ in range(3)]
    assert len({(lens.K.tobytes(), lens.distortion.tobytes()) for lens in found}) == 1

"""Poses and metres on a rendered room with exactly known cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from splashbench.alignment import Similarity, umeyama
from splashbench.errors import SplashbenchError
from splashbench.prepare.calibration.board import BoardDetector, BoardView
from splashbench.prepare.calibration.lens import Lens
from splashbench.prepare.poses import mapping, rig
from splashbench.prepare.poses import structure_from_motion as poses_module
from splashbench.prepare.poses.metric import Print, Sighting, align, align_print, initial_points, transformed
from splashbench.prepare.poses.rig import find_poses, sight_prints
from splashbench.prepare.poses.structure_from_motion import Poses, estimate_poses
from splashbench.prepare.session_tables import Board
from splashbench.scene import look_at

WIDTH, HEIGHT = 400, 225
BOARD = Board(squares_x=8, squares_y=5, square_metres=0.05, marker_metres=0.0375, dictionary="DICT_4X4_50")
# Board to world: printed side up, its centre at (0.02, 0, 0.03), turned by 20 degrees.
TURN = np.radians(20)
BOARD_X = np.array([np.cos(TURN), 0.0, -np.sin(TURN)])
BOARD_Y = np.array([np.sin(TURN), 0.0, np.cos(TURN)])
BOARD_CENTRE = np.array([0.02, 0.0, 0.03])
BOARD_ORIGIN = np.array([0.02, 0.002, 0.03])  # of the board as rendered: 2 mm above the table


@dataclass
class Wall:
    """A textured parallelogram: corner, two edges, texture [h, w, 3]."""

    corner: np.ndarray
    along: np.ndarray
    across: np.ndarray
    texture: np.ndarray


def speckle(rng: np.random.Generator, size: int) -> np.ndarray:
    layers = [
        cv2.resize(rng.normal(0, n**-0.3, (n, n, 3)), (size, size), interpolation=cv2.INTER_CUBIC)
        for n in (16, 32, 64, 128, 256)
    ]
    picture = np.sum(layers, axis=0)
    return np.clip(128 + 45 * picture / picture.std(), 0, 255).astype(np.float32)


def build_room(rng: np.random.Generator) -> list[Wall]:
    """A table, a wall behind it, and boxes standing on the table."""
    walls = [
        Wall(np.array([-0.7, 0, -0.7]), np.array([1.4, 0, 0]), np.array([0, 0, 1.4]), speckle(rng, 700)),
        Wall(np.array([-1.4, -0.2, -0.8]), np.array([2.8, 0, 0]), np.array([0, 1.2, 0]), speckle(rng, 700)),
    ]
    for x, z, h in ((-0.35, -0.2, 0.16), (0.32, -0.25, 0.1), (0.0, -0.4, 0.22), (-0.3, 0.25, 0.07), (0.36, 0.2, 0.09)):
        a, b, c = np.array([0.12, 0, 0]), np.array([0, h, 0]), np.array([0, 0, 0.1])
        low = np.array([x - 0.06, 0, z - 0.05])
        sides = [(low + b, a, c), (low + c, a, b), (low, c, b), (low + a, c, b)]
        walls += [Wall(corner, along, across, speckle(rng, 256)) for corner, along, across in sides]
    return walls


@lru_cache(maxsize=1)
def rays_of(lens: Lens) -> np.ndarray:
    """Where a lens's pixels look, in camera coordinates: float32 [H, W, 3]."""
    rows, columns = np.mgrid[0 : lens.height, 0 : lens.width].astype(np.float32)
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
    normalised = cv2.undistortPoints(pixels, lens.opencv_K(), lens.distortion, criteria=criteria)
    return np.column_stack([normalised.reshape(-1, 2), np.ones(len(pixels))]).reshape(*rows.shape, 3).astype(np.float32)


def photograph(room: list[Wall], lens: Lens, w2c: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The room through a lens, with noise: uint8 [H, W, 3]."""
    rays, rotation = rays_of(lens), w2c[:3, :3]
    nearest = np.full(rays.shape[:2], np.inf, np.float32)
    colour = np.full(rays.shape, 90.0, np.float32)
    for wall in room:
        window = window_of(wall, lens, w2c)
        if rays[window].size == 0:
            continue
        # A ray times its depth is corner + u along + v across, all in camera coordinates.
        corner = rotation @ wall.corner + w2c[:3, 3]
        axes = np.stack([rotation @ wall.along, rotation @ wall.across, corner], axis=1)
        plane = rays[window] @ np.linalg.inv(axes).astype(np.float32).T
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = 1 / plane[..., 2]
            u, v = plane[..., 0] * depth, plane[..., 1] * depth
            hit = (depth > 0) & (depth < nearest[window]) & (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
        h, w = wall.texture.shape[:2]
        maps = np.stack([np.where(hit, u * w - 0.5, 0), np.where(hit, v * h - 0.5, 0)], axis=-1)
        sampled = cv2.remap(
            wall.texture, maps.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        colour[window][hit] = sampled[hit]
        nearest[window][hit] = depth[hit]
    picture = cv2.GaussianBlur(colour, (0, 0), 0.5)
    return np.clip(picture + rng.normal(0, 1.0, picture.shape), 0, 255).astype(np.uint8)


def window_of(wall: Wall, lens: Lens, w2c: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns that hold all of the wall; the whole image where a part of it lies behind the camera."""
    steps = np.linspace(0, 1, 9)
    points = np.array([wall.corner + a * wall.along + b * wall.across for a in steps for b in steps])
    local = points @ w2c[:3, :3].T + w2c[:3, 3]
    if local[:, 2].min() < 0.05:
        return np.s_[0 : lens.height, 0 : lens.width]
    pixels, size = lens.project(local), [lens.width, lens.height]
    low = np.clip(np.floor(pixels.min(0)) - 4, 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(0)) + 4, 0, size).astype(int)
    return np.s_[low[1] : high[1], low[0] : high[0]]


def look(azimuth_degrees: float, elevation_degrees: float, radius: float) -> np.ndarray:
    """World-to-camera [4, 4] of a camera that looks at a point just above the table's middle."""
    a, e = np.radians([azimuth_degrees, elevation_degrees])
    eye = radius * np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
    return look_at(eye, (0.0, 0.03, 0.0))


def make_lens(focal: float, k1: float, zoom: float = 1) -> Lens:
    """A lens at 400 x 225, or the same one with `zoom` times the pixels."""
    width, height, focal = round(zoom * WIDTH), round(zoom * HEIGHT), zoom * focal
    K = np.array([[focal, 0, 0.51 * width], [0, focal * 1.003, 0.48 * height], [0, 0, 1]])
    return Lens(width, height, K, np.array([k1, 0.03, 0.0005, -0.0003, 0.002]))


@dataclass
class Capture:
    """A rendered static scene with its truth."""

    static: dict[str, np.ndarray]
    sweep: list[np.ndarray]
    lenses: dict[str, Lens]
    w2c: dict[str, np.ndarray]


@pytest.fixture(scope="module")
def capture() -> Capture:
    rng = np.random.default_rng(11)
    room = build_room(rng)
    w2c = {str(k + 1): look(azimuth, 22, 0.95) for k, azimuth in enumerate((-38, -12, 14, 38))}
    lenses = {camera: make_lens(330 + 8 * int(camera), -0.1 - 0.01 * int(camera)) for camera in w2c}
    static = {camera: photograph(room, lenses[camera], w2c[camera], rng) for camera in w2c}
    moving = make_lens(360, -0.05)
    sweep = [photograph(room, moving, look(a, 28 + 5 * np.sin(a), 0.85), rng) for a in np.linspace(-45, 45, 11)]
    return Capture(static, sweep, lenses, w2c)


@pytest.fixture(scope="module")
def solved(capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> Poses:
    return estimate_poses(capture.static, capture.lenses, capture.sweep, tmp_path_factory.mktemp("sfm"))


def board_sightings(capture: Capture, poses: Poses, rng: np.random.Generator) -> list[Sighting]:
    """The board's corners where the true cameras see them, with 0.1 px of noise."""
    detector = BoardDetector(BOARD)
    offset = detector.corners - np.array([8, 5]) * 0.05 / 2
    world = BOARD_CENTRE + offset[:, :1] * BOARD_X + offset[:, 1:] * BOARD_Y
    sightings = []
    for camera, w2c in capture.w2c.items():
        lens = capture.lenses[camera]
        pixels = lens.project(world @ w2c[:3, :3].T + w2c[:3, 3]) + rng.normal(0, 0.1, (len(world), 2))
        view = BoardView(np.arange(len(world)), detector.corners, pixels)
        sightings.append(Sighting(view, lens, poses.w2c[camera]))
    return sightings


def test_every_camera_is_posed_in_metres_with_gravity_down(capture: Capture, solved: Poses) -> None:
    frame = align(board_sightings(capture, solved, np.random.default_rng(0)), BoardDetector(BOARD))
    assert frame.rms_m < 0.001
    assert frame.n_corners == 28
    scene = transformed(solved, frame.scene_from_sfm)
    # The scene frame in the true world: origin at the board's centre, y up, x along the print.
    world_from_scene = np.eye(4)
    world_from_scene[:3, :3] = np.stack([BOARD_X, [0.0, 1.0, 0.0], BOARD_Y], axis=1)
    world_from_scene[:3, 3] = BOARD_CENTRE
    for camera, truth in capture.w2c.items():
        expected = truth @ world_from_scene
        found = scene.w2c[camera]
        angle = np.degrees(np.linalg.norm(cv2.Rodrigues(found[:3, :3] @ expected[:3, :3].T)[0]))
        assert angle < 0.1
        centre, wanted = (-m[:3, :3].T @ m[:3, 3] for m in (found, expected))
        assert np.linalg.norm(centre - wanted) < 0.002 * np.linalg.norm(wanted)
    assert solved.mean_error_px < 0.5
    assert solved.mean_error_px <= solved.rms_error_px
    assert len(solved.sweep_w2c) == len(solved.sweep_indices) == 11
    assert abs(solved.sweep_lens.focal / 360.5 - 1) < 0.01
    # Sparse points lie in the room: most of them on the table, at height zero.
    points = initial_points(scene)
    assert points.shape == (len(solved.points), 7)
    assert points.dtype == np.float32
    assert 0 <= points[:, 3:6].min() <= points[:, 3:6].max() <= 1
    assert np.median(np.abs(points[np.abs(points[:, 1]) < 0.02, 1])) < 0.003


def board_wall() -> Wall:
    """The board as a print on the table."""
    pattern = cv2.cvtColor(BoardDetector(BOARD).board.generateImage((1600, 1000), marginSize=0), cv2.COLOR_GRAY2RGB)
    texture = cv2.resize(pattern, (800, 500), interpolation=cv2.INTER_AREA).astype(np.float32) * 0.8 + 20
    corner = BOARD_ORIGIN - 0.2 * BOARD_X - 0.125 * BOARD_Y
    return Wall(corner, 0.4 * BOARD_X, 0.25 * BOARD_Y, texture)


@pytest.mark.slow
def test_seven_cameras_at_1280x720_are_posed_to_a_millimetre(tmp_path: Path) -> None:
    """The whole way from pictures: seven cameras in an arc of one metre about the table, 25 frames of a sweep."""
    rng, zoom = np.random.default_rng(11), 3.2
    room = [*build_room(rng), board_wall()]
    elevations = (20, 26, 22, 30, 22, 26, 20)
    w2c = {str(k + 1): look(16.0 * (k - 3), elevation, 1.0) for k, elevation in enumerate(elevations)}
    lenses = {camera: make_lens(330 + 5 * int(camera), -0.1 - 0.01 * int(camera), zoom) for camera in w2c}
    static = {camera: photograph(room, lenses[camera], w2c[camera], rng) for camera in w2c}
    moving = make_lens(360, -0.05, zoom)
    path = [look(a, 30 + 6 * np.sin(a / 7), 0.85 + 0.08 * np.cos(a / 5)) for a in np.linspace(-55, 55, 25)]
    sweep = [photograph(room, moving, pose, rng) for pose in path]
    detector = BoardDetector(BOARD)
    found = find_poses(static, sweep, lenses, detector, tmp_path)
    sighted = sight_prints(static, sweep, lenses, found, SimpleNamespace(marker=None), detector)
    frame = align(sighted.board, detector)
    scene = transformed(found, frame.scene_from_sfm)

    world_from_scene = np.eye(4)
    world_from_scene[:3, :3] = np.stack([BOARD_X, [0.0, 1.0, 0.0], BOARD_Y], axis=1)
    world_from_scene[:3, 3] = BOARD_ORIGIN
    centres, wanted, angles = [], [], []
    for camera, truth in w2c.items():
        expected, pose = truth @ world_from_scene, scene.w2c[camera]
        angle = np.degrees(np.linalg.norm(cv2.Rodrigues(pose[:3, :3] @ expected[:3, :3].T)[0]))
        angles.append(angle)
        centres.append(-pose[:3, :3].T @ pose[:3, 3])
        wanted.append(-expected[:3, :3].T @ expected[:3, 3])
        assert scene.centre_sigma[camera] < 0.0005
        assert scene.rotation_sigma_deg[camera] < 0.05
    apart = np.linalg.norm(np.array(centres) - np.array(wanted), axis=1)
    growth = abs(umeyama(np.array(centres), np.array(wanted)).scale - 1)
    print(f"rotation {max(angles):.4f} degrees, centre {apart.max() * 1e3:.3f} mm, scale {growth:.4%}")
    assert max(angles) <= 0.05
    assert apart.max() <= 0.001
    assert growth <= 0.001
    assert np.abs(found.sweep_lens.K[:2, 2] - moving.K[:2, 2]).max() < 2
    assert found.attempts == ("COLMAP's thresholds: 7 of 7 fixed cameras, 32 images in all",)


def test_cameras_that_share_enough_need_no_sweep(capture: Capture, tmp_path: Path) -> None:
    static = {str(index): image for index, image in enumerate(capture.sweep[2:9:2])}
    lens = make_lens(360, -0.05)
    poses = estimate_poses(static, dict.fromkeys(static, lens), [], tmp_path)
    assert list(poses.w2c) == ["0", "1", "2", "3"]
    assert poses.sweep_w2c.shape == (0, 4, 4)
    assert poses.found_lenses == {}
    truth = [look(a, 28 + 5 * np.sin(a), 0.85) for a in np.linspace(-45, 45, 11)[2:9:2]]
    first, last = poses.w2c["0"], poses.w2c["3"]
    turn = (last[:3, :3] @ first[:3, :3].T) @ (truth[3][:3, :3] @ truth[0][:3, :3].T).T
    assert np.degrees(np.linalg.norm(cv2.Rodrigues(turn)[0])) < 0.3


def test_an_attempt_that_fails_is_followed_by_another(
    capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mapping, "INLIERS", (100_000, 50))  # no pair of images has so many
    static = {str(index): image for index, image in enumerate(capture.sweep[2:9:2])}
    poses = estimate_poses(static, dict.fromkeys(static, make_lens(360, -0.05)), [], tmp_path)
    assert poses.attempts == (
        "COLMAP's thresholds: 0 of 4 fixed cameras, 0 images in all",
        "lower thresholds: 4 of 4 fixed cameras, 4 images in all",
    )


def test_more_of_the_sweep_is_taken_where_it_does_not_bridge_the_cameras(
    capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(poses_module, "SWEEP_FRAMES", 1)
    asked = []

    def sweep_images(count: int) -> list[np.ndarray]:
        asked.append(count)
        return capture.sweep if count > 1 else []

    def find(static, sweep, lenses, detector, work, lens_covariance) -> Poses:
        if not sweep:
            raise SplashbenchError("no pose for camera 1")
        return replace(SOLVED, attempts=("first",))

    monkeypatch.setattr(rig, "find_poses", find)
    poses, used = rig.solve_poses(capture.static, sweep_images, capture.lenses, BoardDetector(BOARD), tmp_path)
    assert asked == [1, 2]
    assert len(used) == 11
    assert poses.attempts == ("0 frames of the sweep: no pose for camera 1", "first")


SOLVED = Poses({}, np.zeros((0, 4, 4)), (), make_lens(300, 0), 0, np.zeros((0, 3)), np.zeros((0, 3)), 0.0, 0.0, 0)


def test_known_lenses_are_held_and_their_deviations_are_given(capture: Capture, solved: Poses) -> None:
    assert solved.found_lenses == {}
    assert set(solved.centre_sigma) == set(solved.rotation_sigma_deg) == set(capture.w2c)
    doubled = transformed(solved, Similarity(2.0, np.eye(3), np.zeros(3)))
    for camera in capture.w2c:
        assert doubled.centre_sigma[camera] == pytest.approx(2 * solved.centre_sigma[camera])
        assert 0 < doubled.rotation_sigma_deg[camera] == solved.rotation_sigma_deg[camera] < 0.2


@pytest.mark.slow
def test_photographs_of_unknown_cameras_are_all_registered(test_data: Path, tmp_path: Path) -> None:
    """Ten photographs by ten cameras, from the internet. The error is the mean over all observations of all images."""
    folder = test_data / "real/sfm"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not at hand")
    images = {
        path.stem: cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB) for path in sorted(folder.glob("*.jpg"))
    }
    assert len(images) == 10
    poses = estimate_poses(images, {}, [], tmp_path)
    assert len(poses.w2c) == len(poses.found_lenses) == 10
    assert poses.mean_error_px <= 0.35
    for lens in poses.found_lenses.values():
        assert 0.5 < lens.focal / max(lens.width, lens.height) < 5


@pytest.mark.slow
def test_the_same_images_give_the_same_bits(capture: Capture, solved: Poses, tmp_path: Path) -> None:
    again = estimate_poses(capture.static, capture.lenses, capture.sweep, tmp_path)
    for camera in capture.w2c:
        np.testing.assert_array_equal(again.w2c[camera], solved.w2c[camera])
    np.testing.assert_array_equal(again.points, solved.points)


@pytest.mark.slow
def test_a_camera_without_matches_is_named(capture: Capture, tmp_path: Path) -> None:
    blank = np.full((HEIGHT, WIDTH, 3), 127, np.uint8)
    with pytest.raises(SplashbenchError, match="no pose for camera 3;"):
        estimate_poses(capture.static | {"3": blank}, capture.lenses, capture.sweep, tmp_path)


def test_colmap_says_nothing_and_the_error_speaks_of_what_there_is(
    capture: Capture, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """COLMAP reports a pair that it cannot begin with as an error of its own."""
    rng = np.random.default_rng(0)
    noise = {camera: rng.integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8) for camera in "12"}
    with pytest.raises(SplashbenchError, match=r"^static scene: no pose for camera 1, 2; .*film a hand-held \[sweep\]"):
        estimate_poses(noise, {}, [], tmp_path)
    told = "".join(capfd.readouterr())
    assert ".cc:" not in told


def test_a_board_lying_face_down_is_refused(capture: Capture, solved: Poses) -> None:
    sightings = board_sightings(capture, solved, np.random.default_rng(0))
    mirrored = [
        Sighting(BoardView(s.view.ids, s.view.points, s.view.pixels[_mirrored_order()]), s.lens, s.w2c)
        for s in sightings
    ]
    with pytest.raises(SplashbenchError, match="below the board"):
        align(mirrored, BoardDetector(BOARD))
    # Where only its size is of interest, it may face anywhere.
    size = align_print(mirrored, Print.of_board(BoardDetector(BOARD)), upright=False)
    assert size.scene_from_sfm.scale == pytest.approx(align(sightings, BoardDetector(BOARD)).scene_from_sfm.scale)


def _mirrored_order() -> np.ndarray:
    """Corner numbers of the 7 x 4 grid with each row reversed: the print as seen from behind."""
    return np.arange(28).reshape(4, 7)[:, ::-1].ravel()


def test_a_board_seen_once_gives_no_metres(capture: Capture, solved: Poses) -> None:
    sightings = board_sightings(capture, solved, np.random.default_rng(0))
    with pytest.raises(SplashbenchError, match="0 corners of the board are seen twice"):
        align(sightings[:1], BoardDetector(BOARD))


def test_one_misread_corner_does_not_bend_the_frame(capture: Capture, solved: Poses) -> None:
    sightings = board_sightings(capture, solved, np.random.default_rng(0))
    clean = align(sightings, BoardDetector(BOARD))
    sightings[0].view.pixels[5] += [12.0, -9.0]
    spoiled = align(sightings, BoardDetector(BOARD))
    assert spoiled.n_corners == 27
    assert abs(spoiled.scene_from_sfm.scale / clean.scene_from_sfm.scale - 1) < 0.001

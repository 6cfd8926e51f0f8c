"""What gives a scene its metres and its up, and what is said where nothing does."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from splashbench.alignment import Similarity
from splashbench.errors import SplashbenchError
from splashbench.prepare.calibration.board import BoardDetector, BoardView
from splashbench.prepare.calibration.lens import Lens
from splashbench.prepare.calibration.marker import MarkerDetector
from splashbench.prepare.poses import rig
from splashbench.prepare.poses.metric import MetricFrame, Print, Sighting, agreeing, align_print, is_seen_twice
from splashbench.prepare.poses.scale import SceneFrame, Upright, choose_frame, distance_scale, rescaled, scene_frame
from splashbench.prepare.poses.structure_from_motion import Poses
from splashbench.prepare.session_tables import Board, Distance, Marker
from splashbench.scene import look_at

WIDTH, HEIGHT = 1200, 800
SIDE = 0.12
MARKER = Marker(dictionary="DICT_4X4_50", id=30, metres=SIDE)
BOARD = Board(squares_x=8, squares_y=5, square_metres=0.05, marker_metres=0.0375, dictionary="DICT_4X4_50")
LENS = Lens(WIDTH, HEIGHT, np.array([[1100.0, 0, 610], [0, 1104, 395], [0, 0, 1]]), np.zeros(5))
# The frame of structure from motion: metres turned, shifted and 2.7 times as large.
SFM = Similarity(2.7, cv2.Rodrigues(np.array([0.5, -1.1, 0.3]))[0], np.array([0.4, -2.0, 1.0]))
AZIMUTHS = {"1": -35, "2": -5, "3": 20, "4": 45}


def look(azimuth: float) -> np.ndarray:
    """World-to-camera of a camera one metre from the origin, 30 degrees above the table, metres and y up."""
    a, e = np.radians([azimuth, 30])
    eye = np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
    return look_at(eye)


TRUE = {camera: look(azimuth) for camera, azimuth in AZIMUTHS.items()}


def found() -> Poses:
    """Poses without error, in the frame of structure from motion."""
    return Poses(
        w2c={camera: SFM.apply_w2c(w2c) for camera, w2c in TRUE.items()},
        sweep_w2c=np.zeros((0, 4, 4)),
        sweep_indices=(),
        sweep_lens=LENS,
        n_sweep=0,
        points=np.zeros((0, 3)),
        colours=np.zeros((0, 3)),
        mean_error_px=0.0,
        rms_error_px=0.0,
        n_observations=0,
    )


@lru_cache(maxsize=1)
def rays() -> np.ndarray:
    """Where the lens's pixels look: [H * W, 3]."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    normalised = LENS.normalise(np.stack([columns + 0.5, rows + 0.5], -1).reshape(-1, 2))
    return np.column_stack([normalised, np.ones(len(normalised))])


def photograph(texture: np.ndarray, corner: np.ndarray, along: np.ndarray, across: np.ndarray, w2c) -> np.ndarray:
    """A print, and nothing else, as a camera sees it: grey [H, W] as RGB; corner [3] and edges [3] in metres."""
    camera = np.stack([w2c[:3, :3] @ along, w2c[:3, :3] @ across, w2c[:3, :3] @ corner + w2c[:3, 3]], axis=1)
    plane = rays() @ np.linalg.inv(camera).T
    height, width = texture.shape
    maps = (plane[:, :2] / plane[:, 2:] * [width, height] - 0.5).reshape(HEIGHT, WIDTH, 2).astype(np.float32)
    grey = cv2.remap(texture, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=200)
    return cv2.cvtColor(cv2.GaussianBlur(grey, (0, 0), 0.7), cv2.COLOR_GRAY2RGB)


def marker_pictures(number: int = 30) -> dict[str, np.ndarray]:
    """The marker with a white edge, lying on the table about (0.1, 0, 0.05)."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    texture = np.pad(dictionary.generateImageMarker(number, 240), 40, constant_values=255)
    edge = SIDE * 320 / 240
    corner = np.array([0.1 - edge / 2, 0.0, 0.05 - edge / 2])
    along, across = np.array([edge, 0.0, 0.0]), np.array([0.0, 0.0, edge])
    return {camera: photograph(texture, corner, along, across, w2c) for camera, w2c in TRUE.items()}


@pytest.fixture(scope="module")
def pictures() -> dict[str, np.ndarray]:
    return marker_pictures()


def session(marker: Marker | None = None, distance: Distance | None = None):
    return SimpleNamespace(marker=marker, distance=distance)


LENSES = dict.fromkeys(TRUE, LENS)


def find_frame(images: dict[str, np.ndarray], described) -> SceneFrame:
    """The scene frame from pictures of the fixed cameras."""
    detector = BoardDetector(BOARD)
    return rig.find_frame(rig.sight_prints(images, [], LENSES, found(), described, detector), described, detector)


def test_a_marker_alone_gives_metres_up_and_origin(pictures: dict[str, np.ndarray]) -> None:
    frame = find_frame(pictures, session(MARKER))
    assert (frame.scale_source, frame.up_source) == ("marker", "marker")
    similarity = frame.scene_from_sfm
    assert similarity.scale * SFM.scale == pytest.approx(1, abs=0.002)
    up = similarity.rotation @ SFM.rotation @ [0.0, 1.0, 0.0]
    assert np.degrees(np.arccos(up[1])) < 0.2
    origin = similarity.apply(SFM.apply(np.array([[0.1, 0.0, 0.05]])))
    assert np.abs(origin).max() < 0.0005
    assert frame.marker is not None
    assert frame.marker.n_corners == 4
    assert frame.scale_disagreement is None


def test_the_marker_is_found_to_a_fraction_of_a_pixel(pictures: dict[str, np.ndarray]) -> None:
    detector = MarkerDetector(MARKER)
    world = np.array([0.1, 0.0, 0.05]) + Print.of_marker(detector).scene_points(range(4))
    for camera, image in pictures.items():
        expected = LENS.project(world @ TRUE[camera][:3, :3].T + TRUE[camera][:3, 3])
        for zoom in (1, 2):  # small images are enlarged before the marker is sought
            small = cv2.resize(image, None, fx=1 / zoom, fy=1 / zoom, interpolation=cv2.INTER_AREA)
            view = detector.detect(small)
            assert view is not None
            assert np.abs(view.pixels * zoom - expected).max() < 0.2 * zoom


def test_a_false_marker_in_one_image_changes_nothing(pictures: dict[str, np.ndarray]) -> None:
    wanted = MarkerDetector(MARKER)
    views = {camera: wanted.detect(image) for camera, image in pictures.items()}
    sightings = [Sighting(views[c], LENS, w2c) for c, w2c in found().w2c.items() if views[c] is not None]
    assert len(sightings) == 4
    false = BoardView(np.arange(4), wanted.corners, sightings[1].view.pixels + np.array([150.0, -80.0]))
    spoiled = [sightings[0], replace(sightings[1], view=false), *sightings[2:]]
    assert agreeing(spoiled) == [sightings[0], *sightings[2:]]
    assert agreeing(sightings) == sightings


def test_a_marker_seen_once_is_said_so(pictures: dict[str, np.ndarray]) -> None:
    blank = {camera: np.full_like(image, 200) for camera, image in pictures.items()} | {"1": pictures["1"]}
    with pytest.raises(SplashbenchError, match=r"0 corners of the marker are seen twice, 4 are needed"):
        find_frame(blank, session(MARKER))


def test_another_marker_is_not_taken_for_the_one_described() -> None:
    wanted = MarkerDetector(MARKER)
    assert all(wanted.detect(image) is None for image in marker_pictures(31).values())


def test_a_marker_that_the_dictionary_lacks_is_refused() -> None:
    with pytest.raises(SplashbenchError, match=r"DICT_4X4_50 has no marker 50; its numbers are 0 to 49"):
        MarkerDetector(replace_id(50))
    with pytest.raises(SplashbenchError, match="unknown marker dictionary 'DICT_NO'"):
        MarkerDetector(Marker(dictionary="DICT_NO", id=1, metres=0.1))


def replace_id(number: int) -> Marker:
    return Marker(dictionary="DICT_4X4_50", id=number, metres=SIDE)


def printed_frame(scale_error: float = 0.0) -> MetricFrame:
    """What a print flat at the world's origin gives, its scale wrong by a share."""
    inverse = Similarity(1 / SFM.scale, SFM.rotation.T, -SFM.rotation.T @ SFM.translation / SFM.scale)
    similarity = rescaled(inverse, inverse.scale * (1 + scale_error))
    return MetricFrame(similarity, 0.0003, 20, 5, 0.4, np.zeros((20, 3)), scale_sigma=0.0004)


def test_the_distance_between_two_cameras_gives_metres() -> None:
    poses = found()
    apart = float(np.linalg.norm(np.linalg.inv(TRUE["1"])[:3, 3] - np.linalg.inv(TRUE["4"])[:3, 3]))
    scale = distance_scale(poses, ("1", "4"), apart)
    assert scale == pytest.approx(1 / SFM.scale, rel=1e-9)
    frame = choose_frame(None, None, scale, Upright(SFM.rotation @ [0.0, 3.0, 0.0], SFM.apply(np.zeros((1, 3)))[0]))
    assert (frame.scale_source, frame.up_source) == ("distance", "container")
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.25, 0.0], [0.3, 0.1, -0.2]])
    mapped = frame.scene_from_sfm.apply(SFM.apply(points))
    np.testing.assert_allclose(mapped[0], 0, atol=1e-9)
    np.testing.assert_allclose(mapped[1], [0, 0.25, 0], atol=1e-9)
    assert mapped[2, 1] == pytest.approx(0.1)
    assert np.hypot(mapped[2, 0], mapped[2, 2]) == pytest.approx(np.hypot(0.3, 0.2))


def test_the_board_comes_before_the_distance_and_both_are_kept() -> None:
    frame = choose_frame(printed_frame(), None, 1.02 / SFM.scale)
    assert (frame.scale_source, frame.up_source) == ("board", "board")
    assert frame.scene_from_sfm.scale == pytest.approx(1 / SFM.scale)
    assert frame.scales == pytest.approx({"board": 1 / SFM.scale, "distance": 1.02 / SFM.scale})
    assert frame.scale_disagreement == pytest.approx(0.02, rel=0.03)
    assert frame.scale_sigma == {"board": 0.0004}


def test_the_marker_gives_up_and_the_board_metres() -> None:
    marker = printed_frame(scale_error=0.01)
    frame = choose_frame(printed_frame(), marker, None)
    assert (frame.scale_source, frame.up_source) == ("board", "marker")
    # The marker's origin and axes, with the board's metres.
    origin = np.linalg.solve(marker.scene_from_sfm.rotation, -marker.scene_from_sfm.translation)
    origin /= marker.scene_from_sfm.scale
    np.testing.assert_allclose(frame.scene_from_sfm.apply(origin[None]), 0, atol=1e-12)
    assert frame.scene_from_sfm.scale == pytest.approx(1 / SFM.scale)


def test_nothing_for_up_and_nothing_for_metres_are_one_line_each() -> None:
    with pytest.raises(SplashbenchError, match=r"nothing gives the scene its up; lay the board flat"):
        choose_frame(None, None, 0.3)
    upright = Upright(np.array([0.0, 1.0, 0.0]), np.zeros(3))
    with pytest.raises(SplashbenchError, match=r"nothing gives the scene its metres; .*\[distance\]"):
        choose_frame(None, None, None, upright)


def test_a_container_of_known_size_gives_metres_where_nothing_else_does() -> None:
    upright = Upright(SFM.rotation @ [0.0, 3.0, 0.0], SFM.apply(np.zeros((1, 3)))[0], 1 / SFM.scale)
    frame = choose_frame(None, None, None, upright)
    assert (frame.scale_source, frame.up_source) == ("container", "container")
    assert frame.scene_from_sfm.scale * SFM.scale == pytest.approx(1)
    both = choose_frame(None, None, 1.02 / SFM.scale, upright)
    assert both.scale_source == "distance"
    assert both.scale_disagreement == pytest.approx(0.02, abs=1e-6)


def test_a_board_on_the_wall_gives_metres_where_a_marker_gives_up(pictures: dict[str, np.ndarray]) -> None:
    # Its print points at the cameras, so as a board lying flat it would turn the scene by a right angle.
    detector = BoardDetector(BOARD)
    texture = detector.board.generateImage((800, 500), marginSize=0, borderBits=1)
    corner, along, across = np.array([-0.2, 0.24, -0.25]), np.array([0.4, 0, 0]), np.array([0, -0.25, 0])
    both = {}
    for camera, w2c in TRUE.items():
        wall = photograph(texture, corner, along, across, w2c)
        both[camera] = np.minimum(wall, pictures[camera])
    frame = find_frame(both, session(MARKER))
    assert (frame.scale_source, frame.up_source) == ("board", "marker")
    assert frame.scene_from_sfm.scale * SFM.scale == pytest.approx(1, abs=0.001)
    assert (frame.scene_from_sfm.rotation @ SFM.rotation @ [0.0, 1.0, 0.0])[1] > 0.9999
    assert frame.scale_disagreement is not None
    assert frame.scale_disagreement < 0.003


def test_the_scale_sigma_of_a_print_is_the_scatter_of_its_scale() -> None:
    rng = np.random.default_rng(0)
    detector = BoardDetector(BOARD)
    flat = Print.of_board(detector)
    world = flat.scene_points(range(len(flat.corners)))
    scales, sigmas = [], []
    for _ in range(60):
        sightings = []
        for camera, w2c in found().w2c.items():
            local = world @ TRUE[camera][:3, :3].T + TRUE[camera][:3, 3]
            pixels = LENS.project(local) + rng.normal(0, 0.3, (len(world), 2))
            sightings.append(Sighting(BoardView(np.arange(len(world)), flat.corners, pixels), LENS, w2c))
        frame = align_print(sightings, flat)
        scales.append(frame.scene_from_sfm.scale * SFM.scale)
        sigmas.append(frame.scale_sigma)
    assert np.mean(scales) == pytest.approx(1, abs=2e-4)
    assert np.std(scales) == pytest.approx(np.mean(sigmas), rel=0.25)


def test_corners_of_one_line_do_not_say_how_the_board_lies() -> None:
    """Seven are more than enough, but they leave open how it is turned about their line."""
    detector = BoardDetector(BOARD)
    flat = Print.of_board(detector)
    world = flat.scene_points(range(len(flat.corners)))
    row = flat.corners[:, 1]
    first, second = (np.unique(row)[:2], np.unique(row)[1:3])  # what each camera sees; the second row is common

    def sighting(camera: str, ids: np.ndarray) -> Sighting:
        local = world[ids] @ TRUE[camera][:3, :3].T + TRUE[camera][:3, 3]
        return Sighting(BoardView(ids, flat.corners[ids], LENS.project(local)), LENS, found().w2c[camera])

    sightings = [sighting(c, np.flatnonzero(np.isin(row, rows))) for c, rows in (("1", first), ("2", second))]
    assert not is_seen_twice(sightings, flat)
    with pytest.raises(SplashbenchError, match=r"7 corners of the board are seen twice, all on one line, 6 are needed"):
        align_print(sightings, flat)
    whole = [sighting(camera, np.arange(len(world))) for camera in "12"]
    assert is_seen_twice(whole, flat)
    assert align_print(whole, flat).n_corners == len(world)


def test_a_frame_needs_a_direction() -> None:
    with pytest.raises(ValueError, match="up has no direction"):
        scene_frame(Upright(np.zeros(3), np.zeros(3)), 1.0)


def test_up_becomes_y_and_the_frame_is_right_handed() -> None:
    frame = scene_frame(Upright(np.array([1.0, 0.0, 2.0]), np.zeros(3)), 2.0)
    np.testing.assert_allclose(frame.rotation @ np.array([1, 0, 2]) / np.sqrt(5), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(frame.rotation @ frame.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame.rotation) == pytest.approx(1)

"""Cameras placed by a board that several of them see at once, against exact truth."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splashbench.errors import SplashbenchError
from splashbench.files import write_png
from splashbench.prepare.calibration.board import BoardDetector, BoardView
from splashbench.prepare.calibration.lens import Lens
from splashbench.prepare.poses.board_rig import board_poses
from splashbench.prepare.poses.board_sightings import _at_instants, shared_sightings
from splashbench.prepare.poses.structure_from_motion import Poses
from splashbench.prepare.session_tables import Board
from splashbench.prepare.video.recording import Recording
from splashbench.prepare.video.stills import Stills
from splashbench.scene import look_at

BOARD = Board(squares_x=8, squares_y=5, square_metres=0.05, marker_metres=0.0375, dictionary="DICT_4X4_50")
CORNERS = BoardDetector(BOARD).corners
SIZE = (1280, 720)
NOISE_PX = 0.2


@dataclass
class Rig:
    lenses: dict[str, Lens]
    w2c: dict[str, np.ndarray]
    boards: list[np.ndarray]  # board to world

    def sightings(self, rng: np.random.Generator, noise: float = NOISE_PX) -> dict[str, list[BoardView | None]]:
        return {camera: [self._view(camera, board, rng, noise) for board in self.boards] for camera in self.w2c}

    def _view(self, camera: str, board: np.ndarray, rng: np.random.Generator, noise: float) -> BoardView | None:
        local_to_camera = self.w2c[camera] @ board
        points = np.column_stack([CORNERS, np.zeros(len(CORNERS))]) @ local_to_camera[:3, :3].T + local_to_camera[:3, 3]
        facing = -local_to_camera[:3, 2] @ points.mean(0) / np.linalg.norm(points.mean(0))
        pixels = self.lenses[camera].project(points) + rng.normal(0, noise, (len(points), 2))
        seen = (pixels > 0).all(1) & (pixels < SIZE).all(1) & (points[:, 2] > 0.2)
        if facing > -0.2 or seen.sum() < 8:  # the print's z points away from whoever reads it
            return None
        return BoardView(np.flatnonzero(seen), CORNERS[seen], pixels[seen])


def rig(n_cameras: int = 6, arc_degrees: float = 250.0, instants: int = 60, seed: int = 0) -> Rig:
    """Cameras on a wide arc two metres from the middle: no board is seen by all of them."""
    rng = np.random.default_rng(seed)
    lenses, w2c = {}, {}
    for k, angle in enumerate(np.radians(np.linspace(0, arc_degrees, n_cameras))):
        focal = rng.uniform(900, 1000)
        K = np.array([[focal, 0, 640 + rng.normal(0, 5)], [0, focal, 360 + rng.normal(0, 5)], [0, 0, 1]])
        lenses[str(k + 1)] = Lens(*SIZE, K, np.array([-0.1, 0.03, 1e-4, -2e-4, 0.0]))
        w2c[str(k + 1)] = look_at(np.array([2 * np.sin(angle), 1.0, 2 * np.cos(angle)]), (0.0, 0.3, 0.0))
    boards = []
    for k in range(instants):
        board = np.eye(4)
        turn = Rotation.from_rotvec([0, np.radians(arc_degrees) * k / instants, 0])
        tilt = Rotation.from_rotvec(rng.normal(0, 0.5, 3))
        upright = Rotation.from_matrix(np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1.0]]))  # x right, y down, z inwards
        board[:3, :3] = (turn * tilt * upright).as_matrix()
        board[:3, 3] = rng.uniform([-0.5, 0.1, -0.5], [0.5, 0.8, 0.5]) - board[:3, :3] @ [0.2, 0.12, 0]
        boards.append(board)
    return Rig(lenses, w2c, boards)


def errors(found: Poses, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the centres (metres) and turns (degrees) [C], after the rigid motion that removes most; no scaling."""
    names = list(rig.w2c)
    actual, wanted = (np.array([-w2c[n][:3, :3].T @ w2c[n][:3, 3] for n in names]) for w2c in (found.w2c, rig.w2c))
    turn, _ = Rotation.align_vectors(wanted - wanted.mean(0), actual - actual.mean(0))
    moved = turn.apply(actual - actual.mean(0)) + wanted.mean(0)
    turns = [
        Rotation.from_matrix(found.w2c[n][:3, :3] @ turn.as_matrix().T @ rig.w2c[n][:3, :3].T).magnitude()
        for n in names
    ]
    return np.linalg.norm(moved - wanted, axis=1), np.degrees(turns)


def test_cameras_come_out_where_they_stand_in_metres() -> None:
    """The goal that caliscope sets itself: 5 mm and half a degree at half a pixel of noise."""
    truth = rig()
    found = board_poses(truth.sightings(np.random.default_rng(1), 0.5), truth.lenses)
    centres, turns = errors(found, truth)
    print(f"largest error {centres.max() * 1e3:.2f} mm, {turns.max():.3f} degrees; {found.mean_error_px:.3f} px")
    assert found.metres_per_unit == 1.0
    assert centres.max() < 5e-3
    assert turns.max() < 0.2
    exact = board_poses(truth.sightings(np.random.default_rng(1), 1e-6), truth.lenses)
    assert errors(exact, truth)[0].max() < 1e-7
    np.testing.assert_allclose(exact.w2c["1"], np.eye(4), atol=1e-12)


@pytest.mark.slow
def test_misread_boards_do_not_bend_the_rig() -> None:
    truth = rig()
    sightings = truth.sightings(np.random.default_rng(2))
    clean = errors(board_poses(sightings, truth.lenses), truth)[0].max()
    rng = np.random.default_rng(3)
    for views in sightings.values():
        for k in rng.choice(len(views), 6, replace=False):
            view = views[k]
            if view is not None:
                view.pixels[:] = (
                    view.pixels.mean(0)
                    + (view.pixels - view.pixels.mean(0)) @ np.array([[0.7, 0.4], [-0.3, 1.1]])
                    + rng.uniform(-60, 60, 2)
                )
    spoiled = board_poses(sightings, truth.lenses)
    assert errors(spoiled, truth)[0].max() < 2 * clean + 1e-3


def test_a_camera_that_shares_no_board_is_named() -> None:
    truth = rig()
    sightings = truth.sightings(np.random.default_rng(1))
    others = [camera for camera in truth.w2c if camera != "4"]
    for k in range(len(truth.boards)):
        if any(sightings[camera][k] is not None for camera in others):
            sightings["4"][k] = None
    with pytest.raises(SplashbenchError, match=r"\[recordings\.extrinsics\]: camera 4 and the others see the board"):
        board_poses(sightings, truth.lenses)


def test_the_first_camera_is_named_where_it_saw_nothing() -> None:
    truth = rig()
    sightings = truth.sightings(np.random.default_rng(1)) | {"1": [None] * len(truth.boards)}
    with pytest.raises(SplashbenchError, match=r"camera 1 and the others see the board"):
        board_poses(sightings, truth.lenses)


@pytest.mark.slow
def test_cameras_joined_by_misread_boards_alone_are_refused() -> None:
    truth = rig(4, 60.0, 30)
    sightings = truth.sightings(np.random.default_rng(3))
    for k in range(30):
        for camera in ("1", "2") if k % 2 else ("3", "4"):
            if k < 26:
                sightings[camera][k] = None
        for camera in ("3", "4"):
            view = sightings[camera][k]
            if k >= 26 and view is not None:
                middle = view.pixels.mean(0)
                view.pixels[:] = middle + (view.pixels - middle) @ np.array([[0.6, 0.4], [-0.3, 1.2]])
    with pytest.raises(SplashbenchError, match=r"camera 3, 4 and the others see the board"):
        board_poses(sightings, truth.lenses)


def test_boards_that_are_all_misread_end_in_one_line() -> None:
    truth = rig(2, 40.0, 6)
    rng = np.random.default_rng(4)
    sightings = truth.sightings(rng)
    for view in (view for views in sightings.values() for view in views if view is not None):
        if rng.random() < 0.5:
            middle = view.pixels.mean(0)
            view.pixels[:] = middle + (view.pixels - middle) @ rng.normal(0, 1, (2, 2)) + rng.uniform(-99, 99, 2)
    with pytest.raises(SplashbenchError, match="fewer than 3 instants"):
        board_poses(sightings, truth.lenses)


def test_lenses_that_were_not_determined_leave_the_deviations_open() -> None:
    truth = rig()
    found = board_poses(truth.sightings(np.random.default_rng(1)), truth.lenses, {"2": np.diag([np.inf] * 9)})
    assert found.centre_sigma == found.feature_centre_sigma == {}


def draws(truth: Rig, covariance: np.ndarray | None, count: int = 25) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """RMS errors of the centres over repeated noise (and lenses), what was predicted, and by the corners alone; [C]."""
    rng = np.random.default_rng(6)
    squares, total, corners = [], [], []
    for _ in range(count):
        lenses = dict(truth.lenses)
        if covariance is not None:
            root = np.linalg.cholesky(covariance + 1e-18 * np.eye(9))
            lenses = {camera: off_by(lens, root @ rng.normal(0, 1, 9)) for camera, lens in lenses.items()}
        known: Mapping[str, np.ndarray] = {} if covariance is None else dict.fromkeys(lenses, covariance)
        found = board_poses(truth.sightings(rng), lenses, known)
        squares.append(errors(found, truth)[0] ** 2)
        total.append(values(found.centre_sigma))
        corners.append(values(found.feature_centre_sigma))
    return np.sqrt(np.mean(squares, 0)), np.mean(total, 0), np.mean(corners, 0)


def values(figures: Mapping[str, float]) -> Sequence[float]:
    return list(figures.values())


def off_by(lens: Lens, error: np.ndarray) -> Lens:
    K = lens.K.copy()
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = K[0, 0] + error[0], K[1, 1] + error[1], K[0, 2] + error[2], K[1, 2] + error[3]
    return Lens(lens.width, lens.height, K, lens.distortion + error[4:])


@pytest.mark.slow
@pytest.mark.parametrize("lenses_err", [False, True])
def test_deviations_are_those_of_repeated_noise(lenses_err: bool) -> None:
    sigmas = np.array([1.5, 1.5, 1.5, 1.5, 1e-3, 1e-3, 1e-4, 1e-4, 0.0])
    actual, total, corners = draws(rig(instants=40), np.diag(sigmas**2) if lenses_err else None)
    print(actual * 1e3, total * 1e3, corners * 1e3)
    # Here one rigid motion is fitted to the centres alone, in the prediction to centres and turns.
    np.testing.assert_allclose(actual, total, rtol=0.4)
    assert np.sqrt(np.mean(actual**2) / np.mean(total**2)) == pytest.approx(1, abs=0.2)
    if lenses_err:
        assert np.mean(actual) > 2 * np.mean(corners)


class Film(Recording):
    """A camera's video of a board that moves steadily, as views per frame; nothing is decoded."""

    def __init__(self, views: list[BoardView | None]) -> None:
        self.views = views

    info = property(lambda self: SimpleNamespace(width=SIZE[0]))  # type: ignore[assignment]

    def frames(self, indices: Iterable[int] | None = None) -> Iterator[tuple[int, np.ndarray]]:
        yield from ((k, np.full((1, 1), k)) for k in sorted(indices or ()))


def moving(speed_px: float, count: int = 5) -> list[BoardView | None]:
    start = CORNERS * 1000 + 100
    return [BoardView(np.arange(len(CORNERS)), CORNERS, start + np.array([speed_px * k, 0])) for k in range(count)]


def test_a_moving_board_is_taken_where_it_was_at_the_instant() -> None:
    views = moving(8.0)
    views[3] = None
    finder = SimpleNamespace(detect_true=lambda image: views[int(image[0, 0])])
    times = 10 + np.arange(5) / 30
    instants = np.array([9.9, 10 + 0.25 / 30, 10 + 1.5 / 30, 10 + 2.5 / 30, 11.0])
    found = _at_instants(Film(views), times, instants, finder)  # type: ignore[arg-type]
    assert [view is None for view in found] == [True, False, False, True, True]
    for view, frames in zip(found[1:3], (0.25, 1.5)):
        assert view is not None
        np.testing.assert_allclose(view.pixels, CORNERS * 1000 + 100 + [8.0 * frames, 0], atol=1e-6)
    fast = moving(14.0)  # more than a hundredth of the width from frame to frame
    finder = SimpleNamespace(detect_true=lambda image: fast[int(image[0, 0])])
    assert _at_instants(Film(fast), times, instants[1:2], finder) == [None]  # type: ignore[arg-type]


def test_photographs_must_be_as_many_for_every_camera(tmp_path: Path) -> None:
    for camera, count in (("1", 3), ("2", 2)):
        for k in range(count):
            write_png(tmp_path / camera / f"{k}.png", np.zeros((90, 160, 3), np.uint8))
    stills = {camera: Stills([tmp_path / camera]) for camera in "12"}
    with pytest.raises(SplashbenchError, match=r"2 holds 2 photographs, that of camera 1 3; .*belong together"):
        shared_sightings(stills, BoardDetector(BOARD), "1")
    mixed = {"1": stills["1"], "2": Recording([tmp_path / "2.mp4"])}
    with pytest.raises(SplashbenchError, match="give all cameras the one or the other"):
        shared_sightings(mixed, BoardDetector(BOARD), "1")

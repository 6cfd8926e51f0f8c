"""Masks that are empty, full, cut or of another time: the hull must stay right, or one line must say why not."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.observe import Silhouettes, distrust_failed_masks, sequence_bounds, signed_distance_fields
from splashbench.observe.failures import missing_shares
from splashbench.observe.mask_distance import blended, signed_distance_2d
from splashbench.scene import Camera, Scene, look_at

FOCAL, WIDTH, HEIGHT = 260.0, 160, 120


def camera_at(name: str, angle: float) -> Camera:
    eye = np.array([2.5 * np.cos(angle), 0.8, 2.5 * np.sin(angle)])
    return Camera(name, WIDTH, HEIGHT, np.array([[FOCAL, 0, 80], [0, FOCAL, 60], [0, 0, 1]]), look_at(eye))


class MovingBall:
    """A ball of radius 0.2 that crosses the view along z within `n_frames` seconds, from `views` cameras on an arc."""

    name = "moving_ball"
    SPEED = 0.08

    def __init__(self, views: int = 5, n_frames: int = 9) -> None:
        self.cameras = {str(i): camera_at(str(i), angle) for i, angle in enumerate(np.linspace(-0.7, 0.7, views))}
        self.train = tuple(self.cameras)
        self.n_frames = n_frames
        self.times = np.arange(n_frames, dtype=float)
        self.camera_times = dict.fromkeys(self.train, self.times)
        self.changed: dict[tuple[str, int], str] = {}

    def centre(self, time: float) -> np.ndarray:
        return np.array([0.0, 0.0, self.SPEED * (time - (self.n_frames - 1) / 2)])

    def mask(self, camera: str, t: int) -> np.ndarray:
        view = self.cameras[camera]
        rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        rays = np.stack([(columns - 80) / FOCAL, (rows - 60) / FOCAL, np.ones_like(rows)], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        centre = view.w2c[:3, :3] @ self.centre(self.camera_times[camera][t]) + view.w2c[:3, 3]
        mask = centre @ centre - (rays @ centre) ** 2 < 0.2**2
        change = self.changed.get((camera, t), "")
        if change == "empty":
            mask[:] = False
        elif change == "full":
            mask[:] = True
        elif change == "cut":
            mask[int(np.quantile(np.nonzero(mask)[0], 0.6)) :] = False
        return mask


def inside(scene: MovingBall, fields, t: int) -> float:
    """Share of the ball that the hull of frame `t` holds."""
    grid = np.moveaxis(np.indices((21, 21, 21)), 0, -1).reshape(-1, 3) / 10 - 1.0
    ball = grid[np.linalg.norm(grid, axis=1) < 0.95] * 0.2 + scene.centre(scene.times[t])
    return float((fields.sample(t, ball) < 0).mean())


def test_a_cut_mask_is_found_and_replaced_and_no_other() -> None:
    scene = MovingBall()
    clean = Silhouettes(scene)
    assert not distrust_failed_masks(clean).any()
    scene.changed = {("1", 4): "cut", ("3", 6): "cut"}
    silhouettes = Silhouettes(scene)
    found = distrust_failed_masks(silhouettes)
    assert sorted(map(tuple, np.argwhere(found).tolist())) == [(4, 1), (6, 3)]
    assert silhouettes.failed(4) == ["1"]
    anew = Silhouettes(scene)
    assert (missing_shares(anew, None, sequence_bounds(anew))[[4, 6], [1, 3]] > 0.2).all()
    # The frames before and after stand in, and the ball is whole again.
    replaced = silhouettes.evidence_mask(1, 4)
    whole = clean.mask(1, 4)
    assert replaced[whole].mean() > 0.97
    assert replaced.sum() < 1.6 * whole.sum()


def test_a_cut_mask_costs_liquid_only_until_it_is_found() -> None:
    scene = MovingBall()
    scene.changed = {("1", 4): "cut"}
    cut = signed_distance_fields(scene, 40)
    assert inside(scene, cut, 4) < 0.75
    fixed = signed_distance_fields(scene, 40, detect_failed_masks=True)
    assert inside(scene, fixed, 4) > 0.99


def test_a_camera_that_never_sees_liquid_takes_nothing_away() -> None:
    scene = MovingBall()
    scene.changed = {("2", t): "empty" for t in range(scene.n_frames)}
    assert inside(scene, signed_distance_fields(scene, 32, detect_failed_masks=True), 4) > 0.99


def test_frames_without_liquid_stay_empty_between_others() -> None:
    scene = MovingBall()
    scene.changed = {(view, t): "empty" for view in scene.train for t in (0, 1, 5)}
    fields = signed_distance_fields(scene, 24, detect_failed_masks=True)
    assert [(phi < 0).any() for phi in fields.phi] == [False, False, True, True, True, False, True, True, True]


def test_no_liquid_at_all_is_one_line() -> None:
    scene = MovingBall(n_frames=2)
    scene.changed = {(view, t): "empty" for view in scene.train for t in range(2)}
    with pytest.raises(SplashbenchError, match="moving_ball: fewer than 2 training views have any liquid"):
        Silhouettes(scene)


def test_full_masks_everywhere_are_one_line_and_in_one_view_no_matter() -> None:
    scene = MovingBall(n_frames=3)
    scene.changed = {("0", t): "full" for t in range(3)}
    assert inside(scene, signed_distance_fields(scene, 24, detect_failed_masks=True), 1) > 0.99
    scene.changed = {(view, t): "full" for view in scene.train for t in range(3)}
    with pytest.raises(SplashbenchError, match="moving_ball: every liquid mask of the training views is full"):
        Silhouettes(scene)


def test_two_views_make_a_hull() -> None:
    scene = MovingBall(views=2)
    fields = signed_distance_fields(scene, 32, detect_failed_masks=True)
    assert min(inside(scene, fields, t) for t in range(scene.n_frames)) > 0.99


def test_an_empty_mask_of_one_of_two_views_blanks_no_frame() -> None:
    scene = MovingBall(views=2)
    scene.changed = {("1", 4): "empty"}
    silhouettes = Silhouettes(scene)
    assert silhouettes.failed(4) == ["1"]
    fields = signed_distance_fields(scene, 32)
    assert inside(scene, fields, 4) > 0.99
    # What the view saw just before and after stands in.
    assert (fields.phi[4] < 0).sum() < 1.7 * (fields.phi[3] < 0).sum()
    # Without frames on both sides nothing says that there was liquid, nor does one view's word alone.
    scene.changed = {("1", t): "empty" for t in (0, 1, 4)} | {("0", 4): "empty"}
    assert [Silhouettes(scene).has_liquid(t) for t in (0, 1, 2, 4)] == [False, False, True, False]
    kept = Silhouettes(scene, replace_empty=False)
    assert not kept.has_liquid(4)
    scene.changed = {("1", 4): "empty"}
    assert not Silhouettes(scene, replace_empty=False).has_liquid(4)


def test_a_camera_is_no_witness_of_times_before_it_started_and_after_it_stopped() -> None:
    scene = MovingBall()
    scene.camera_times["1"] = scene.times + 3.2
    scene.camera_times["3"] = scene.times - 0.9
    silhouettes = Silhouettes(scene)
    assert [silhouettes.trusted(1, t) for t in range(9)] == [False] * 3 + [True] * 6
    assert [silhouettes.trusted(3, t) for t in range(9)] == [True] * 8 + [False]
    assert silhouettes.inside(1, 0).all()
    assert (silhouettes.distance(1, 0) < 0).all()
    assert not silhouettes.inside(1, 3).all()
    fields = signed_distance_fields(scene, 40)
    assert min(inside(scene, fields, t) for t in range(9)) > 0.97
    # Of three cameras two are left, which is too few to do without the nearest mask of the third.
    scene = MovingBall(views=3)
    scene.camera_times["1"] = scene.times + 3.2
    assert all(Silhouettes(scene).trusted(1, t) for t in range(9))


def test_cameras_that_were_all_away_at_some_time_leave_the_box_as_small() -> None:
    """No view saw all of the ball's way, and every frame was seen by three of six at the least."""
    scene = MovingBall(views=6)
    for view, late in zip(scene.train, (2.0, -2.0, 1.0, -1.0, 2.0, -2.0)):
        scene.camera_times[view] = scene.times + late
    silhouettes = Silhouettes(scene)
    assert not silhouettes.all_there
    assert not any(all(silhouettes.trusted(view, t) for t in range(9)) for view in range(6))
    exact, found = sequence_bounds(MovingBall(views=6)), sequence_bounds(silhouettes)
    # In its first and last frames fewer views end the ball.
    assert (found.high - found.low < 1.6 * (exact.high - exact.low)).all()
    assert (found.low <= exact.low + 0.03).all()
    assert (found.high >= exact.high - 0.03).all()


def test_masks_between_which_a_time_lies_are_trusted_together() -> None:
    scene = MovingBall()
    scene.camera_times["1"] = scene.times + 0.4
    scene.changed = {("1", 4): "empty"}
    silhouettes = Silhouettes(scene)
    assert silhouettes.failed(4) == ["1"]
    # Frame 4 is at a time between the camera's frames 3 and 4, frame 5 between 4 and 5.
    assert [silhouettes.trusted(1, t) for t in (3, 4, 5, 6)] == [True, False, False, True]


def test_cameras_that_look_elsewhere_are_one_line() -> None:
    scene = MovingBall()
    silhouettes = Silhouettes(scene)
    back_to_front = np.diag([-1.0, 1, -1, 1])
    for number in (1, 3):
        camera = silhouettes.cameras[number]
        silhouettes.cameras[number] = Camera(camera.name, WIDTH, HEIGHT, camera.K, back_to_front @ camera.w2c)
    with pytest.raises(SplashbenchError, match="no common visual hull"):
        sequence_bounds(silhouettes)


def test_a_camera_on_a_clock_of_its_own_is_carved_with_at_the_scenes_times() -> None:
    scene = MovingBall()
    for i, view in enumerate(scene.train):
        scene.camera_times[view] = scene.times + (-0.3, 0.0, 0.3, 0.2, -0.2)[i]
    blind, aware = Silhouettes(scene, interpolate_times=False), Silhouettes(scene)
    exact = Silhouettes(MovingBall())
    for view in (0, 2):
        window = exact.windows[view].joined(blind.windows[view])
        true = exact.distance(view, 4, window)
        near = np.abs(true) < 3
        errors = [np.abs(one.distance(view, 4, window) - true)[near].mean() for one in (blind, aware)]
        assert errors[1] < 0.3 * errors[0]
    scene.camera_times = dict.fromkeys(scene.train, scene.times + 0.005)  # half a percent of a step
    np.testing.assert_array_equal(
        Silhouettes(scene).distance(0, 4), Silhouettes(scene, interpolate_times=False).distance(0, 4)
    )


def test_a_drop_that_moves_by_more_than_its_size_does_not_vanish_between_frames() -> None:
    rows, columns = np.mgrid[:60, :80]
    first, second = ((rows - 30) ** 2 + (columns - column) ** 2 < 16 for column in (20, 40))
    pool = rows > 50
    between = blended(signed_distance_2d(first | pool), signed_distance_2d(second | pool), 0.3)
    assert (between[first] < 0).mean() > 0.99
    assert (between[pool] < 0).all()


def test_masks_are_kept_as_bits() -> None:
    scene = MovingBall()
    scene.changed = {("0", 0): "full"}
    silhouettes = Silhouettes(scene)
    assert silhouettes.nbytes < scene.n_frames * 5 * WIDTH * HEIGHT / 8 + 1000
    np.testing.assert_array_equal(silhouettes.mask(0, 3), scene.mask("0", 3))


def test_what_is_inside_is_where_the_distance_is_below_zero(balls: Scene) -> None:
    """Of masks as they are, that failed, that are empty or full, and blended between two frames."""
    training = balls.training()
    silhouettes = Silhouettes(training)
    failed = np.zeros((training.n_frames, len(silhouettes.views)), dtype=bool)
    failed[2, 1] = failed[3, 0] = failed[0, 2] = True
    silhouettes.distrust(failed)
    silhouettes._packed[3][4][:] = 0
    silhouettes._packed[3][5][:] = 255
    silhouettes._between[4][1] = (1, 2, 0.4)
    for view in range(len(silhouettes.views)):
        for t in range(training.n_frames):
            np.testing.assert_array_equal(silhouettes.inside(view, t), silhouettes.distance(view, t) < 0)

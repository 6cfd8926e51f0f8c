"""Cameras that stand or look elsewhere than they are told are found by the points that views have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from splashbench.background.clean_plate import CleanPlate
from splashbench.scene import Camera
from splashbench.selfcalibration.cameras import FittedCameras, corrections, fit_cameras, typical_error
from splashbench.selfcalibration.features import Tracks, epipolar_distance, find_tracks

from .conftest import HALF, SIZE, WALL, photograph, plate_of, turned

Cameras = dict[str, Camera]


def misplaced(first: Camera, second: Camera) -> float:
    """How far apart in pixels two cameras see the same points above the table, typically."""
    grid = np.meshgrid(np.linspace(-0.7, 0.7, 7), np.linspace(0, 0.6, 3), np.linspace(-0.9, 0.7, 7))
    points = np.stack(grid, axis=-1).reshape(-1, 3)
    return float(np.median(np.linalg.norm(first.project(points)[0] - second.project(points)[0], axis=1)))


def with_intrinsics(camera: Camera, focal: float = 1.0, shift: float = 0.0) -> Camera:
    K = np.array(camera.K)
    K[[0, 1], [0, 1]] *= focal
    K[0, 2] += shift
    return replace(camera, K=K)


def moved(camera: Camera, away: float) -> Camera:
    w2c = np.array(camera.w2c)
    w2c[0, 3] += away
    return replace(camera, w2c=w2c)


def fitted(tracks: Tracks, told: Cameras) -> FittedCameras:
    found = fit_cameras(tracks, told)
    assert found is not None
    return found


def test_points_lie_where_right_cameras_see_them(tracks: Tracks, cameras: Cameras) -> None:
    assert tracks.views == tuple(cameras)
    assert len(tracks) > 500
    both = tracks.seen[:, 1] & tracks.seen[:, 2]
    away = epipolar_distance(cameras["2"], cameras["3"], tracks.pixels[both, 1], tracks.pixels[both, 2])
    assert np.median(np.abs(away)) < 0.1
    assert typical_error(tracks, cameras) < 0.08


def test_right_cameras_are_left_as_told(tracks: Tracks, cameras: Cameras) -> None:
    assert fit_cameras(tracks, cameras) is None


def test_a_turned_camera_is_found_and_the_others_stay(tracks: Tracks, cameras: Cameras) -> None:
    told = cameras | {"2": turned(cameras["2"], 0.5)}
    found = fitted(tracks, told)
    assert found.kinds == ("turned",)
    assert found.after < 0.15 * found.before
    degrees = {name: change.turned for name, change in corrections(found, told).items()}
    assert degrees.pop("2") == pytest.approx(0.5, abs=0.1)
    assert max(degrees.values()) < 0.1
    assert misplaced(found.cameras["2"], cameras["2"]) < 0.2 * misplaced(told["2"], cameras["2"])


@pytest.mark.parametrize(
    ("kind", "other", "share"),
    [
        ("shifted", lambda camera: with_intrinsics(camera, shift=3.0), 0.15),
        pytest.param("longer", lambda camera: with_intrinsics(camera, focal=1.03), 0.15, marks=pytest.mark.slow),
        # All cameras may have moved a little instead: what is found of one is about two thirds.
        pytest.param("moved", lambda camera: moved(camera, 0.03), 0.45, marks=pytest.mark.slow),
    ],
)
def test_what_is_wrong_with_a_camera_is_told_apart_and_undone(
    tracks: Tracks, cameras: Cameras, kind: str, other: Callable[[Camera], Camera], share: float
) -> None:
    told = cameras | {"4": other(cameras["4"])}
    found = fitted(tracks, told)
    assert found.kinds == (kind,)
    assert found.distortion == 0
    assert found.after < 0.15 * found.before
    injected = misplaced(told["4"], cameras["4"])
    assert injected > 1
    for name, camera in found.cameras.items():
        assert misplaced(camera, cameras[name]) < share * injected


def test_lenses_that_bend_are_found(cameras: Cameras) -> None:
    plates = {name: plate_of(camera, photograph(camera, k1=-0.2)) for name, camera in cameras.items()}
    found = fitted(find_tracks(plates, cameras), cameras)
    assert found.kinds == ("bent",)
    assert found.distortion == pytest.approx(-0.2, abs=0.02)
    for name, camera in found.cameras.items():
        assert misplaced(camera, cameras[name]) < 0.05


def sparse_points(rough: float = 0.0) -> NDArray[np.float64]:
    """Sparse points [4000, 3] on table and wall, `rough` scene units beside them."""
    rng = np.random.default_rng(5)
    across = rng.uniform(-HALF, HALF, (4000, 2))
    on_table = np.stack([across[:2000, 0], np.zeros(2000), np.maximum(across[:2000, 1], WALL)], axis=1)
    on_wall = np.stack([across[2000:, 0], np.abs(across[2000:, 1]), np.full(2000, WALL)], axis=1)
    return np.concatenate([on_table, on_wall]) + rng.normal(size=(4000, 3)) * rough


def all_turned(cameras: Cameras, degrees: float) -> Cameras:
    rng = np.random.default_rng(1)
    return {name: turned(camera, degrees, tuple(rng.normal(size=3))) for name, camera in cameras.items()}


@pytest.mark.parametrize("rough", [0.0, 0.01])
def test_where_all_cameras_turned_sparse_points_hold_the_world(
    plates: dict[str, CleanPlate], cameras: Cameras, rough: float
) -> None:
    """What cameras have in common is explained by other worlds, too."""
    told = all_turned(cameras, 2.0)
    tracks = find_tracks(plates, told)
    found = fit_cameras(tracks, told, lambda: sparse_points(rough), lambda given: find_tracks(plates, given))
    assert found is not None
    assert found.kinds == ("turned",)
    off = max(misplaced(camera, cameras[name]) for name, camera in found.cameras.items())
    injected = max(misplaced(camera, cameras[name]) for name, camera in told.items())
    assert injected > 5
    assert off < 0.02 * injected
    without = fitted(tracks, told)
    assert off < 0.5 * max(misplaced(camera, cameras[name]) for name, camera in without.cameras.items())


def same(first: FittedCameras | None, second: FittedCameras | None) -> bool:
    assert first is not None
    assert second is not None
    return all(np.array_equal(camera.w2c, second.cameras[name].w2c) for name, camera in first.cameras.items())


def test_sparse_points_of_another_place_are_not_believed(plates: dict[str, CleanPlate], cameras: Cameras) -> None:
    told = all_turned(cameras, 0.5)
    tracks = find_tracks(plates, told)
    without = fit_cameras(tracks, told)
    assert same(fit_cameras(tracks, told, lambda: 0.3 * sparse_points() + [0.2, 0.5, 0.1]), without)
    assert not same(fit_cameras(tracks, told, sparse_points), without)


def test_cameras_that_are_as_told_say_where_the_world_is_before_sparse_points_do(
    plates: dict[str, CleanPlate], cameras: Cameras
) -> None:
    """Points that lie beside their places by a little would turn all cameras with them."""
    told = cameras | {"2": turned(cameras["2"], 0.5)}
    tracks = find_tracks(plates, told)
    raised = fit_cameras(
        tracks, told, lambda: sparse_points() + np.array([0, 0.02, 0]), lambda given: find_tracks(plates, given)
    )
    assert raised is not None
    assert max(misplaced(camera, cameras[name]) for name, camera in raised.cameras.items()) < 0.1
    assert same(raised, fit_cameras(tracks, told, again=lambda given: find_tracks(plates, given)))


def test_hardly_any_match_by_the_cameras_found_leaves_them_as_found(tracks: Tracks, cameras: Cameras) -> None:
    told = cameras | {"2": turned(cameras["2"], 0.5)}
    found = fit_cameras(tracks, told, sparse_points, lambda given: tracks.kept(np.arange(0)))
    assert found is not None
    assert found.kinds == ("turned",)
    assert misplaced(found.cameras["2"], cameras["2"]) < 0.2 * misplaced(told["2"], cameras["2"])


def test_derivatives_in_parts_are_the_same(tracks: Tracks, cameras: Cameras, monkeypatch: pytest.MonkeyPatch) -> None:
    told = cameras | {"2": turned(cameras["2"], 0.5)}
    at_once = fit_cameras(tracks, told)
    monkeypatch.setattr("splashbench.selfcalibration.cameras._AT_ONCE", 1)
    assert same(fit_cameras(tracks, told), at_once)


def test_noise_has_nothing_in_common(cameras: Cameras) -> None:
    rng = np.random.default_rng(4)
    told = cameras | {"2": turned(cameras["2"], 0.5)}
    noise = {name: rng.integers(0, 255, (*SIZE[::-1], 3), dtype=np.uint8) for name in cameras}
    tracks = find_tracks({name: plate_of(cameras[name], image) for name, image in noise.items()}, cameras)
    assert len(tracks) < 30
    assert fit_cameras(tracks, told) is None


def test_too_few_points_say_nothing(tracks: Tracks, cameras: Cameras) -> None:
    told = cameras | {"2": turned(cameras["2"], 0.5)}
    assert fit_cameras(tracks.kept(np.arange(100)), told) is None


@pytest.mark.parametrize("name", ["1", "5"])
def test_a_view_that_shows_nothing_stays_as_told(
    name: str, plates: dict[str, CleanPlate], cameras: Cameras, images: dict[str, NDArray[np.uint8]]
) -> None:
    """The last view, too."""
    blank = plates | {name: plate_of(cameras[name], np.full_like(images[name], 90))}
    tracks = find_tracks(blank, cameras)
    assert tracks.pixels.shape[1:] == (5, 2)
    assert not tracks.seen[:, list(cameras).index(name)].any()
    assert tracks.seen.sum(axis=0).min() == 0
    assert typical_error(tracks, cameras) < 0.08


def test_plates_without_any_feature_have_no_tracks(cameras: Cameras) -> None:
    grey = {name: plate_of(camera, np.full((*SIZE[::-1], 3), 90, np.uint8)) for name, camera in cameras.items()}
    tracks = find_tracks(grey, cameras)
    assert tracks.pixels.shape == (0, 5, 2)
    assert fit_cameras(tracks, cameras) is None

"""The standard deviations of the poses are those that repeated noise produces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from splashbench.prepare.poses.covariance import PoseSigmas, pose_sigmas
from splashbench.prepare.poses.mapping import Workplace, refine

NOISE_PX = 0.5
DRAWS = 40
FIXED = [1, 2, 3, 4]  # cameras with a known lens, whose poses are of interest; two others have a free one


@pytest.fixture(scope="module")
def truth() -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 6, 1, 1
    options.num_points3D, options.num_points2D_without_point3D = 80, 0
    options.camera_params = [900.0, 512.0, 384.0, 0.05]
    return pycolmap.synthesize_dataset(options)


def solve(truth: pycolmap.Reconstruction, rng: np.random.Generator) -> tuple[pycolmap.Reconstruction, PoseSigmas]:
    """A bundle adjustment from the truth, the features moved by noise."""
    noisy = pycolmap.Reconstruction(truth)
    for image in noisy.images.values():
        for point in image.points2D:
            point.xy = point.xy + rng.normal(0, NOISE_PX, 2)
    refine(noisy, Workplace(Path(), {}, frozenset(FIXED), 1))
    sigmas = pose_sigmas(noisy, names(noisy), set(FIXED))
    assert sigmas is not None
    return noisy, sigmas


def names(reconstruction: pycolmap.Reconstruction) -> list[str]:
    return [image.name for image in reconstruction.images.values() if image.camera_id in FIXED]


def poses(reconstruction: pycolmap.Reconstruction) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Image -> rotation [3, 3] world to camera, centre [3]."""
    images = {image.name: image for image in reconstruction.images.values() if image.camera_id in FIXED}
    return {
        name: (image.cam_from_world().rotation.matrix(), image.projection_center()) for name, image in images.items()
    }


def remaining_errors(found: pycolmap.Reconstruction, truth: pycolmap.Reconstruction) -> tuple[np.ndarray, np.ndarray]:
    """Errors of centres [F] and rotations [F] (degrees) after the similarity that leaves least of both."""
    actual, wanted = poses(found), poses(truth)
    centres = np.array([centre for _, centre in wanted.values()])
    radius = np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean())

    def errors(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        turn = Rotation.from_rotvec(parameters[:3]).as_matrix()
        steps, turns = [], []
        for name, (rotation, centre) in wanted.items():
            own_rotation, own_centre = actual[name]
            steps.append(np.exp(parameters[3]) * turn @ own_centre + parameters[4:] - centre)
            turns.append(Rotation.from_matrix(own_rotation @ turn.T @ rotation.T).as_rotvec())
        return np.array(steps), np.array(turns)

    best = least_squares(
        lambda p: np.concatenate([e.ravel() for e in (errors(p)[0] / radius, errors(p)[1])]), [0.0] * 7
    )
    steps, turns = errors(best.x)
    return np.linalg.norm(steps, axis=1), np.degrees(np.linalg.norm(turns, axis=1))


@pytest.mark.slow
def test_predicted_deviations_are_those_of_repeated_noise(truth: pycolmap.Reconstruction) -> None:
    rng = np.random.default_rng(4)
    squared_centre, squared_turn, predicted = [], [], []
    for _ in range(DRAWS):
        found, sigmas = solve(truth, rng)
        steps, turns = remaining_errors(found, truth)
        squared_centre.append(steps**2)
        squared_turn.append(turns**2)
        order = list(poses(truth))
        predicted.append([[sigmas.centre[n] for n in order], [sigmas.rotation_deg[n] for n in order]])
    centre, turn = np.sqrt(np.mean(squared_centre, 0)), np.sqrt(np.mean(squared_turn, 0))
    expected = np.mean(predicted, 0)
    # 40 draws of about three degrees of freedom tell a deviation to about 6%.
    np.testing.assert_allclose(centre, expected[0], rtol=0.2)
    np.testing.assert_allclose(turn, expected[1], rtol=0.2)


def test_twice_the_noise_is_twice_the_deviation_without_being_told(truth: pycolmap.Reconstruction) -> None:
    deviations = []
    for factor in (1, 2):
        noisy = pycolmap.Reconstruction(truth)
        rng = np.random.default_rng(5)
        for image in noisy.images.values():
            for point in image.points2D:
                point.xy = point.xy + factor * rng.normal(0, NOISE_PX, 2)
        refine(noisy, Workplace(Path(), {}, frozenset(FIXED), 1))
        sigmas = pose_sigmas(noisy, names(noisy), set(FIXED))
        assert sigmas is not None
        deviations.append(np.mean(list(sigmas.centre.values())))
    assert deviations[1] / deviations[0] == pytest.approx(2, rel=0.05)


@pytest.fixture(scope="module")
def calibrated() -> pycolmap.Reconstruction:
    """Six cameras whose lenses were all calibrated, as `prepare` describes them to COLMAP."""
    pycolmap.set_random_seed(7)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 6, 1, 1
    options.num_points3D, options.num_points2D_without_point3D = 150, 0
    options.camera_model_id = pycolmap.CameraModelId.FULL_OPENCV
    options.camera_params = [900.0, 900.0, 512.0, 384.0, *([0.0] * 8)]
    return pycolmap.synthesize_dataset(options)


@pytest.mark.slow
def test_deviations_of_held_lenses_reach_the_poses(calibrated: pycolmap.Reconstruction) -> None:
    """The lenses are off by what their calibration allows; the features alone would explain a small part of it."""
    sigmas = np.array([3.0, 3.0, 2.0, 2.0, 2e-3, 2e-3, 2e-4, 2e-4, 0.0])
    covariance = np.diag(sigmas**2)
    covariance[0, 1] = covariance[1, 0] = 0.99 * 9.0  # fx and fy err together
    root = np.linalg.cholesky(covariance + 1e-18 * np.eye(9))
    fixed = set(calibrated.cameras)
    rng = np.random.default_rng(8)
    squares, total, by_features = [], [], []
    for _ in range(DRAWS):
        noisy = pycolmap.Reconstruction(calibrated)
        for camera in noisy.cameras.values():
            params = np.array(camera.params)
            params[:9] += root @ rng.normal(0, 1, 9)
            camera.params = params
        for image in noisy.images.values():
            for point in image.points2D:
                point.xy = point.xy + rng.normal(0, NOISE_PX, 2)
        refine(noisy, Workplace(Path(), {}, frozenset(fixed), 1))
        found = pose_sigmas(noisy, names(noisy), fixed, False, dict.fromkeys(fixed, covariance))
        assert found is not None
        squares.append(remaining_errors(noisy, calibrated)[0] ** 2)
        order = list(poses(calibrated))
        total.append([found.centre[name] for name in order])
        by_features.append([found.feature_centre[name] for name in order])
    actual = np.sqrt(np.mean(squares, 0))
    np.testing.assert_allclose(actual, np.mean(total, 0), rtol=0.25)
    assert (actual > 1.5 * np.mean(by_features, 0)).all()


@pytest.mark.slow
def test_an_image_with_more_noise_than_the_rest_counts_with_its_own(calibrated: pycolmap.Reconstruction) -> None:
    fixed, rng = set(calibrated.cameras), np.random.default_rng(9)
    order = list(poses(calibrated))
    squares, predicted = [], []
    for _ in range(DRAWS):
        noisy = pycolmap.Reconstruction(calibrated)
        for image in noisy.images.values():
            for point in image.points2D:
                point.xy = point.xy + (5 if image.name == order[0] else 1) * rng.normal(0, NOISE_PX, 2)
        refine(noisy, Workplace(Path(), {}, frozenset(fixed), 1))
        sigmas = pose_sigmas(noisy, names(noisy), fixed)
        assert sigmas is not None
        squares.append(remaining_errors(noisy, calibrated)[0] ** 2)
        predicted.append([sigmas.centre[name] for name in order])
    np.testing.assert_allclose(np.sqrt(np.mean(squares, 0)), np.mean(predicted, 0), rtol=0.25)


def test_nothing_is_said_about_one_camera_or_too_few_points(truth: pycolmap.Reconstruction) -> None:
    assert pose_sigmas(truth, names(truth)[:1], set(FIXED)) is None
    poor = pycolmap.Reconstruction(truth)
    for number in list(poor.points3D)[3:]:
        poor.delete_point3D(number)
    assert pose_sigmas(poor, names(poor), set(FIXED)) is None

"""Similarities and triangulated points on exact data."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splashbench.alignment import Similarity, triangulate, umeyama

SIMILARITY = Similarity(0.37, Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix(), np.array([1.0, -2.0, 0.5]))


def camera_towards_origin(azimuth: float, distance: float) -> np.ndarray:
    """World-to-camera [4, 4] of a camera whose axis meets the origin, turned about y by `azimuth` degrees."""
    w2c = np.eye(4)
    w2c[:3, :3] = Rotation.from_euler("y", azimuth, degrees=True).as_matrix()
    w2c[2, 3] = distance
    return w2c


@pytest.mark.parametrize("thickness", [1.0, 0.0])
def test_umeyama_recovers_a_similarity_also_from_a_plane(thickness: float) -> None:
    source = np.random.default_rng(1).normal(size=(20, 3)) * [1.0, 1.0, thickness]
    fitted = umeyama(source, SIMILARITY.apply(source))
    assert fitted.scale == pytest.approx(0.37, abs=1e-12)
    np.testing.assert_allclose(fitted.rotation, SIMILARITY.rotation, atol=1e-12)
    np.testing.assert_allclose(fitted.translation, SIMILARITY.translation, atol=1e-12)


def test_umeyama_never_mirrors() -> None:
    points = np.random.default_rng(0).normal(size=(7, 3))
    mirrored = umeyama(points, points * np.array([1, 1, -1]))
    assert np.linalg.det(mirrored.rotation) == pytest.approx(1.0)


def test_points_and_vectors_are_mapped_back() -> None:
    points = np.random.default_rng(2).normal(size=(4, 5, 3))
    np.testing.assert_allclose(SIMILARITY.invert(SIMILARITY.apply(points)), points, atol=1e-12)
    vectors = SIMILARITY.apply(points) - SIMILARITY.apply(np.zeros(3))
    np.testing.assert_allclose(SIMILARITY.invert_vectors(vectors), points, atol=1e-12)


def test_a_mapped_camera_sees_the_mapped_point_in_the_same_pixel() -> None:
    w2c = camera_towards_origin(20, 1.3)
    point = np.array([[0.1, 0.2, -0.1]])
    local = point @ w2c[:3, :3].T + w2c[:3, 3]
    mapped = SIMILARITY.apply_w2c(w2c)
    mapped_local = SIMILARITY.apply(point) @ mapped[:3, :3].T + mapped[:3, 3]
    np.testing.assert_allclose(mapped_local, 0.37 * local, atol=1e-12)


def test_triangulation_of_exact_rays_is_exact() -> None:
    point = np.array([0.05, 0.11, -0.2])
    poses = np.array([camera_towards_origin(azimuth, 1.0) for azimuth in (-30, 0, 25)])
    local = point @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, :3, 3]
    np.testing.assert_allclose(triangulate(local[:, :2] / local[:, 2:], poses), point, atol=1e-10)


def test_triangulation_counts_near_and_far_cameras_alike_in_the_image() -> None:
    """A point is placed where its errors in the images are least, not where the nearest camera's algebra wants it."""
    point = np.zeros(3)
    poses = np.array([camera_towards_origin(azimuth, far) for azimuth, far in ((-40, 1.0), (0, 1.0), (40, 8.0))])
    local = point @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, :3, 3]
    rays = local[:, :2] / local[:, 2:] + np.array([[0.01, 0.0], [-0.01, 0.0], [0.01, 0.0]])

    def image_error(candidate: np.ndarray) -> float:
        local = candidate @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, :3, 3]
        return float(np.square(local[:, :2] / local[:, 2:] - rays).sum())

    placed = triangulate(rays, poses)
    for step in 1e-3 * np.concatenate([np.eye(3), -np.eye(3)]):
        assert image_error(placed) < image_error(placed + step)

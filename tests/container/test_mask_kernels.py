"""The compiled loops of the search for a vessel against what they stand for."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench.container.mask_kernels import least_within, overlap
from splashbench.container.mask_vessel import _MaskView
from splashbench.observe.container import depth_image
from splashbench.scene.camera import Camera, look_at
from splashbench.scene.container import ContainerMesh

K = np.array([[120.0, 0, 41.3], [0, 118.0, 28.7], [0, 0, 1]])
CAMERA = Camera("0", 80, 60, K, look_at(np.array([0.4, 0.5, 0.9])))


def lump(seed: int, size: float = 0.1) -> ContainerMesh:
    """Triangles in all directions."""
    rng = np.random.default_rng(seed)
    return ContainerMesh(rng.normal(0, size, (40, 3)), rng.integers(0, 40, (60, 3)))


@pytest.mark.parametrize("seed", range(4))
def test_a_silhouette_is_that_of_the_depth_image(seed: int) -> None:
    mesh, mask = lump(seed), np.random.default_rng(seed).random((60, 80)) < 0.4
    drawn = np.isfinite(depth_image(mesh, CAMERA))
    assert 0.05 < drawn.mean() < 0.95
    found = overlap(mesh.vertices, mesh.faces, np.ascontiguousarray(CAMERA.projection), mask, 1e-4)
    assert found == ((drawn & mask).sum(), (drawn | mask).sum())


def test_a_body_that_a_camera_stands_in_is_cut_off_as_in_the_depth_image() -> None:
    mesh, mask = lump(5, size=2.0), np.random.default_rng(5).random((60, 80)) < 0.4
    assert overlap(mesh.vertices, mesh.faces, np.ascontiguousarray(CAMERA.projection), mask, 1e-4) == (-1, -1)
    drawn = np.isfinite(depth_image(mesh, CAMERA))
    view = _MaskView(CAMERA, mask, np.zeros((60, 80), np.float32))
    assert view.covered(mesh) == (drawn & mask).sum() / (drawn | mask).sum()
    behind = ContainerMesh(2 * CAMERA.center + lump(5).vertices, mesh.faces)
    assert view.covered(behind) == 0


def test_distances_are_read_between_pixels_and_the_least_is_kept() -> None:
    rng = np.random.default_rng(0)
    distance = rng.normal(size=(60, 80)).astype(np.float32)
    points = np.concatenate([rng.normal(0, 0.3, (500, 3)), [2 * CAMERA.center]])
    uv, depth = CAMERA.project(points)
    at = np.clip(uv - 0.5, 0, [79, 59])
    low = np.minimum(np.floor(at).astype(int), [78, 58])
    a, b = (at - low).T
    x, y = low.T
    upper = distance[y, x] * (1 - a) + distance[y, x + 1] * a
    lower = distance[y + 1, x] * (1 - a) + distance[y + 1, x + 1] * a
    expected = np.where(depth > 0, upper * (1 - b) + lower * b, -np.inf)
    least = np.full(len(points), np.inf)
    least_within(distance, np.ascontiguousarray(CAMERA.projection), points, least)
    np.testing.assert_allclose(least, expected, atol=1e-5)
    assert least[-1] == -np.inf
    again = np.full(len(points), -0.2)
    least_within(distance, np.ascontiguousarray(CAMERA.projection), points, again)
    np.testing.assert_allclose(again, np.minimum(expected, -0.2), atol=1e-5)

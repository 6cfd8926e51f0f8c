"""Rays against a signed distance whose surface is known by a formula: balls, a shell, a sheet."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench.replay.interface import Interface, cast, rays
from splashbench.scene import Camera, SignedDistance, look_at

VOXEL, CENTER, RADIUS = 0.01, np.array([0.02, 0.0, 0.03]), 0.2
CAMERA = Camera("eye", 150, 100, np.array([[170.0, 0, 75], [0, 170, 50], [0, 0, 1]]), look_at([1.2, 0.5, 0.8]))


def nodes(n: int = 64) -> np.ndarray:
    return np.stack(np.meshgrid(*[(np.arange(n) - n / 2) * VOXEL] * 3, indexing="ij"), -1)


def field(distance: np.ndarray) -> SignedDistance:
    n = len(distance)
    return SignedDistance.of(distance[None] / VOXEL, np.full(3, -n / 2 * VOXEL), VOXEL)


def ball(radius: float = RADIUS) -> np.ndarray:
    return np.asarray(np.linalg.norm(nodes() - CENTER, axis=-1) - radius)


def chord(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Length within a ball, and parameter of the entry, of CAMERA's rays."""
    directions = rays(CAMERA)
    size = np.linalg.norm(directions, axis=-1)
    offset = CAMERA.center - CENTER
    along = (directions @ offset) / size
    left = along**2 - (offset @ offset - radius**2)
    root = np.sqrt(np.maximum(left, 0))
    return 2 * root, np.where(left > 0, (-along - root) / size, np.inf)


def test_a_balls_depth_way_and_normals() -> None:
    found = cast(field(ball()), CAMERA)
    length, depth = chord(RADIUS)
    inner = length > 4 * VOXEL  # rays that graze it are wrong by more
    assert found.seen[inner].all()
    assert not found.seen[chord(RADIUS + VOXEL)[0] == 0].any()
    assert np.abs(found.length - length)[inner].mean() < 0.1 * VOXEL
    assert np.abs(found.depth[inner] - depth[inner]).mean() < 0.1 * VOXEL
    at = CAMERA.center + depth[inner, None] * rays(CAMERA)[inner]
    cosine = (found.normal[inner] * (at - CENTER) / RADIUS).sum(-1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 1
    assert np.isinf(found.depth[~found.seen]).all()
    assert (found.length[~found.seen] == 0).all()


def test_what_is_hollow_is_no_way_through_liquid() -> None:
    whole, hole = chord(RADIUS)[0], chord(RADIUS / 2)[0]
    shell = cast(field(np.maximum(ball(), -ball(RADIUS / 2))), CAMERA)
    inner = (hole > 4 * VOXEL) & (whole > 4 * VOXEL)
    assert np.abs(shell.length - (whole - hole))[inner].mean() < 0.2 * VOXEL


def test_a_thin_sheet_is_not_stepped_over() -> None:
    sheet = np.abs(nodes()[..., 1]) - 0.6 * VOXEL
    found = cast(field(np.maximum(sheet, np.abs(nodes()).max(-1) - 0.25)), CAMERA)
    directions = rays(CAMERA)
    at = CAMERA.center - CAMERA.center[1] / directions[..., 1:2] * directions
    inside = (np.abs(at) < 0.24).all(-1) & (directions[..., 1] < 0)
    assert inside.sum() > 500
    assert found.seen[inside].all()


def test_a_camera_within_the_liquid_sees_it_from_the_start() -> None:
    inside = Camera(
        "in", 20, 20, np.array([[20.0, 0, 10], [0, 20, 10], [0, 0, 1]]), look_at(CENTER, CENTER + np.array([1.0, 0, 0]))
    )
    found = cast(field(ball()), inside)
    assert found.seen.all()
    np.testing.assert_allclose(found.length, RADIUS, atol=VOXEL)


@pytest.mark.parametrize("distance", [np.ones((8, 8, 8)), np.full((2, 2, 2), 5.0)])
def test_no_liquid_is_seen_nowhere(distance: np.ndarray) -> None:
    found = cast(field(distance), CAMERA)
    assert isinstance(found, Interface)
    assert not found.seen.any()
    assert (found.length == 0).all()


def test_it_does_not_depend_on_the_scenes_unit() -> None:
    once = cast(field(ball()), CAMERA)
    distance = field(ball())
    far = SignedDistance(distance.phi, 50 * distance.origin, 50 * distance.voxel)
    w2c = CAMERA.w2c.copy()
    w2c[:3, 3] *= 50
    again = cast(far, Camera("eye", 150, 100, CAMERA.K, w2c))
    np.testing.assert_allclose(again.length, 50 * once.length, atol=1e-3)
    np.testing.assert_array_equal(again.seen, once.seen)


def test_a_surface_of_several_instants_is_refused() -> None:
    one = field(ball())
    with pytest.raises(ValueError, match="2 instants"):
        cast(SignedDistance(np.concatenate([one.phi, one.phi]), one.origin, one.voxel), CAMERA)

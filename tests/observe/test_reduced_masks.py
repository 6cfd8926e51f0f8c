"""Masks reduced to what a hull can use: the same outline, cameras that belong to it, and the same hull."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench.observe import Bounds, Grid, Silhouettes
from splashbench.observe.hull import carve_frame
from splashbench.observe.reduced_masks import HeldMasks, ReducedScene, reduced, reduction
from splashbench.parallel import each
from splashbench.scene.camera import Camera

RADIUS = 0.5


class BallScene:
    """A ball at the origin before three cameras on the axes, in images of odd sizes."""

    def __init__(self, focal: float = 900.0, size: tuple[int, int] = (603, 501)) -> None:
        self.name, self.n_frames, self.train = "ball", 1, ("0", "1", "2")
        self.cameras = {}
        for number, forward in enumerate(np.eye(3)):
            right = np.roll(forward, 1)
            w2c = np.eye(4)
            w2c[:3, :3] = np.stack([right, np.cross(forward, right), forward])
            w2c[2, 3] = 4.0
            K = np.array([[focal, 0, size[0] / 2 + 3.3], [0, focal, size[1] / 2 - 2.6], [0, 0, 1]])
            self.cameras[str(number)] = Camera(str(number), *size, K, w2c)

    def mask(self, camera: str, t: int) -> np.ndarray:
        view = self.cameras[camera]
        v, u = np.mgrid[0 : view.height, 0 : view.width] + 0.5
        rays = np.stack([(u - view.K[0, 2]) / view.K[0, 0], (v - view.K[1, 2]) / view.K[1, 1], np.ones_like(u)], -1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        return 4.0 * np.sqrt(1 - rays[..., 2] ** 2) < RADIUS


def test_a_square_is_liquid_where_a_line_across_it_would_be():
    scene = BallScene(focal=30.0, size=(5, 3))
    scene.mask = lambda camera, t: np.array([[1, 0, 1, 1, 1], [1, 0, 1, 0, 0], [0, 1, 0, 0, 1]], dtype=bool)
    small = ReducedScene(scene, 2)
    np.testing.assert_array_equal(small.mask("0", 0), [[True, True, False], [False, False, False]])
    assert (small.cameras["0"].width, small.cameras["0"].height) == (3, 2)


@pytest.mark.parametrize("factor", [2, 3, 5])
def test_a_stream_of_a_pixels_width_stays_whole(factor: int):
    scene = BallScene(focal=30.0, size=(60, 60))
    line = np.zeros((60, 60), dtype=bool)
    line[:, 31] = True
    scene.mask = lambda camera, t: line
    assert ReducedScene(scene, factor).mask("0", 0)[:, 31 // factor].all()


def test_points_fall_on_the_same_place_of_the_reduced_image():
    scene = BallScene()
    points = np.random.default_rng(0).normal(0, 0.3, (20, 3))
    for name, camera in ReducedScene(scene, 3).cameras.items():
        np.testing.assert_allclose(camera.project(points)[0] * 3, scene.cameras[name].project(points)[0], atol=1e-9)


@pytest.mark.parametrize("factor", [2, 3])
def test_the_hull_is_the_same_to_a_fraction_of_a_voxel(factor: int):
    scene = BallScene()
    grid = Grid.over(Bounds(np.full(3, -0.7), np.full(3, 0.7)), 28)
    full, small = (carve_frame(Silhouettes(one), grid, 0, None) for one in (scene, ReducedScene(scene, factor)))
    near = np.abs(full) < 3
    pixels_per_voxel = 900 / 4 * grid.voxel / factor
    assert np.abs(full - small)[near].max() < 1.5 / pixels_per_voxel
    # A line across a square fills it: the outline moves out, by less than half a reduced pixel.
    assert 0 <= (full - small)[near].mean() < 0.5 / pixels_per_voxel


def test_masks_that_silhouettes_hold_are_those_of_the_scene():
    scene = BallScene()
    held = HeldMasks(scene, Silhouettes(scene, views=["2", "0"]))
    assert held.train == ("2", "0")
    for name in held.train:
        np.testing.assert_array_equal(held.mask(name, 0), scene.mask(name, 0))
        np.testing.assert_array_equal(ReducedScene(held, 3).mask(name, 0), ReducedScene(scene, 3).mask(name, 0))
    assert reduction(held, 30, 3.0) == reduction(scene, 30, 3.0) == 2


def test_masks_are_reduced_only_as_far_as_the_hull_allows():
    scene = BallScene()
    across = 2 * RADIUS * 900 / 4  # pixels, and a little more by perspective
    assert reduced(scene, int(across)) is scene
    assert reduced(scene, int(across / 4) - 1).factor == 2
    assert reduced(scene, int(across / 6) - 1).factor == 3


def test_each_keeps_the_order_and_passes_errors_on():
    assert each(lambda n: n * n, range(9)) == [n * n for n in range(9)]
    with pytest.raises(ZeroDivisionError):
        each(lambda n: 1 // n, [1, 0])

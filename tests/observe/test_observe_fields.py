"""Hulls and signed distances of balls whose outlines are known exactly."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy import ndimage

from splashbench.errors import SplashbenchError
from splashbench.observe import Bounds, Grid, Silhouettes, sequence_bounds, signed_distance_fields
from splashbench.observe.kernels import resample, sample
from splashbench.observe.mask_distance import signed_distance_2d
from splashbench.observe.signed_distance import signed_distance_frames, signed_distance_of
from splashbench.scene.camera import Camera, look_at

RADIUS = 0.25


def looking_at_origin(name: str, eye: np.ndarray, focal: float = 400.0) -> Camera:
    """A 240x200 camera at `eye` that looks at the origin with y up."""
    return Camera(name, 240, 200, np.array([[focal, 0, 120], [0, focal, 100], [0, 0, 1.0]]), look_at(eye))


class Ball:
    """A still ball of radius 0.25 about the origin, seen by twelve cameras all around at three heights."""

    name = "ball"

    def __init__(self, n_frames: int = 2) -> None:
        angles = np.arange(12) * 2 * np.pi / 12
        heights = np.tile([-0.6, 0.1, 0.8], 4)
        eyes = [2.5 * np.array([np.cos(a), h, np.sin(a)]) for a, h in zip(angles, heights)]
        self.cameras = {str(i): looking_at_origin(str(i), eye) for i, eye in enumerate(eyes)}
        self.train = tuple(self.cameras)
        self.n_frames = n_frames
        self.empty: set[tuple[str, int]] = set()

    def mask(self, camera: str, t: int) -> np.ndarray:
        """Exact: a pixel is liquid where the ray through its centre meets the ball."""
        view = self.cameras[camera]
        rows, columns = np.mgrid[: view.height, : view.width] + 0.5
        rays = np.stack([(columns - 120) / 400, (rows - 100) / 400, np.ones_like(rows)], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        centre = view.w2c[:3, 3]
        along = rays @ centre
        if (camera, t) in self.empty:
            return np.zeros(rows.shape, dtype=bool)
        return centre @ centre - along**2 < RADIUS**2


def ball_surface(radius: float, n: int = 500) -> np.ndarray:
    directions = np.random.default_rng(0).normal(size=(n, 3))
    return radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def fields():
    return signed_distance_fields(Ball(), cells_longest_axis=48)


def test_importing_observe_needs_no_torch():
    code = "import sys, splashbench.observe; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_silhouettes_put_the_surface_where_the_ball_is(fields):
    on_surface = fields.sample(0, ball_surface(RADIUS)) * fields.voxel
    # A hull of twelve cones holds the ball and bulges between the views; both at the scale of a pixel, 1.6e-2 / 2.5.
    assert np.abs(np.median(on_surface)) < 0.004
    assert on_surface.max() < 0.006
    assert on_surface.min() > -0.06


def test_phi_grows_like_the_distance_to_the_ball(fields):
    for depth in (-0.1, -0.05, 0.03):
        phi = fields.sample(0, ball_surface(RADIUS + depth)) * fields.voxel
        assert np.median(phi) == pytest.approx(depth, abs=0.012)


def test_carving_with_a_distance_transform_agrees_to_a_voxel(fields):
    carved = signed_distance_fields(Ball(), cells_longest_axis=48, method="carve")
    near = np.abs(fields.phi[0]) < 2
    assert np.abs(carved.phi[0] - fields.phi[0])[near].max() < 1.1


def test_the_grid_spans_the_padded_hull(fields):
    assert fields.longest_side == pytest.approx(2 * RADIUS, rel=0.12)
    assert fields.longest_side >= 2 * RADIUS * 0.98
    spans = (np.array(fields.grid.shape) - 1) * fields.voxel
    assert spans.max() == pytest.approx(1.1 * fields.longest_side, rel=1e-6)
    assert max(fields.grid.shape) == 49
    assert (fields.sample(0, np.array([[0.0, 0, 0]])) < -5).all()


def test_beyond_the_grid_phi_keeps_growing(fields):
    far, farther = fields.sample(0, np.array([[5.0, 0, 0], [6.0, 0, 0]]))
    assert farther - far == pytest.approx(1 / fields.voxel, rel=1e-3)


def test_a_frame_without_liquid_is_far_outside_everywhere():
    scene = Ball()
    scene.empty = {(view, 1) for view in scene.train}
    phi = signed_distance_fields(scene, cells_longest_axis=24).phi
    assert (phi[1] == 20).all()
    assert (phi[0] < 0).any()


def test_a_failed_mask_does_not_erase_the_liquid():
    scene = Ball()
    scene.empty = {("3", 0)}
    broken = signed_distance_fields(scene, cells_longest_axis=32)
    whole = signed_distance_fields(Ball(), cells_longest_axis=32)
    assert Silhouettes(scene).failed(0) == ["3"]
    assert Silhouettes(scene).failed(1) == []
    # The ball stands still, so what that camera sees in the other frame stands in for the missing mask exactly.
    np.testing.assert_allclose(broken.phi[0], whole.phi[0], atol=1e-5)


def test_an_empty_mask_may_be_taken_at_its_word():
    scene = Ball()
    scene.empty = {("3", 0)}
    silhouettes = Silhouettes(scene, replace_empty=False)
    assert not silhouettes.failed_masks.any()
    grid = Grid.over(sequence_bounds(silhouettes).padded(0.1), 32)
    phi = list(signed_distance_frames(silhouettes, grid, "carve"))
    # "A voxel is occupied only if it projects inside the liquid masks of all five training views."
    assert (phi[0] == 20).all()
    assert (phi[1] < 0).any()
    scene.empty = {("3", 0), ("3", 1), ("7", 0), ("7", 1)}
    with pytest.raises(SplashbenchError, match=r"masks of camera 3, 7 show no liquid.*replace_empty_masks=true"):
        Silhouettes(scene, replace_empty=False)
    Silhouettes(scene)


def test_masks_of_one_view_only_are_an_error_naming_the_scene():
    scene = Ball()
    scene.empty = {(view, t) for view in scene.train[1:] for t in range(2)}
    with pytest.raises(SplashbenchError, match="ball: fewer than 2 training views"):
        signed_distance_fields(scene)


def test_masks_that_no_point_explains_are_an_error():
    scene = Ball()
    flipped = scene.mask

    def contradicting(camera: str, t: int) -> np.ndarray:
        """Half of the cameras see the ball in a corner where the others say there is nothing."""
        return np.roll(flipped(camera, t), 75 if int(camera) % 2 else -75, axis=0)

    scene.mask = contradicting
    with pytest.raises(SplashbenchError, match="no common visual hull"):
        sequence_bounds(scene)


def test_distance_in_the_image_is_half_a_pixel_at_the_outline():
    mask = np.zeros((20, 30), dtype=bool)
    mask[5:15, 10:20] = True
    distance = signed_distance_2d(mask)
    assert distance[10, 9] == 0.5
    assert distance[10, 10] == -0.5
    assert distance[10, 5] == 4.5
    assert distance[2, 6] == pytest.approx(np.hypot(3, 4) - 0.5)
    # Liquid that touches the image's edge ends there.
    mask[:] = True
    assert signed_distance_2d(mask)[10, 0] == -0.5


def test_signed_distance_of_occupied_voxels():
    occupied = np.zeros((9, 9, 9), dtype=bool)
    occupied[3:6, 3:6, 3:6] = True
    distance = signed_distance_of(occupied)
    assert distance[4, 4, 4] == -1.5
    assert distance[4, 4, 6] == 0.5
    assert distance[4, 4, 0] == 2.5
    assert (signed_distance_of(np.zeros((3, 3, 3), bool)) == 20).all()


def test_trilinear_interpolation_is_exact_for_linear_fields():
    x, y, z = np.mgrid[:5, :6, :7].astype(np.float32)
    field = 2 * x - 3 * y + 0.5 * z + 1
    points = np.random.default_rng(0).random((50, 3)) * [4, 5, 6]
    np.testing.assert_allclose(sample(field, points), points @ [2, -3, 0.5] + 1, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(resample(field, (3, 4, 4), 1.5)[1, 2, 3], 3 - 9 + 2.25 + 1, rtol=1e-6)
    # Every second node, and beyond the last one that one.
    np.testing.assert_array_equal(resample(field, (3, 3, 4), 2), field[::2, ::2, ::2])
    np.testing.assert_array_equal(resample(field, (3, 3, 5), 2)[..., 4], field[::2, ::2, 6])


def test_grids_of_one_box_share_their_origin():
    box = Bounds(np.array([-1.0, 0, 2]), np.array([1.0, 1, 3]))
    coarse, fine = Grid.over(box, 10), Grid.over(box, 40)
    assert coarse.shape == (11, 6, 6)
    assert fine.voxel == pytest.approx(coarse.voxel / 4)
    np.testing.assert_allclose(coarse.to_scene(coarse.to_voxels(np.array([0.3, 0.4, 2.5]))), [0.3, 0.4, 2.5], atol=1e-6)
    np.testing.assert_allclose(coarse.nodes()[-1, -1, -1], box.high)


def test_the_same_fields_on_any_number_of_threads(monkeypatch, fields):
    from splashbench import parallel

    monkeypatch.setattr(parallel, "thread_count", lambda: 1)
    alone = signed_distance_fields(Ball(), cells_longest_axis=48)
    np.testing.assert_array_equal(alone.phi, fields.phi)


def test_the_distance_of_a_small_liquid_in_a_large_grid_is_that_of_the_whole_grid():
    occupied = np.zeros((70, 64, 60), dtype=bool)
    occupied[2:5, 30:34, 28:30] = True
    occupied[10, 31, 29] = True
    inside, outside = (ndimage.distance_transform_edt(part) for part in (occupied, ~occupied))
    expected = np.clip(np.where(occupied, 0.5 - inside, outside - 0.5), -20, 20).astype(np.float32)
    np.testing.assert_array_equal(signed_distance_of(occupied), expected)

"""Liquid that images cut off: what is past their sides, and hulls of a ball that some cameras see a part of."""

from __future__ import annotations

import numpy as np
import pytest

from splashbench.observe import Bounds, Grid, Silhouettes, sequence_bounds, signed_distance_fields
from splashbench.observe import hull as hull_module
from splashbench.observe.cut_off import CutOff, in_images
from splashbench.observe.image_window import ImageWindow
from splashbench.observe.mask_distance import signed_distance_2d
from splashbench.scene.camera import Camera, look_at

RADIUS, FOCAL = 0.25, 400.0


def borders_of(masks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of masks [T, H, W]."""
    return masks[:, :, 0], masks[:, :, -1], masks[:, 0], masks[:, -1]


def past_by_looking(cut_off: CutOff, mask: np.ndarray) -> np.ndarray:
    """Where liquid may be past the sides of `mask`, pixel by pixel."""
    (height, width), window = mask.shape, cut_off.window
    liquid = np.zeros(window.shape, dtype=bool)
    crossings = [(row, column) for row, column in np.argwhere(mask)]
    for y in range(window.y0, window.y1):
        for x in range(window.x0, window.x1):
            for row, column in crossings:
                liquid[y - window.y0, x - window.x0] |= (
                    (column == 0 and x < 0 and abs(y - row) <= -x)
                    or (column == width - 1 and x >= width and abs(y - row) <= x - width + 1)
                    or (row == 0 and y < 0 and abs(x - column) <= -y)
                    or (row == height - 1 and y >= height and abs(x - column) <= y - height + 1)
                )
    return liquid


@pytest.mark.parametrize("seed", range(8))
def test_liquid_may_be_in_a_cone_past_where_it_crosses(seed: int) -> None:
    rng = np.random.default_rng(seed)
    masks = rng.random((3, 12, 17)) < rng.choice([0.02, 0.1, 0.6])
    masks[:, :, 0] &= seed % 2 == 0
    masks[:, 0] &= seed % 3 == 0
    masks[0, 5, -1] = True
    window = ImageWindow.around(masks.any(axis=0), 2)
    cut_off = CutOff.of(borders_of(masks), window)
    assert cut_off is not None
    assert cut_off.sides == tuple(bool(border.any()) for border in borders_of(masks))
    assert cut_off.window.holds(window)
    for first, last in ((0, 0), (1, 2), (0, 2)):
        expected = past_by_looking(cut_off, masks[first : last + 1].any(axis=0))
        np.testing.assert_array_equal(cut_off.liquid(first, last, cut_off.window), expected)
        # Of any part of it, too.
        whole = cut_off.window
        y0, x0 = rng.integers(whole.y0, window.y0 + 1), rng.integers(whole.x0, window.x0 + 1)
        y1, x1 = rng.integers(window.y1, whole.y1 + 1), rng.integers(window.x1, whole.x1 + 1)
        part = ImageWindow(int(y0), int(y1), int(x0), int(x1))
        np.testing.assert_array_equal(cut_off.liquid(first, last, part), expected[part.within(whole).slices])
    assert not cut_off.liquid(0, 2, window).any()


def test_half_of_the_longest_side_is_looked_at_past_the_sides_that_cut_alone() -> None:
    masks = np.zeros((1, 20, 30), dtype=bool)
    masks[0, :4, 10:12] = True
    cut_off = CutOff.of(borders_of(masks), ImageWindow(0, 9, 6, 16))
    assert cut_off is not None
    assert cut_off.window == ImageWindow(-15, 9, 6, 16)
    assert cut_off.ends == (-np.inf, np.inf, 0, np.inf)
    masks[0, 0] = False
    assert CutOff.of(borders_of(masks), ImageWindow(0, 9, 6, 16)) is None


class CutBall:
    """A still ball about the origin seen by cameras all around. Images of those in `cut` end at their middle, and with
    `shrinks` the ball is half as large in the second frame."""

    name = "cut_ball"
    n_frames = 2

    def __init__(self, count: int, *cut: int, shrinks: bool = False) -> None:
        self.cameras = {}
        for k in range(count):
            angle, height = 2 * np.pi * k / count, (-0.6, 0.1, 0.8)[k % 3]
            eye = 2.5 * np.array([np.cos(angle), height, np.sin(angle)])
            intrinsics = np.array([[FOCAL, 0, 120], [0, FOCAL, 100], [0, 0, 1.0]])
            self.cameras[str(k)] = Camera(str(k), 120 if k in cut else 240, 200, intrinsics, look_at(eye))
        self.train = tuple(self.cameras)
        self._shrinks = shrinks

    def mask(self, camera: str, t: int) -> np.ndarray:
        view = self.cameras[camera]
        rows, columns = np.mgrid[: view.height, : view.width] + 0.5
        rays = np.stack([(columns - 120) / FOCAL, (rows - 100) / FOCAL, np.ones_like(rows)], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        centre = view.w2c[:3, 3]
        radius = RADIUS / 2 if t == 1 and self._shrinks else RADIUS
        return centre @ centre - (rays @ centre) ** 2 < radius**2


def surface(radius: float, n: int = 500) -> np.ndarray:
    directions = np.random.default_rng(0).normal(size=(n, 3))
    return radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_what_one_image_cuts_off_is_not_carved_away() -> None:
    whole = signed_distance_fields(CutBall(12), cells_longest_axis=48)
    scene = CutBall(12, 0, 4, 8)
    silhouettes = Silhouettes(scene)
    assert silhouettes.cut_off[5] is None
    carving = hull_module.CarvingOcclusion.of(None, silhouettes, Grid.over(whole.bounds, 400))
    assert carving is not None
    assert carving.windows[5] == silhouettes.windows[5]
    cut_off = silhouettes.cut_off[4]
    assert cut_off is not None
    assert cut_off.sides == (False, True, False, False)
    # No more than the grid needs is looked at past the sides.
    assert 120 < carving.windows[4].x1 < cut_off.window.x1
    cut = signed_distance_fields(scene, cells_longest_axis=48)
    # The others see all of it: where they end the ball, it ends.
    assert np.abs(np.median(cut.sample(0, surface(RADIUS)) * cut.voxel)) < 0.004
    assert cut.longest_side == pytest.approx(whole.longest_side, rel=0.05)
    near = whole.grid.to_scene(np.argwhere(np.abs(whole.phi[0]) < 2))
    assert np.abs(cut.sample(0, near) - whole.sample(0, near)).mean() < 0.25
    carved = signed_distance_fields(scene, cells_longest_axis=48, method="carve")
    assert np.abs(carved.sample(0, near) - cut.sample(0, near)).max() < 1.2


def test_what_is_not_looked_at_past_the_sides_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    silhouettes = Silhouettes(CutBall(12, 0, 4, 8))
    grid = Grid.over(sequence_bounds(silhouettes).padded(0.1), 60)
    phi = hull_module.carve_frame(silhouettes, grid, 0, hull_module.CarvingOcclusion.of(None, silhouettes, grid))
    monkeypatch.setattr(CutOff, "window_of", lambda self, camera, places, reach: self.window)
    carving = hull_module.CarvingOcclusion.of(None, silhouettes, grid)
    all_of_it = hull_module.carve_frame(silhouettes, grid, 0, carving)
    near = np.abs(all_of_it) < 4
    assert near.sum() > 1000
    np.testing.assert_array_equal(phi[near], all_of_it[near])
    np.testing.assert_array_equal(phi < 0, all_of_it < 0)


def test_a_mask_that_ends_within_the_image_is_evidence_as_ever() -> None:
    """In the second frame the ball is smaller; past the sides that it crosses then it may be, and not farther aside."""
    scene = CutBall(12, 0, 4, 8, shrinks=True)
    cut, whole = (signed_distance_fields(one, cells_longest_axis=48) for one in (scene, CutBall(12, shrinks=True)))
    assert np.abs(np.median(cut.sample(1, surface(RADIUS / 2)) * cut.voxel)) < 0.006
    assert (cut.sample(1, surface(0.9 * RADIUS)) > 1).all()
    near = whole.grid.to_scene(np.argwhere(np.abs(whole.phi[1]) < 2))
    assert np.abs(cut.sample(1, near) - whole.sample(1, near)).mean() < 0.3


def test_places_that_too_few_images_have_hold_no_liquid() -> None:
    scene = CutBall(12, *range(1, 12))
    silhouettes = Silhouettes(scene)
    grid = Grid.over(Bounds(np.full(3, -0.3), np.full(3, 0.3)), 40)
    nodes = grid.nodes().reshape(-1, 3)
    have = np.zeros(len(nodes), dtype=int)
    for camera in scene.cameras.values():
        have += camera.project(nodes)[0][:, 0] < camera.width
    enough = in_images(silhouettes.that_see_liquid, grid, 0.75, 20).reshape(-1)
    np.testing.assert_array_equal(enough > 1e-3, have >= 9)
    np.testing.assert_array_equal(in_images(silhouettes.that_see_liquid, grid, 1.0, 20).reshape(-1) > 1e-3, have == 12)
    fields = signed_distance_fields(scene, cells_longest_axis=48)
    assert (fields.sample(0, nodes[have < 9]) > -0.01).all()
    assert fields.longest_side < 2.4 * RADIUS


def test_a_view_has_nothing_of_what_is_behind_it() -> None:
    scene = CutBall(3, 1)
    # Off the planes of the cameras, where rounding decides.
    grid = Grid(np.array([-4.03, -4.07, -4.05]), 8.0 / 30, (31, 31, 31))
    nodes = grid.nodes().reshape(-1, 3)
    have = np.zeros(len(nodes), dtype=int)
    for camera in scene.cameras.values():
        pixels, depth = camera.project(nodes)
        have += (depth > 0) & ((pixels[:, 0] < 120) | (camera.width == 240))
    within = in_images(Silhouettes(scene).that_see_liquid, grid, 1.0, 20).reshape(-1)
    assert 0.05 < (have == 3).mean() < 0.9
    np.testing.assert_array_equal(within[np.abs(within) > 1e-4] > 0, (have == 3)[np.abs(within) > 1e-4])


@pytest.mark.parametrize("count", [2, 3])
def test_of_two_or_three_images_all_have_to_have_a_place(count: int) -> None:
    scene = CutBall(count, 0)
    silhouettes = Silhouettes(scene)
    grid = Grid.over(sequence_bounds(scene).padded(0.5), 60)
    phi = hull_module.carve_frame(silhouettes, grid, 0, hull_module.CarvingOcclusion.of(None, silhouettes, grid))
    outside = scene.cameras["0"].project(grid.nodes().reshape(-1, 3))[0][:, 0] > 120
    assert (phi.reshape(-1)[outside] > -0.01).all()
    assert (phi < -1).any()


def test_a_hull_of_cut_off_liquid_is_the_same_by_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    silhouettes = Silhouettes(CutBall(9, 2, 5))
    grid = Grid.over(Bounds(np.full(3, -0.6), np.full(3, 0.7)), 70)
    carving = hull_module.CarvingOcclusion.of(None, silhouettes, grid)
    monkeypatch.setattr(hull_module, "_WORTH_BLOCKS", 1)
    by_blocks = hull_module.carve_frame(silhouettes, grid, 0, carving)
    monkeypatch.setattr(hull_module, "_WORTH_BLOCKS", 1000)
    np.testing.assert_array_equal(hull_module.carve_frame(silhouettes, grid, 0, carving), by_blocks)


class WithASpeck(CutBall):
    """As well as the ball, a speck far from it that no more than all but one of the images have."""

    at = np.array([0.0, 0.9, 0.0])

    def mask(self, camera: str, t: int) -> np.ndarray:
        mask = super().mask(camera, t)
        ((column, row),) = np.floor(self.cameras[camera].project(self.at[None])[0]).astype(int)
        if 0 <= row < mask.shape[0] and 0 <= column < mask.shape[1]:
            mask[row - 1 : row + 2, column - 1 : column + 2] = True
        return mask


def test_a_speck_that_an_image_lacks_makes_no_grid_coarser() -> None:
    bounds = sequence_bounds(CutBall(12, 0, 4))
    speck = WithASpeck(12, 0, 4)
    with_speck = sequence_bounds(speck)
    assert with_speck.longest_side < 1.3 * bounds.longest_side


def test_no_side_that_nothing_crosses_is_past_anything() -> None:
    mask = np.zeros((9, 11), dtype=bool)
    mask[3:5, 4:6] = True
    assert CutOff.of(borders_of(mask[None]), ImageWindow.around(mask)) is None
    assert signed_distance_2d(mask)[0, 0] > 4

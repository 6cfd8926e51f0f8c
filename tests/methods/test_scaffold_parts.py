"""The pieces of the static background: plates, seeds of anchors, the decoder, the losses, the pyramid."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from splashbench.background.clean_plate import CleanPlate, make_clean_plate
from splashbench.background.depth import common_target, depth_maps
from splashbench.background.median import masked_median
from splashbench.gaussians.anchor_seeds import AnchorSeed, seed_anchors, sparse_anchors
from splashbench.gaussians.color_loss import l1
from splashbench.gaussians.dynamic_model import rotation_matrices
from splashbench.scene import Camera, look_at
from splashbench_methods.scaffold_gs.fitting import pyramid
from splashbench_methods.scaffold_gs.model import AnchorModel, StaticAnchorSpec


def arc_camera(name: str, degrees: float, width: int = 80, height: int = 60) -> Camera:
    """A camera on an arc of radius 5 around the origin, 25 degrees above the floor y = 0, looking at the origin."""
    angle, elevation = np.radians(degrees), np.radians(25)
    eye = 5 * np.array([np.sin(angle) * np.cos(elevation), np.sin(elevation), np.cos(angle) * np.cos(elevation)])
    return Camera(name, width, height, np.array([[90.0, 0, 42], [0, 90.0, 29], [0, 0, 1]]), look_at(eye))


def floor_points(camera: Camera) -> np.ndarray:
    """Where each pixel's ray meets the floor, [H, W, 3] (every ray of these cameras does, or nearly)."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(camera.K).T @ camera.w2c[:3, :3]
    reach = np.minimum(-camera.center[1] / np.minimum(rays[..., 1], -1e-3), 12.0)
    return camera.center + reach[..., None] * rays


def floor_color(points: np.ndarray) -> np.ndarray:
    """A smooth bright pattern, uint8; nothing in it is darker than 80."""
    x, z = points[..., 0], points[..., 2]
    waves = [np.sin(2.2 * x) * np.cos(1.7 * z), np.sin(1.3 * x + 0.5), np.cos(1.9 * z - 0.3)]
    return np.clip(150 + 60 * np.stack(waves, -1), 80, 255).astype(np.uint8)


class TestPlate:
    def test_median_is_over_the_dry_frames_only(self):
        images = np.array([10, 20, 200, 30, 220], np.uint8)[:, None, None, None].repeat(3, axis=3)
        dry = np.array([True, True, False, True, False])[:, None, None]
        assert masked_median(images, dry).ravel().tolist() == [20, 20, 20]
        assert masked_median(images, np.zeros_like(dry)).ravel().tolist() == [0, 0, 0]
        assert masked_median(images, np.ones_like(dry)).ravel().tolist() == [30, 30, 30]

    @pytest.mark.parametrize("frames", [0, 1, 2, 5, 32, 300])
    @pytest.mark.parametrize("share", [0.0, 0.2, 0.9, 1.0])
    def test_medians_are_those_of_sorted_values(self, frames, share):
        rng = np.random.default_rng(frames)
        images = rng.integers(0, 256, (frames, 7, 11, 3), dtype=np.uint8)
        valid = rng.random((frames, 7, 11)) < share
        expected = np.zeros((7, 11, 3), np.uint8)
        for row, column in np.argwhere(valid.any(axis=0)):
            chosen = np.sort(images[valid[:, row, column], row, column], axis=0)
            expected[row, column] = chosen[(len(chosen) - 1) // 2]
        np.testing.assert_array_equal(masked_median(images, valid), expected)
        # Of a part of larger images, too.
        np.testing.assert_array_equal(masked_median(images[:, 1:6, ::2], valid[:, 1:6, ::2]), expected[1:6, ::2])

    def test_a_passing_liquid_leaves_no_trace_and_a_lasting_one_no_evidence(self, passing_liquid):
        scene, background = passing_liquid
        plate = make_clean_plate(scene, "1", longest_side=1000)
        assert 0 < (~plate.seen).sum() < 200
        assert not plate.seen[30, 40]
        np.testing.assert_array_equal(plate.image[plate.seen], background[plate.seen])

    def test_shrinking_moves_the_camera_along(self, passing_liquid):
        scene, background = passing_liquid
        plate = make_clean_plate(scene, "1", longest_side=40)
        assert (plate.camera.width, plate.camera.height) == (40, 30)
        np.testing.assert_allclose(plate.camera.K[:2], scene.cameras["1"].K[:2] / 2)
        small = cv2.resize(background, (40, 30), interpolation=cv2.INTER_AREA)
        np.testing.assert_allclose(plate.image[plate.seen], small[plate.seen], atol=5)
        assert (plate.image[~plate.seen] == 0).all()

    def test_beside_liquid_that_never_moves_a_plate_comes_nearer(self, passing_liquid):
        scene, _ = passing_liquid
        plate = make_clean_plate(scene, "1", longest_side=1000, near_still=True)
        seen = plate.seen
        strict = make_clean_plate(scene, "1", longest_side=1000)
        np.testing.assert_array_equal(plate.without_beside().seen, strict.seen)
        assert strict.without_beside() is strict
        # The margin is of two pixels, and of one at the square that stays; nothing is taken from the first frame alone.
        assert not seen[28:33, 38:43].any()
        assert not seen[27, 40]
        assert seen[26, 40]
        assert not make_clean_plate(scene, "1", longest_side=1000).seen[26, 40]
        assert not make_clean_plate(scene, "1", longest_side=1000, n_frames=1, near_still=True).seen[26, 40]

    def test_one_frame_is_the_first_and_later_ones_are_not_even_read(self, passing_liquid):
        scene, background = passing_liquid
        read: list[int] = []
        image = scene.image
        scene.image = lambda name, t: read.append(t) or image(name, t)
        plate = make_clean_plate(scene, "1", longest_side=1000, n_frames=1)
        assert read == [0]
        assert not plate.seen[15, 15]
        assert plate.seen[15, 30]
        np.testing.assert_array_equal(plate.image[plate.seen], background[plate.seen])


class _FakeScene:
    """Three frames of one camera: a square of liquid that moves, and one that stays."""

    def __init__(self) -> None:
        camera = arc_camera("1", 0)
        self.cameras, self.train, self.n_frames = {"1": camera}, ("1",), 3
        self.background = floor_color(floor_points(camera))

    def mask(self, name: str, t: int) -> np.ndarray:
        mask = np.zeros(self.background.shape[:2], bool)
        mask[10:20, 10 + 15 * t : 20 + 15 * t] = True
        mask[28:33, 38:43] = True
        return mask

    def image(self, name: str, t: int) -> np.ndarray:
        return np.where(self.mask(name, t)[..., None], np.array([20, 30, 250], np.uint8), self.background)


@pytest.fixture
def passing_liquid():
    scene = _FakeScene()
    return scene, scene.background


def floor_plates() -> list[CleanPlate]:
    cameras = [arc_camera(str(i), degrees) for i, degrees in enumerate((-38, -19, 0, 19, 38))]
    return [CleanPlate(c, floor_color(floor_points(c)), np.ones((c.height, c.width), bool)) for c in cameras]


TABLE_HEIGHT = 1.0


def table_points(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Floor and a round table above it: where each pixel's ray ends, [H, W, 3], and whether on the table."""
    floor = floor_points(camera)
    height = camera.center[1]
    table = camera.center + (height - TABLE_HEIGHT) / height * (floor - camera.center)
    on_table = np.linalg.norm(table[..., [0, 2]], axis=-1) < 1
    return np.where(on_table[..., None], table, floor), on_table


def table_plates() -> list[CleanPlate]:
    plates = []
    for plate in floor_plates():
        points, on_table = table_points(plate.camera)
        pattern = floor_color(2.5 * points + np.where(on_table, 0.7, 0)[..., None])
        plates.append(replace(plate, image=(pattern * np.where(on_table, 0.7, 1)[..., None]).astype(np.uint8)))
    return plates


def sparse_floor(n: int = 300, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = np.zeros((n, 7), np.float32)
    points[:, [0, 2]] = rng.uniform(-2.5, 2.5, (n, 2))
    return points


class TestAnchors:
    def test_cameras_on_an_arc_look_at_its_centre(self):
        cameras = [arc_camera(str(d), d).cropped(2, -1, 80, 60) for d in (-30, 0, 30)]
        # Cropping moved the image centres onto the principal points, through which the optical axes run.
        np.testing.assert_allclose(common_target(cameras), 0, atol=1e-4)

    def test_pixels_are_lifted_onto_the_plane_of_the_sparse_points(self):
        seed = seed_anchors(sparse_floor(), floor_plates(), 1500, np.random.default_rng(0))
        near = np.linalg.norm(seed.positions, axis=1) < 2.5
        assert near.sum() > 300
        assert np.abs(seed.positions[near, 1]).max() < 0.05
        expected = floor_color(seed.positions[near]).astype(float) / 255
        assert np.abs(seed.colors[near] - expected).mean() < 0.05

    def test_a_surface_without_sparse_points_is_found_by_the_sweep(self):
        seed = seed_anchors(sparse_floor(), table_plates(), 1500, np.random.default_rng(0))
        on_table = np.linalg.norm(seed.positions[:, [0, 2]], axis=1) < 0.6
        high = np.abs(seed.positions[:, 1] - TABLE_HEIGHT) < 0.1
        assert (on_table & high).sum() > 30

    def test_the_sweep_needs_no_points_and_trusts_no_unseen_pixel(self):
        plates = table_plates()
        plates[2] = replace(plates[2], seen=plates[2].seen & (np.arange(80) > 20))
        errors, trusted = [], []
        for plate, depth in zip(plates, depth_maps(None, plates)):
            points, on_table = table_points(plate.camera)
            true = 1 / plate.camera.project(points.reshape(-1, 3))[1].reshape(on_table.shape)
            middle = np.zeros_like(on_table)
            middle[20:50, 25:60] = True
            trusted.append(depth.trusted[middle].mean())
            errors.append((depth.inverse - true)[depth.trusted & middle])
            assert not (depth.trusted & ~plate.seen).any()
        assert min(trusted) > 0.6
        # Neighbours stand 1.65 apart. In pixels of parallax between them, no bias: half a pixel off would show.
        assert abs(np.median(np.concatenate(errors))) * 90 * 1.65 < 0.1
        assert depth_maps(None, plates[:1]) == []

    @pytest.mark.parametrize("points", [sparse_floor(), sparse_floor(5), None], ids=["many", "few", "none"])
    def test_seeds_are_bounded_finite_in_front_and_repeatable(self, points):
        plates = floor_plates()
        seed, again = (seed_anchors(points, plates, 400, np.random.default_rng(3)) for _ in range(2))
        assert 100 < len(seed.positions) <= 400
        for array, other in zip(vars(seed).values(), vars(again).values()):
            assert np.isfinite(array).all()
            np.testing.assert_array_equal(array, other)
        assert (plates[2].camera.project(seed.positions)[1] > 0).all()
        assert (seed.spacing > 0).all()

    def test_points_on_one_line_and_points_at_infinity_do_no_harm(self):
        line = np.zeros((50, 7), np.float32)
        line[:, 0] = np.linspace(-1, 1, 50)
        line[0, :3] = 1e7
        seed = seed_anchors(line, floor_plates(), 400, np.random.default_rng(0))
        assert np.isfinite(seed.positions).all()
        assert np.median(np.linalg.norm(seed.positions, axis=1)) < 10

    def test_sparse_points_give_one_anchor_per_voxel_at_its_centre(self):
        pairs = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 0, 0], [0.1, 0, 0]])
        points = np.concatenate([pairs, [[0.2, 0, 0]] * 4 + [[0.8, 0, 0]]], axis=1).astype(np.float32)
        seed = sparse_anchors(points, 100)
        # The nearest neighbours are 0.1, 0.9, 1, 3 and 0.1 away: the voxel is their median.
        assert seed.voxel == pytest.approx(0.9, rel=1e-5)
        np.testing.assert_allclose(seed.positions[:, 0], [0, 0.9, 1.8, 5.4], rtol=1e-5)
        np.testing.assert_allclose(seed.colors[0], [0.5, 0, 0], atol=1e-6)
        assert len(sparse_anchors(points, 2).positions) <= 2
        assert len(sparse_anchors(points[:1], 100).positions) == 1


class TestModel:
    def model(self, n: int = 20, variant: StaticAnchorSpec = StaticAnchorSpec(3)) -> AnchorModel:  # noqa: B008
        torch.manual_seed(0)
        rng = np.random.default_rng(0)
        seed = AnchorSeed(
            *(a.astype(np.float32) for a in (rng.normal(size=(n, 3)), rng.random((n, 3)), np.ones(n))), voxel=1.0
        )
        return AnchorModel.from_seed(seed, variant)

    def test_rotations_of_unnormalised_quaternions_are_rotations(self):
        R = rotation_matrices(torch.randn(50, 4, generator=torch.Generator().manual_seed(0)) * 5).double()
        np.testing.assert_allclose((R @ R.transpose(1, 2)).numpy(), np.eye(3)[None].repeat(50, 0), atol=1e-5)
        np.testing.assert_allclose(torch.linalg.det(R), 1, atol=1e-5)
        quarter = rotation_matrices(torch.tensor([[1.0, 0, 0, 1.0]]))[0]
        np.testing.assert_allclose(quarter, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-6)

    def test_children_start_near_their_anchor_with_its_colour(self):
        model = self.model()
        means, factors, opacities, colors, scales = model.decode(np.array([0.0, 0, 9]))
        assert means.shape == (60, 3)
        assert (torch.linalg.norm(means.view(20, 3, 3) - model.positions[:, None], dim=2) < 1.3).all()
        base = torch.sigmoid(model.features[:, :3])
        assert (colors.view(20, 3, 3) - base[:, None]).abs().mean() < 0.1
        assert (opacities > 0.3).all()
        np.testing.assert_allclose(torch.linalg.det(factors).abs().detach(), scales.prod(1).detach(), rtol=1e-3)

    def test_without_a_base_colour_the_seeds_colours_play_no_part(self):
        base, plain = self.model(), self.model(variant=StaticAnchorSpec(3, base_color=False))
        with torch.no_grad():
            for model in (base, plain):
                model.features[:, :3] += 9
                model.color_head[-1].weight.zero_()
        assert (base.decode(np.zeros(3)).colors > 0.9).all()
        np.testing.assert_allclose(plain.decode(np.zeros(3)).colors.detach(), 0.5, atol=1e-6)

    def test_only_colour_depends_on_the_viewpoint_unless_asked(self):
        here, there = np.array([0.0, 0, 9]), np.array([9.0, 0, 0])
        one, other = self.model().decode(here), self.model().decode(there)
        assert all(torch.equal(one[i], other[i]) for i in (0, 1, 2))
        assert not torch.equal(one.colors, other.colors)
        model = self.model(variant=StaticAnchorSpec(3, view_dependent_shape=True))
        assert not torch.equal(model.decode(here).opacities, model.decode(there).opacities)


class TestLoss:
    def plate(self, seen: np.ndarray) -> CleanPlate:
        rng = np.random.default_rng(0)
        camera = arc_camera("1", 0, seen.shape[1], seen.shape[0])
        return CleanPlate(camera, rng.integers(0, 256, (*seen.shape, 3)).astype(np.uint8), seen)

    def test_unseen_pixels_carry_no_loss_and_no_gradient(self):
        seen = np.zeros((14, 17), bool)
        seen[5, 5] = True
        plate = self.plate(seen)
        image = torch.rand(14, 17, 3, generator=torch.Generator().manual_seed(0), requires_grad=True)
        loss = l1(image, plate.image, plate.seen)
        loss.backward()
        assert loss.item() == pytest.approx((image[5, 5] - torch.tensor(plate.floats()[5, 5])).abs().mean().item())
        assert torch.count_nonzero(image.grad) == torch.count_nonzero(image.grad[5, 5]) == 3
        assert l1(image, np.zeros((14, 17, 3), np.uint8), np.zeros((14, 17), bool)).item() == 0

    def test_value_and_gradient_are_those_of_torch(self):
        plate = self.plate(np.random.default_rng(1).random((70, 31)) < 0.5)
        image = torch.rand(70, 31, 3, generator=torch.Generator().manual_seed(0), requires_grad=True)
        target, seen = torch.tensor(plate.floats()), torch.tensor(plate.seen)
        expected = (image - target).abs()[seen].mean()
        (gradient,) = torch.autograd.grad(2 * expected, image)
        loss = l1(image, plate.image, plate.seen)
        (2 * loss).backward()
        assert loss.item() == pytest.approx(expected.item(), rel=1e-5)
        np.testing.assert_allclose(image.grad, gradient, rtol=1e-5)


def test_images_grow_until_whole_and_half_of_the_steps_left_go_to_each_smaller_size():
    assert pyramid(1800, 400, 1000) == {0: 225, 500: 450, 750: 900, 875: 1800}
    assert pyramid(400, 400, 1000) == {0: 400}

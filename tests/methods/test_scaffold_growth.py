"""Growth and pruning of anchors: where they appear, which vanish, and what that is worth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from splashbench.background.clean_plate import CleanPlate
from splashbench.gaussians.anchor_seeds import AnchorSeed, sparse_anchors
from splashbench.gaussians.screen_gradients import screen_gradients
from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.render import rasterize
from splashbench.scene import Camera
from splashbench_methods.scaffold_gs import BackgroundSettings
from splashbench_methods.scaffold_gs.fitting import fit_model
from splashbench_methods.scaffold_gs.growth import Growth
from splashbench_methods.scaffold_gs.model import AnchorModel, DecodedGaussians, StaticAnchorSpec
from splashbench_methods.scaffold_gs.optimizer import AnchorOptimizer


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread():
        yield


WIDTH, HEIGHT, FOCAL, DISTANCE = 96, 64, 96.0, 3.0


def wall_camera(x: float) -> Camera:
    """A camera at (x, 0, -3), facing the wall z = 0."""
    w2c = np.eye(4)
    w2c[:3, 3] = [-x, 0, DISTANCE]
    return Camera(str(x), WIDTH, HEIGHT, np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]), w2c)


def wall_plate(x: float) -> CleanPlate:
    """The textured wall, seen from `wall_camera(x)`."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    a, b = x + (u - WIDTH / 2) / FOCAL * DISTANCE, (v - HEIGHT / 2) / FOCAL * DISTANCE
    waves = np.stack([np.sin(9 * a) * np.cos(7 * b), np.sin(6 * a + 8 * b), np.cos(11 * b)], axis=-1)
    return CleanPlate(wall_camera(x), (127 + 100 * waves).astype(np.uint8), np.ones((HEIGHT, WIDTH), bool))


def wall_points(n: int) -> np.ndarray:
    points = np.full((n, 7), 0.5, np.float32)
    points[:, :3] = np.random.default_rng(0).uniform([-1.8, -1, 0], [1.8, 1, 0], (n, 3))
    return points


def growth_of(positions: np.ndarray, k: int = 2, **settings: object) -> Growth:
    """Growth of a fresh model with anchors at `positions` [N, 3], 0.1 apart."""
    torch.manual_seed(0)
    n = len(positions)
    seed = AnchorSeed(positions.astype(np.float32), np.full((n, 3), 0.5, np.float32), np.full(n, 0.1, np.float32), 0.02)
    model = AnchorModel.from_seed(seed, StaticAnchorSpec(k))
    chosen = BackgroundSettings(children=k, grow_every=10, **settings)  # type: ignore[arg-type]
    return Growth(AnchorOptimizer(model, "published", 100), seed.voxel, chosen, np.random.default_rng(0))


def wall_grid(step: float = 0.2) -> np.ndarray:
    a, b = np.meshgrid(np.arange(-1.4, 1.41, step), np.arange(-0.8, 0.81, step))
    return np.stack([a.ravel(), b.ravel(), np.zeros(a.size)], axis=1)


def seen(growth: Growth, opacities: torch.Tensor, gradients: torch.Tensor) -> DecodedGaussians:
    """The model's Gaussians with other opacities, and with gradients of their means."""
    gaussians = growth.model.decode(np.array([0.0, 0, -DISTANCE]))
    means = gaussians.means.detach().requires_grad_()
    means.grad = gradients
    return gaussians._replace(means=means, opacities=opacities)


class TestScreenGradients:
    def test_they_are_those_by_the_projection(self):
        rng = np.random.default_rng(0)
        camera = Camera("1", 80, 60, np.array([[90.0, 0, 42], [0, 70.0, 29], [0, 0, 1]]), np.eye(4))
        means = torch.tensor(rng.uniform([-1, -1, 2], [1, 1, 5], (50, 3)), dtype=torch.float32, requires_grad=True)
        by_pixel = torch.tensor(rng.normal(size=(50, 2)), dtype=torch.float32)
        u = 90 * means[:, 0] / means[:, 2] + 42
        v = 70 * means[:, 1] / means[:, 2] + 29
        ((u * by_pixel[:, 0]) + (v * by_pixel[:, 1])).sum().backward()
        assert means.grad is not None
        got = screen_gradients(camera, means.detach().numpy(), means.grad.numpy())
        np.testing.assert_allclose(got, np.linalg.norm(by_pixel.numpy() * [40, 30], axis=1), rtol=1e-4)

    def test_the_footprint_plays_hardly_any_part(self):
        # Moving the principal point moves a Gaussian's projection, and nothing else.
        target = wall_plate(0.0).floats()[..., 0]
        mean = torch.tensor([[0.5, -0.3, 0.1]], requires_grad=True)
        factor, opacity, color = torch.eye(3)[None] * 0.15, torch.tensor([0.8]), torch.ones(1, 1)

        def loss(dx: float, dy: float) -> torch.Tensor:
            camera = wall_camera(0.0)
            shift = np.array([[0, 0, dx], [0, 0, dy], [0, 0, 0]])
            moved = Camera("1", WIDTH, HEIGHT, camera.K + shift, camera.w2c)
            image, _ = rasterize(mean, factor, opacity, color, moved)
            return ((image[..., 0] - torch.tensor(target)) ** 2).sum()

        loss(0, 0).backward()
        step = 0.05
        slope = [(loss(*d) - loss(*-d)).item() / (2 * step) for d in (np.array([step, 0]), np.array([0, step]))]
        assert mean.grad is not None
        got = screen_gradients(wall_camera(0.0), mean.detach().numpy(), mean.grad.numpy())[0]
        assert got == pytest.approx(np.linalg.norm(np.array(slope) * [WIDTH / 2, HEIGHT / 2]), rel=0.03)


class TestRound:
    def test_anchors_appear_where_the_error_is_large(self):
        growth = growth_of(wall_grid(), grow_gradient=1e-4)
        plate = wall_plate(0.0)
        wrong = np.zeros((HEIGHT, WIDTH, 1), np.float32)
        wrong[16:40, 60:84] = 1  # on the wall: x from 0.375 to 1.125, y from -0.5 to 0.25
        gaussians = growth.model.decode(plate.camera.center)
        shown, _ = rasterize(*(t.detach() for t in gaussians[:4]), plate.camera)
        target = shown + torch.tensor(wrong * (plate.floats() - 0.5))
        before = len(growth.model)
        for _ in range(10):
            gaussians = growth.model.decode(plate.camera.center)
            gaussians.means.retain_grad()
            image, _ = rasterize(*gaussians[:4], plate.camera)
            ((image - target) ** 2).mean().backward()
            growth.observe(plate.camera, gaussians)
        growth.round()
        new = growth.model.positions[before:].numpy()
        assert len(new) > 10
        near = (np.abs(new[:, 0] - 0.75) < 0.7) & (np.abs(new[:, 1] + 0.125) < 0.7)
        assert near.mean() > 0.95

    def test_a_voxel_gets_one_anchor_and_none_where_there_is_one(self):
        growth = growth_of(wall_grid(), grow_gradient=1e-9)
        gradients = torch.ones(2 * len(growth.model), 3)
        for _ in range(10):
            growth.observe(wall_camera(0.0), seen(growth, torch.ones(len(gradients)), gradients))
        before = growth.model.positions.numpy().copy()
        growth.round()
        new = growth.model.positions[len(before) :].numpy()
        assert len(new) > 0
        fine = np.round(np.concatenate([before, new]) / growth.voxel)
        assert len(np.unique(fine, axis=0)) == len(fine)
        np.testing.assert_allclose(new, np.round(new / growth.voxel) * growth.voxel, atol=1e-6)

    def test_transparent_anchors_vanish_once_they_were_seen_often_enough(self):
        growth = growth_of(wall_grid())
        n = len(growth.model)
        positions = growth.model.positions.numpy().copy()
        opacities = torch.full((n, 2), 0.5)
        opacities[:7] = torch.tensor([-0.9, 0.001])
        opacities[7:9] = torch.tensor([-0.9, 0.1])
        for _ in range(7):
            growth.observe(wall_camera(0.0), seen(growth, opacities.view(-1), torch.zeros(2 * n, 3)))
        growth.round()
        assert len(growth.model) == n
        growth.observe(wall_camera(0.0), seen(growth, opacities.view(-1), torch.zeros(2 * n, 3)))
        growth.round()
        np.testing.assert_array_equal(growth.model.positions.numpy(), positions[7:])

    def test_the_last_anchor_stays(self):
        growth = growth_of(np.zeros((1, 3)))
        for _ in range(10):
            growth.observe(wall_camera(0.0), seen(growth, torch.full((2,), -0.5), torch.zeros(2, 3)))
        growth.round()
        assert len(growth.model) == 1

    def test_there_are_never_more_anchors_than_allowed(self):
        growth = growth_of(wall_grid(), grow_gradient=1e-9, max_anchors=len(wall_grid()) + 5)
        n = len(growth.model)
        for _ in range(10):
            growth.observe(wall_camera(0.0), seen(growth, torch.ones(2 * n), torch.ones(2 * n, 3)))
        growth.round()
        assert len(growth.model) == n + 5

    def test_kept_anchors_keep_their_moments_and_new_ones_can_be_fitted(self):
        growth = growth_of(wall_grid())
        optimizer, model = growth.optimizer, growth.model
        model.decode(np.array([0.0, 0, -3])).colors.sum().backward()
        optimizer.step()
        moments = optimizer.adam.state[model.features]["exp_avg"].clone()
        features = model.features.detach().clone()
        kept = np.array([4, 2])
        new = {"features": torch.zeros(1, 32), "offsets": torch.zeros(1, 2, 3), "log_scales": torch.zeros(1, 6)}
        optimizer.replace_anchors(kept, torch.ones(1, 3), new)
        assert len(model) == len(model.features) == 3
        assert torch.equal(model.features[:2], features[kept])
        assert torch.equal(optimizer.adam.state[model.features]["exp_avg"][:2], moments[kept])
        assert not optimizer.adam.state[model.features]["exp_avg"][2].any()
        model.decode(np.array([0.0, 0, -3])).colors.sum().backward()
        optimizer.step()
        assert model.features[2].any()


def test_learning_rates_end_where_they_were_published_to():
    growth = growth_of(wall_grid())
    for _ in range(101):
        growth.model.decode(np.array([0.0, 0, -3])).colors.sum().backward()
        growth.optimizer.step()
    rates = {group["name"]: group["lr"] for group in growth.optimizer.adam.param_groups}
    assert rates["offsets"] == pytest.approx(1e-4)
    assert rates["color_head"] == pytest.approx(5e-5)
    assert rates["features"] == 0.0075


def test_growth_reconstructs_a_textured_wall_better_from_few_points():
    plates = [wall_plate(x) for x in (-0.6, 0.0, 0.6)]
    unseen = wall_plate(0.3)
    seed = sparse_anchors(wall_points(60), 2000)

    def psnr(**settings: object) -> tuple[float, int]:
        chosen = BackgroundSettings(iterations=160, max_anchors=2000, grow_every=20, **settings)  # type: ignore[arg-type]
        model = fit_model(seed, plates, chosen, np.full(3, 0.5, np.float32), 0, lambda fraction: None)
        with torch.no_grad():
            gaussians = model.decode(unseen.camera.center)
        image, _ = rasterize(*gaussians[:4], unseen.camera, background=torch.full((3,), 0.5))
        return float(-10 * np.log10(((image.numpy() - unseen.floats()) ** 2).mean())), len(model)

    fixed, n_fixed = psnr()
    grown, n_grown = psnr(grow_from=0.1, grow_until=0.6)
    assert n_fixed == len(seed.positions) < n_grown <= 2000
    assert grown > fixed + 1, f"{grown:.1f} dB with growth, {fixed:.1f} dB without"

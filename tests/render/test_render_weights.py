"""What each Gaussian makes up of an image, against the derivative by its colour."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splashbench.native.threads import use_threads
from splashbench.render import compositing_weights, freeze, rasterize
from splashbench.scene.camera import Camera


@pytest.fixture
def camera() -> Camera:
    return Camera("1", 171, 93, np.array([[140.0, 0, 85], [0, 140.0, 45], [0, 0, 1]]), np.eye(4))


def scatter(n: int, seed: int, opacity: tuple[float, float] = (0.1, 1)) -> tuple[torch.Tensor, ...]:
    rng = np.random.default_rng(seed)
    arrays = (
        rng.normal(size=(n, 3)) * [1.0, 0.7, 0.7] + [0, 0, 4],
        rng.normal(size=(n, 3, 3)) * 0.1,
        rng.uniform(*opacity, n),
    )
    return tuple(torch.tensor(a, dtype=torch.float32) for a in arrays)


def by_derivative(shapes, camera, counts=None, frozen=None) -> np.ndarray:
    colors = torch.zeros(len(shapes[0]), 1, requires_grad=True)
    image, _ = rasterize(*shapes, colors, camera, frozen=frozen)
    weighted = image[..., 0] if counts is None else image[..., 0] * torch.as_tensor(counts)
    (found,) = torch.autograd.grad(weighted.sum(), [colors])
    return found[:, 0].numpy()


# Opaque ones exhaust pixels, and reach the largest alpha; many fill several tiles' lists.
@pytest.mark.parametrize(("n", "opacity"), [(1, (0.5, 0.5)), (700, (0.1, 1)), (3000, (0.9995, 1)), (3000, (0, 0.02))])
def test_weights_are_the_derivative_by_colour(camera, n, opacity):
    shapes = scatter(n, 1, opacity)
    found = compositing_weights(*shapes, camera)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, by_derivative(shapes, camera), rtol=2e-4, atol=2e-4)
    assert (found > 0).any()


def test_they_add_up_to_the_opacity(camera):
    shapes = scatter(900, 2)
    _, opacity = rasterize(*shapes, None, camera)
    assert compositing_weights(*shapes, camera).sum() == pytest.approx(float(opacity.sum()), rel=1e-4)


def test_pixels_count_as_much_as_is_said(camera):
    shapes = scatter(900, 3)
    counts = np.random.default_rng(0).uniform(0, 2, (camera.height, camera.width)).astype(np.float32)
    counts[:40] = 0
    np.testing.assert_allclose(
        compositing_weights(*shapes, camera, counts=counts), by_derivative(shapes, camera, counts), rtol=2e-4, atol=2e-4
    )
    assert (compositing_weights(*shapes, camera, counts=np.zeros_like(counts)) == 0).all()


def test_frozen_gaussians_stand_before_them(camera):
    shapes, others = scatter(600, 4), scatter(400, 5, (0.8, 1))
    frozen = freeze(*others, np.zeros((400, 1), np.float32), camera)
    found = compositing_weights(*shapes, camera, frozen=frozen)
    np.testing.assert_allclose(found, by_derivative(shapes, camera, frozen=frozen), rtol=2e-4, atol=2e-4)
    assert found.sum() < 0.9 * compositing_weights(*shapes, camera).sum()


def test_they_are_the_same_on_any_number_of_threads_and_after_another_image(camera):
    shapes = scatter(3000, 6)
    with use_threads(1):
        alone = compositing_weights(*shapes, camera)
    rasterize(*scatter(50, 7), torch.rand(50, 7), camera, depth=True)
    with use_threads(3):
        np.testing.assert_array_equal(compositing_weights(*shapes, camera), alone)


def test_those_that_are_not_drawn_weigh_nothing(camera):
    means, factors, opacities = scatter(4, 8)
    means[0, 2], means[1, 0], opacities[2] = -4, 1e4, 0.001
    found = compositing_weights(means, factors, opacities, camera)
    assert (found[:3] == 0).all()
    assert len(compositing_weights(means[:0], factors[:0], opacities[:0], camera)) == 0


def test_bad_arguments_are_named(camera):
    means, factors, opacities = scatter(5, 9)
    with pytest.raises(ValueError, match="counts"):
        compositing_weights(means, factors, opacities, camera, counts=np.ones((3, 3), np.float32))
    with pytest.raises(ValueError, match="counts"):
        compositing_weights(means, factors, opacities, camera, counts=np.full((93, 171), np.nan, np.float32))
    with pytest.raises(ValueError, match="means"):
        compositing_weights(means * np.nan, factors, opacities, camera)
    with pytest.raises(ValueError, match="factors"):
        compositing_weights(means, factors[:2], opacities, camera)
    with pytest.raises(TypeError, match="frozen"):
        compositing_weights(means, factors, opacities, camera, frozen=3)

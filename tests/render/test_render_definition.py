"""The renderer against closed forms and against the definition in reference.py."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from splashbench.render import rasterize, rasterize_arrays, reference, tile_mask
from splashbench.scene.camera import Camera


def facing_camera(width: int = 48, height: int = 40, cx: float = 24.0, cy: float = 20.0) -> Camera:
    """A camera at the origin looking along +z, 50 px of focal length."""
    K = np.array([[50.0, 0, cx], [0, 50.0, cy], [0, 0, 1]])
    return Camera("1", width, height, K, np.eye(4))


def turned_camera(width: int = 67, height: int = 45) -> Camera:
    """A camera turned about y, its principal point well off the centre, sizes no multiple of a tile."""
    c, s = math.cos(0.3), math.sin(0.3)
    w2c = np.array([[c, 0, s, 0.1], [0, 1, 0, -0.05], [-s, 0, c, 4.0], [0, 0, 0, 1]])
    K = np.array([[80.0, 0, width / 2 + 9.3], [0, 76.0, height / 2 - 6.2], [0, 0, 1]])
    return Camera("2", width, height, K, w2c)


def one(mean, variance=0.01, opacity=0.5, color=(1.0, 0.5, 0.25)):
    """One isotropic Gaussian as four arrays."""
    return (
        np.array([mean], np.float32),
        (variance * np.eye(3, dtype=np.float32))[None],
        np.array([opacity], np.float32),
        np.array([color], np.float32),
    )


def cloud(n: int, seed: int = 0, spread: float = 0.8, size: float = 0.09):
    """Anisotropic Gaussians around the origin, opacities .2 to .95 (clear of both clamps)."""
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(n, 3, 3)) * size
    return (
        rng.normal(size=(n, 3)) * spread,
        factors @ factors.transpose(0, 2, 1),
        rng.uniform(0.2, 0.95, n),
        rng.uniform(0, 1, (n, 3)),
    )


def test_one_gaussian_has_the_closed_form_at_every_pixel():
    # Mean on the axis at depth 5: centred on (24, 20), variance (50/5)^2 * 0.01 + 0.3 px^2.
    rgb, alpha = rasterize_arrays(*one((0, 0, 5)), facing_camera())
    rows, columns = np.mgrid[:40, :48] + 0.5
    squared = (columns - 24) ** 2 + (rows - 20) ** 2
    expected = 0.5 * np.exp(-squared / (2 * 1.3))
    expected[expected < 1 / 255] = 0
    np.testing.assert_allclose(alpha, expected, atol=2e-6)
    np.testing.assert_allclose(rgb, expected[..., None] * [1.0, 0.5, 0.25], atol=2e-6)


def test_pixel_centres_lie_at_one_half():
    # A mean that projects to (10.5, 7.5) is brightest in row 7, column 10.
    _, alpha = rasterize_arrays(*one(((10.5 - 24) / 10, (7.5 - 20) / 10, 5.0)), facing_camera())
    assert np.unravel_index(alpha.argmax(), alpha.shape) == (7, 10)
    assert alpha[7, 10] == pytest.approx(0.5, abs=1e-6)


def test_the_nearer_gaussian_hides_the_farther_whatever_their_order():
    near, far = one((0, 0, 4), opacity=0.8, color=(1, 0, 0)), one((0, 0, 6), opacity=0.8, color=(0, 1, 0))
    forward = [np.concatenate(pair) for pair in zip(near, far)]
    swapped = [np.concatenate(pair) for pair in zip(far, near)]
    K_centre = facing_camera(cx=24.5, cy=20.5)
    rgb, alpha = rasterize_arrays(*forward, K_centre)
    np.testing.assert_array_equal(rgb, rasterize_arrays(*swapped, K_centre)[0])
    np.testing.assert_allclose(rgb[20, 24], [0.8, 0.2 * 0.8, 0.0], atol=1e-6)
    assert alpha[20, 24] == pytest.approx(1 - 0.2 * 0.2, abs=1e-6)


def test_alpha_is_clamped_and_what_would_exhaust_a_pixel_is_left_out():
    # Two opaque ones: the first is clamped to .999, the second would leave 1e-6 < 1e-4 and is not drawn.
    pair = [np.concatenate(p) for p in zip(one((0, 0, 4), 0.5, 1.0, (1, 0, 0)), one((0, 0, 6), 0.5, 1.0, (0, 1, 0)))]
    rgb, alpha = rasterize_arrays(*pair, facing_camera(cx=24.5, cy=20.5))
    np.testing.assert_allclose(rgb[20, 24], [0.999, 0, 0], atol=1e-6)
    assert alpha[20, 24] == pytest.approx(0.999, abs=1e-6)


@pytest.mark.parametrize("background", [None, "flat", "image"])
def test_images_match_the_definition(background):
    camera = turned_camera()
    arrays = cloud(400)
    behind = {
        None: None,
        "flat": np.array([0.2, 0.3, 0.4]),
        "image": np.random.default_rng(1).uniform(size=(camera.height, camera.width, 3)),
    }[background]
    rgb, alpha = rasterize_arrays(*arrays, camera, background=behind)
    tensors = [torch.as_tensor(a) for a in arrays]
    # float32 rounds the threshold 1/255 differently at a few pixels, hence half a grey level at most.
    expected, expected_alpha = reference.rasterize(
        *tensors, camera, None if behind is None else torch.as_tensor(behind)
    )
    assert (alpha > 0.5).mean() > 0.2
    np.testing.assert_allclose(rgb, expected.numpy(), atol=2e-3)
    np.testing.assert_allclose(alpha, expected_alpha.numpy(), atol=2e-3)
    assert np.abs(rgb - expected.numpy()).mean() < 1e-6


def loss_gradients(render, arrays, camera, dtype, background=None):
    """Gradients of a fixed random linear function of both images."""
    inputs = [torch.tensor(a, dtype=dtype, requires_grad=True) for a in arrays]
    rgb, alpha = render(*inputs, camera, background=background)
    generator = torch.Generator().manual_seed(5)
    weights = torch.randn(rgb.shape, generator=generator).to(dtype)
    alpha_weights = torch.randn(alpha.shape, generator=generator).to(dtype)
    ((rgb * weights).sum() + (alpha * alpha_weights).sum()).backward()
    return [tensor.grad.double().numpy() for tensor in inputs]


@pytest.mark.parametrize("camera", [facing_camera(), turned_camera()], ids=["facing", "turned"])
def test_gradients_match_the_definition(camera):
    arrays = cloud(300, seed=2)
    if camera.name == "1":
        arrays = (arrays[0] + [0, 0, 5.0], *arrays[1:])
    behind = torch.tensor([0.2, 0.3, 0.4])
    fast = loss_gradients(rasterize, arrays, camera, torch.float32, behind)
    slow = loss_gradients(reference.rasterize, arrays, camera, torch.float64, behind.double())
    for name, got, expected in zip(("means", "covariances", "opacities", "colors"), fast, slow):
        error = np.linalg.norm(got - expected) / np.linalg.norm(expected)
        assert error < 3e-4, f"{name}: {error}"


def test_gradients_hold_where_the_jacobian_is_clamped():
    # Large Gaussians centred beyond 15% outside the image still reach into it.
    camera = facing_camera()
    means = np.array([[3.6, 0.1, 5.0], [-0.1, -3.3, 5.0], [-3.6, 3.1, 5.0]])
    arrays = (means, np.stack([np.diag([0.9, 0.7, 0.8])] * 3), np.full(3, 0.8), np.random.default_rng(0).random((3, 3)))
    fast = loss_gradients(rasterize, arrays, camera, torch.float32)
    slow = loss_gradients(reference.rasterize, arrays, camera, torch.float64)
    for got, expected in zip(fast, slow):
        assert np.linalg.norm(expected) > 0
        np.testing.assert_allclose(got, expected, rtol=2e-3, atol=2e-3 * np.abs(expected).max())


def test_clamped_alpha_passes_no_gradient_to_opacity():
    inputs = [torch.tensor(a, requires_grad=True) for a in one((0, 0, 5), variance=4.0, opacity=1.0)]
    camera = facing_camera(3, 3, 1.5, 1.5)
    rasterize(*inputs, camera)[0][1, 1].sum().backward()
    assert inputs[2].grad.item() == 0
    assert inputs[3].grad.sum().item() == pytest.approx(3 * 0.999, abs=1e-5)


def test_the_definition_has_the_gradient_of_finite_differences():
    camera = facing_camera(8, 6, 4.3, 2.9)
    means, covariances, opacities, colors = cloud(3, seed=4, spread=0.1, size=0.1)
    factors = torch.linalg.cholesky(torch.as_tensor(covariances + 0.01 * np.eye(3)))

    def images(mean, factor, opacity, color):
        return reference.rasterize(mean, factor @ factor.transpose(1, 2), opacity, color, camera)

    inputs = [
        torch.as_tensor(means + np.array([0, 0, 5.0])),
        factors,
        torch.as_tensor(opacities),
        torch.as_tensor(colors),
    ]
    assert torch.autograd.gradcheck(images, [t.clone().requires_grad_() for t in inputs], eps=1e-6, atol=1e-5)


def test_skipped_tiles_hold_the_background_and_the_others_are_untouched():
    camera = turned_camera()
    arrays = cloud(400)
    pixels = np.zeros((camera.height, camera.width), bool)
    pixels[20:24, 30:34] = True
    mask = tile_mask(pixels)
    assert 0 < mask.sum() < mask.size
    whole, whole_alpha = rasterize_arrays(*arrays, camera, background=np.array([0.1, 0.2, 0.3]))
    part, part_alpha = rasterize_arrays(*arrays, camera, background=np.array([0.1, 0.2, 0.3]), tile_mask=mask)
    covered = np.repeat(np.repeat(mask, 16, 0), 32, 1)[: camera.height, : camera.width]
    np.testing.assert_array_equal(part[covered], whole[covered])
    np.testing.assert_array_equal(part_alpha[covered], whole_alpha[covered])
    assert (part_alpha[~covered] == 0).all()
    np.testing.assert_allclose(part[~covered], np.broadcast_to([0.1, 0.2, 0.3], part[~covered].shape), rtol=1e-6)


def test_masked_gradients_are_those_of_a_loss_inside_the_mask():
    camera = turned_camera()
    arrays = cloud(200, seed=3)
    pixels = np.zeros((camera.height, camera.width), bool)
    pixels[16:32, 32:64] = True
    gradients = []
    for mask in (None, tile_mask(pixels)):
        inputs = [torch.tensor(a, dtype=torch.float32, requires_grad=True) for a in arrays]
        rgb, alpha = rasterize(*inputs, camera, tile_mask=mask)
        ((rgb**2).sum(-1) + alpha)[torch.as_tensor(pixels)].sum().backward()
        gradients.append([tensor.grad.numpy() for tensor in inputs])
    for whole, part in zip(*gradients):
        assert np.abs(whole).max() > 0
        np.testing.assert_allclose(part, whole, rtol=1e-4, atol=1e-5 * np.abs(whole).max())

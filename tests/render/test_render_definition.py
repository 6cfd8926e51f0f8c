"""The CPU renderer against closed forms and against the definition in reference.py."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from splashbench.render import rasterize, rasterize_arrays
from splashbench.scene.camera import Camera

NAMES = ("means", "factors", "opacities", "colors")


def facing_camera(width: int = 48, height: int = 40, cx: float = 24.0, cy: float = 20.0) -> Camera:
    """A camera at the origin looking along +z, 50 px of focal length."""
    K = np.array([[50.0, 0, cx], [0, 50.0, cy], [0, 0, 1]])
    return Camera("1", width, height, K, np.eye(4))


def turned_camera(width: int = 167, height: int = 85) -> Camera:
    """A camera turned about y, its principal point well off the center, sizes no multiple of a tile."""
    c, s = math.cos(0.3), math.sin(0.3)
    w2c = np.array([[c, 0, s, 0.1], [0, 1, 0, -0.05], [-s, 0, c, 4.0], [0, 0, 0, 1]])
    K = np.array([[160.0, 0, width / 2 + 9.3], [0, 152.0, height / 2 - 6.2], [0, 0, 1]])
    return Camera("2", width, height, K, w2c)


def one(mean, deviation=0.1, opacity=0.5, color=(1.0, 0.5, 0.25)):
    """One isotropic Gaussian as four arrays."""
    return (
        np.array([mean], np.float32),
        (deviation * np.eye(3, dtype=np.float32))[None],
        np.array([opacity], np.float32),
        np.array([color], np.float32),
    )


def cloud(n: int, seed: int = 0, spread: float = 0.8, size: float = 0.09, channels: int = 3):
    """Anisotropic Gaussians around the origin, opacities .2 to .95 (clear of both clamps)."""
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=(n, 3)) * spread,
        rng.normal(size=(n, 3, 3)) * size,
        rng.uniform(0.2, 0.95, n),
        rng.uniform(0, 1, (n, channels)),
    )


def stacked(*gaussians):
    return [np.concatenate(arrays) for arrays in zip(*gaussians)]


def test_one_gaussian_has_the_closed_form_at_every_pixel():
    # Mean on the axis at depth 5: centered on (24, 20), variance (50/5)^2 * 0.01 + 0.3 px^2.
    color, opacity = rasterize_arrays(*one((0, 0, 5)), facing_camera())
    rows, columns = np.mgrid[:40, :48] + 0.5
    squared = (columns - 24) ** 2 + (rows - 20) ** 2
    expected = 0.5 * np.exp(-squared / (2 * 1.3))
    expected[expected < 1 / 255] = 0
    np.testing.assert_allclose(opacity, expected, atol=2e-6)
    np.testing.assert_allclose(color, expected[..., None] * [1.0, 0.5, 0.25], atol=2e-6)


def test_pixel_centers_lie_at_one_half():
    # A mean that projects to (10.5, 7.5) is brightest in row 7, column 10.
    _, opacity = rasterize_arrays(*one(((10.5 - 24) / 10, (7.5 - 20) / 10, 5.0)), facing_camera())
    assert np.unravel_index(opacity.argmax(), opacity.shape) == (7, 10)
    assert opacity[7, 10] == pytest.approx(0.5, abs=1e-6)


def test_the_nearer_gaussian_hides_the_farther_whatever_their_order():
    near, far = one((0, 0, 4), opacity=0.8, color=(1, 0, 0)), one((0, 0, 6), opacity=0.8, color=(0, 1, 0))
    camera = facing_camera(cx=24.5, cy=20.5)
    color, opacity = rasterize_arrays(*stacked(near, far), camera)
    np.testing.assert_array_equal(color, rasterize_arrays(*stacked(far, near), camera)[0])
    np.testing.assert_allclose(color[20, 24], [0.8, 0.2 * 0.8, 0.0], atol=1e-6)
    assert opacity[20, 24] == pytest.approx(1 - 0.2 * 0.2, abs=1e-6)


def test_at_equal_depth_the_first_hides_the_second():
    red, green = one((0, 0, 4), opacity=0.8, color=(1, 0, 0)), one((0, 0, 4), opacity=0.8, color=(0, 1, 0))
    camera = facing_camera(cx=24.5, cy=20.5)
    np.testing.assert_allclose(rasterize_arrays(*stacked(red, green), camera)[0][20, 24], [0.8, 0.16, 0], atol=1e-6)
    np.testing.assert_allclose(rasterize_arrays(*stacked(green, red), camera)[0][20, 24], [0.16, 0.8, 0], atol=1e-6)


def test_alpha_is_clamped_and_what_would_exhaust_a_pixel_is_left_out():
    # Two opaque ones: the first is clamped to .999, the second would leave 1e-6 < 1e-4 and is not drawn.
    pair = stacked(one((0, 0, 4), 0.7, 1.0, (1, 0, 0)), one((0, 0, 6), 0.7, 1.0, (0, 1, 0)))
    color, opacity = rasterize_arrays(*pair, facing_camera(cx=24.5, cy=20.5))
    np.testing.assert_allclose(color[20, 24], [0.999, 0, 0], atol=1e-6)
    assert opacity[20, 24] == pytest.approx(0.999, abs=1e-6)


def test_depth_is_the_weighted_depth_of_the_means():
    camera = facing_camera(cx=24.5, cy=20.5)
    pair = stacked(one((0, 0, 4), opacity=0.5), one((0, 0, 6), opacity=0.8))
    color, opacity = rasterize_arrays(*pair, camera, background=np.ones(3), depth=True)
    assert color.shape == (40, 48, 4)
    assert color[20, 24, 3] == pytest.approx(0.5 * 4 + 0.5 * 0.8 * 6, abs=1e-5)
    assert color[0, 0].tolist() == [1, 1, 1, 0]
    np.testing.assert_array_equal(rasterize_arrays(*pair, camera)[1], opacity)


@pytest.mark.parametrize("background", [None, "flat", "image"])
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 7, 32])
def test_images_match_the_definition(reference, background, channels):
    camera = turned_camera()
    arrays = cloud(400, channels=channels)
    behind = {
        None: None,
        "flat": np.linspace(0.1, 0.9, channels),
        "image": np.random.default_rng(1).uniform(size=(camera.height, camera.width, channels)),
    }[background]
    color, opacity = rasterize_arrays(*arrays, camera, background=behind, depth=channels % 2 == 0)
    tensors = [torch.as_tensor(a) for a in arrays]
    expected, expected_opacity = reference.rasterize(
        *tensors, camera, background=None if behind is None else torch.as_tensor(behind), depth=channels % 2 == 0
    )
    smooth = ~reference.threshold_pixels(*tensors[:3], camera).numpy()
    assert (opacity > 0.5).mean() > 0.2
    assert smooth.mean() > 0.7
    np.testing.assert_allclose(color[smooth], expected.numpy()[smooth], atol=2e-5)
    np.testing.assert_allclose(opacity[smooth], expected_opacity.numpy()[smooth], atol=2e-5)
    # Elsewhere rounding may drop or draw a Gaussian at the faintest visible alpha.
    np.testing.assert_allclose(opacity, expected_opacity.numpy(), atol=1 / 254)


def loss_gradients(render, arrays, camera, dtype, weights, **options):
    """Gradients of a fixed random linear function of both images, its pixels weighted by `weights` [H, W]."""
    inputs = [torch.tensor(a, dtype=dtype, requires_grad=True) for a in arrays]
    color, opacity = render(*inputs, camera, **options)
    generator = torch.Generator().manual_seed(5)
    color_weights = torch.randn(color.shape, generator=generator).to(dtype) * weights[..., None]
    opacity_weights = torch.randn(opacity.shape, generator=generator).to(dtype) * weights
    ((color * color_weights).sum() + (opacity * opacity_weights).sum()).backward()
    return [tensor.grad.double().numpy() for tensor in inputs]


@pytest.mark.parametrize("camera", [facing_camera(), turned_camera()], ids=["facing", "turned"])
@pytest.mark.parametrize("channels", [1, 3, 4, 6])
def test_gradients_match_the_definition(reference, camera, channels):
    arrays = cloud(300, seed=2, channels=channels)
    if camera.name == "1":
        arrays = (arrays[0] + [0, 0, 5.0], *arrays[1:])
    behind = torch.linspace(0.2, 0.5, channels, dtype=torch.float64)
    options = {"depth": channels == 6}
    tensors = [torch.as_tensor(a) for a in arrays]
    smooth = torch.where(reference.threshold_pixels(*tensors[:3], camera), 0.0, 1.0)
    fast = loss_gradients(rasterize, arrays, camera, torch.float32, smooth, background=behind, **options)
    slow = loss_gradients(reference.rasterize, arrays, camera, torch.float64, smooth, background=behind, **options)
    for name, got, expected in zip(NAMES, fast, slow):
        error = np.linalg.norm(got - expected) / np.linalg.norm(expected)
        assert error <= 2e-5, f"{name}: {error}"


def test_gradients_hold_where_the_jacobian_is_clamped(reference):
    # Large Gaussians centered beyond 15% outside the image still reach into it.
    camera = facing_camera()
    means = np.array([[3.6, 0.1, 5.0], [-0.1, -3.3, 5.0], [-3.6, 3.1, 5.0]])
    arrays = (
        means,
        np.stack([np.diag([0.95, 0.84, 0.9])] * 3),
        np.full(3, 0.8),
        np.random.default_rng(0).random((3, 3)),
    )
    smooth = torch.where(reference.threshold_pixels(*map(torch.as_tensor, arrays[:3]), camera), 0.0, 1.0)
    fast = loss_gradients(rasterize, arrays, camera, torch.float32, smooth)
    slow = loss_gradients(reference.rasterize, arrays, camera, torch.float64, smooth)
    for got, expected in zip(fast, slow):
        assert np.linalg.norm(expected) > 0
        np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_a_needle_askew_keeps_its_digits(reference):
    # 400 px long and half a pixel thick at 45 degrees: its conic's entries are a million times their difference.
    camera = Camera("1", 640, 640, np.array([[900.0, 0, 320], [0, 900.0, 320], [0, 0, 1]]), np.eye(4))
    direction = np.array([1.0, 1.0, 0.0]) / math.sqrt(2)
    factor = np.outer(direction, [0.5, 0, 0]) + np.diag([1e-4, 1e-4, 1e-4])
    arrays = (np.array([[0.01, -0.02, 4.0]]), factor[None], np.array([0.9]), np.array([[1.0, 0.5, 0.2]]))
    _, opacity = rasterize_arrays(*arrays, camera)
    tensors = [torch.as_tensor(a) for a in arrays]
    expected = reference.rasterize(*tensors, camera)[1].numpy()
    smooth = ~reference.threshold_pixels(*tensors[:3], camera).numpy()
    assert (expected > 0.1).sum() > 500
    np.testing.assert_allclose(opacity[smooth], expected[smooth], atol=2e-5)
    weights = torch.as_tensor(smooth, dtype=torch.float64)
    fast = loss_gradients(rasterize, arrays, camera, torch.float32, weights)
    slow = loss_gradients(reference.rasterize, arrays, camera, torch.float64, weights)
    for name, got, wanted in zip(NAMES, fast, slow):
        assert np.linalg.norm(got - wanted) <= 2e-4 * np.linalg.norm(wanted), name


def test_clamped_alpha_passes_no_gradient_to_opacity():
    inputs = [torch.tensor(a, requires_grad=True) for a in one((0, 0, 5), deviation=2.0, opacity=1.0)]
    camera = facing_camera(3, 3, 1.5, 1.5)
    rasterize(*inputs, camera)[0][1, 1].sum().backward()
    assert inputs[2].grad.item() == 0
    assert inputs[3].grad.sum().item() == pytest.approx(3 * 0.999, abs=1e-5)

"""What a fit on a CUDA device computes by torch's operations is what the compiled functions of the CPU compute."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splashbench.gaussians.color_loss import _l1_by_torch, l1
from splashbench.gaussians.fitting import _loss_and_error, _on_device
from splashbench.gaussians.screen_gradients import _screen_gradients_by_torch, screen_gradients
from splashbench.gaussians.ssim import SsimTarget, ssim, ssim_by_torch
from splashbench.scene import Scene
from splashbench_methods.spacetime_gaussians.model import _rays_by_torch, rays

HEIGHT, WIDTH = 31, 44


@pytest.fixture
def image() -> torch.Tensor:
    return torch.rand(HEIGHT, WIDTH, 3).requires_grad_()


@pytest.mark.parametrize("share", [1.0, 0.6])
def test_ssim_and_its_gradient(image: torch.Tensor, share: float) -> None:
    rng = np.random.default_rng(0)
    weight = (rng.random((HEIGHT, WIDTH)) <= share).astype(np.float32)
    target = SsimTarget(rng.random((HEIGHT, WIDTH, 3)).astype(np.float32), weight)
    expected, value = ssim(image, target), ssim_by_torch(image, *target.on(image.device))
    assert float(value.detach()) == pytest.approx(float(expected.detach()), abs=1e-6)
    (theirs,), (ours,) = torch.autograd.grad(expected, image), torch.autograd.grad(value, image)
    assert float((ours - theirs).abs().max()) < 1e-5 * float(theirs.abs().max())


def test_ssim_refuses_another_size(image: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="another size"):
        ssim_by_torch(image[1:], torch.zeros(3, HEIGHT, WIDTH))


@pytest.mark.parametrize("share", [1.0, 0.6, 0.0])
def test_l1_and_its_gradient(image: torch.Tensor, share: float) -> None:
    rng = np.random.default_rng(1)
    photograph = rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    seen = rng.random((HEIGHT, WIDTH)) < share
    with pytest.raises(ValueError, match="does not compare"):
        l1(image[..., :1], photograph[..., :1], seen)  # the kernel goes by three channels
    expected, value = l1(image, photograph, seen), _l1_by_torch(image, photograph, seen)
    assert float(value.detach()) == pytest.approx(float(expected.detach()), abs=1e-6)
    (theirs,), (ours,) = torch.autograd.grad(expected, image), torch.autograd.grad(value, image)
    assert float((ours - theirs).abs().max()) < 1e-8


def test_screen_gradients(balls: Scene) -> None:
    camera = balls.cameras["1"]
    means, gradients = torch.randn(50, 3) * 0.1, torch.randn(50, 3)
    expected = screen_gradients(camera, means.numpy(), gradients.numpy())
    assert _screen_gradients_by_torch(camera, means, gradients).numpy() == pytest.approx(expected, rel=1e-5)


def test_rays(balls: Scene) -> None:
    camera = balls.cameras["2"]
    assert _rays_by_torch(camera, torch.device("cpu")).numpy() == pytest.approx(rays(camera), abs=1e-6)


def test_a_steps_loss_and_error(image: torch.Tensor) -> None:
    photograph = np.random.default_rng(2).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    (expected, their_error), (value, error) = _loss_and_error(image, photograph), _on_device(image, photograph)
    assert float(value.detach()) == pytest.approx(float(expected.detach()), abs=1e-6)
    assert float(error) == pytest.approx(float(their_error), rel=1e-5)

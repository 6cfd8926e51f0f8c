"""Photometric losses of Gaussian splatting, restricted to the pixels that carry evidence.

The structural term has its gradient written out: torch's convolutions of single-channel images are slow on a CPU, and
the target's share of the work is the same in every iteration.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2
_KERNEL = cv2.getGaussianKernel(_WINDOW, _SIGMA, cv2.CV_32F)


def _blur(image: NDArray) -> NDArray:
    """Gaussian window over [H, W, 3], zero beyond the edges; its own adjoint."""
    return cv2.sepFilter2D(image, -1, _KERNEL, _KERNEL, borderType=cv2.BORDER_CONSTANT)


class SsimTarget:
    """An image [H, W, 3] to compare with, and the pixels [H, W] (0 or 1) that count; what can be, computed once."""

    def __init__(self, image: NDArray[np.float32], weight: NDArray[np.float32]) -> None:
        self.weight = np.ascontiguousarray(weight, dtype=np.float32)[..., None]
        self.image = image * self.weight
        self.mean = _blur(self.image)
        self.variance = _blur(self.image**2) - self.mean**2


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: torch.Tensor, target: SsimTarget) -> torch.Tensor:
        a, b = image.detach().numpy() * target.weight, target.image
        mean_a, mean_b = _blur(a), target.mean
        variance_a, covariance = _blur(a * a) - mean_a**2, _blur(a * b) - mean_a * mean_b
        luminance, luminance_scale = 2 * mean_a * mean_b + _C1, mean_a**2 + mean_b**2 + _C1
        contrast, contrast_scale = 2 * covariance + _C2, variance_a + target.variance + _C2
        score = luminance * contrast / (luminance_scale * contrast_scale)
        # Derivatives of the score with respect to the moments E[a], E[a^2] and E[ab].
        by_variance = -score / contrast_scale
        by_covariance = 2 * luminance / (luminance_scale * contrast_scale)
        by_mean = 2 * mean_b * contrast / (luminance_scale * contrast_scale) - 2 * mean_a * score / luminance_scale
        by_mean -= 2 * mean_a * by_variance + mean_b * by_covariance
        gradient = _blur(by_mean) + 2 * a * _blur(by_variance) + b * _blur(by_covariance)
        ctx.gradient = torch.from_numpy(gradient * target.weight / np.float32(score.size))
        return torch.tensor(float(score.mean()))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, None]:
        return ctx.gradient * grad, None


def ssim(image: torch.Tensor, target: SsimTarget) -> torch.Tensor:
    """Mean structural similarity of float32 [H, W, 3] in [0, 1] to `target` (Wang et al. 2004; window 11)."""
    return _Ssim.apply(image, target)


def l1(image: torch.Tensor, target: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Mean absolute difference of [H, W, 3] images over the pixels where `weight` [H, W] is 1."""
    return ((image - target).abs() * weight[..., None]).sum() / (3 * weight.sum()).clamp(min=1)

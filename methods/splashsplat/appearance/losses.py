"""The seven terms of the objective (supplement, "Loss Definitions and Weights", Eqs. foreground_loss to total_loss).

Images are [h, w, 3] and masks [h, w] float tensors of one window that holds the mask, its 8-pixel margin and
everything the carriers cover; outside it rendered opacity and mask are both zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from splashbench.gaussians.ssim import ssim_by_torch

from ..kernel.window_loss import WindowLosses, WindowPhotograph, window_losses

EPSILON = 1e-6
SEPARATION_MARGIN = 0.6


@dataclass(frozen=True)
class LossWeights:
    """The paper's lambdas; and `beside`, of what photographs show beside the mask where there is glass (glass.py)."""

    foreground: float = 0.5
    gradient: float = 0.1
    ssim: float = 0.2
    silhouette: float = 0.7
    covariance: float = 0.01
    separation: float = 0.1
    color: float = 1.0
    beside: float = 0.0


def foreground_loss(image: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """L1 over the mask's pixels, normalised by their number (Eq. foreground_loss)."""
    return ((image - target).abs() * mask[..., None]).sum() / (3 * mask.sum() + EPSILON)


def beside_loss(image: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """L1 over the pixels beside the mask (bool), normalised by their number. Not in the paper."""
    beside = ~mask
    return ((image - target).abs() * beside[..., None]).sum() / (3 * beside.sum() + EPSILON)


def gradient_loss(image: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """L1 between finite differences over pixel pairs with at least one pixel in the mask (Eq. grad_loss)."""
    error = image - target
    total, pairs = image.new_zeros(()), image.new_zeros(())
    for axis in (0, 1):
        n = error.shape[axis] - 1
        difference = error.narrow(axis, 1, n) - error.narrow(axis, 0, n)
        weight = torch.maximum(mask.narrow(axis, 1, n), mask.narrow(axis, 0, n))
        total = total + (difference.abs() * weight[..., None]).sum()
        pairs = pairs + weight.sum()
    return total / (3 * pairs + EPSILON)


def silhouette_loss(alpha: Tensor, mask: Tensor, area: float) -> Tensor:
    """L1 between rendered foreground opacity and mask over `area` pixels (the paper: of the image)."""
    return (alpha - mask).abs().sum() / area


def image_terms(image: Tensor, alpha: Tensor, photograph: WindowPhotograph, with_ssim: bool = False) -> WindowLosses:
    """The losses of a window, the silhouette's summed over its pixels: on the CPU by the kernel, which works in one
    pass, and elsewhere by `image_terms_by_torch`."""
    by = window_losses if image.device.type == "cpu" else image_terms_by_torch
    return by(image, alpha, photograph, with_ssim)


def image_terms_by_torch(
    image: Tensor, alpha: Tensor, photograph: WindowPhotograph, with_ssim: bool = False
) -> WindowLosses:
    """`image_terms` by torch's operations, on the device where all lie."""
    inside, truth = image[photograph.box], photograph.image.to(torch.float32) / 255
    mask = photograph.mask.to(torch.float32)
    whole = torch.zeros_like(alpha)
    whole[photograph.box] = mask
    return WindowLosses(
        foreground_loss(inside, truth, mask),
        gradient_loss(inside, truth, mask),
        silhouette_loss(alpha, whole, area=1.0),
        ssim_by_torch(inside, truth.permute(2, 0, 1)) if with_ssim else None,
    )


def covariance_loss(factors: Tensor, voxel: float) -> Tensor:
    """Mean trace of the covariances B B^T of `factors` [..., 3, 3], in squared transport voxels so that it does not
    depend on the scene's units."""
    return (factors**2).sum((-2, -1)).mean() / voxel**2


def separation_loss(offsets: Tensor) -> Tensor:
    """Squared hinge on distances below 0.6 between the children of one carrier, offsets [n, K, 3] (Eq. sep_loss)."""
    k = offsets.shape[1]
    if k < 2:
        return offsets.new_zeros(())
    first, second = torch.triu_indices(k, k, 1)
    # The square root of zero has no gradient: a pair that coincides exactly is pushed along no direction at all.
    distance = ((offsets[:, first] - offsets[:, second]) ** 2).sum(-1).clamp_min(1e-12).sqrt()
    return ((SEPARATION_MARGIN - distance).clamp_min(0) ** 2).mean()


def color_loss(colors: Tensor, cells: Tensor, cell_sizes: Tensor) -> Tensor:
    """Variance of colour [n, K, 3] within grid cells (Eq. col_loss).

    cells: int64 [n], numbered from 0 without gaps; cell_sizes: float [cells], carriers in each.
    """
    sums = colors.new_zeros(len(cell_sizes), 3).index_add_(0, cells, colors.mean(dim=1))
    means = sums / cell_sizes[:, None]
    return ((colors - means.index_select(0, cells)[:, None]) ** 2).mean()

"""How much of a photograph each carrier makes up: the pixels that its Gaussians cover, weighted by how far they show.

A Gaussian's weight in a pixel is its opacity there times the light that those in front let through. Summed over pixels
this is the derivative of a rendered channel by the Gaussian's colour: a backward pass gives the weights of all. On the
CPU the renderer sums them while it draws, which takes a part of the time (`shares` in compositing.py).

Carriers deep in the liquid weigh next to nothing. To fit them to the photograph costs as much as any other, and Adam's
steps do not shrink with the gradient. Not in the paper.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


@torch.enable_grad()
def contributions(colors: Tensor, drawn: Callable[[Tensor], Tensor]) -> Tensor:
    """Pixels that each of n carriers makes up, float32 [n].

    colors: [n, K, 3], of their K Gaussians each. drawn: the image [h, w, 3] of the Gaussians in other colours.
    """
    colors = colors.detach().clone().requires_grad_()
    (weights,) = torch.autograd.grad(drawn(colors)[..., 0].sum(), [colors])
    return weights[..., 0].sum(dim=1)


def least(weights: Tensor, share: float) -> Tensor:
    """bool [n]: the smallest of `weights` [n], as many as together are at most `share` of all."""
    values, order = weights.to(torch.float64).sort(stable=True)
    sums = values.cumsum(0)
    chosen = torch.zeros(len(weights), dtype=torch.bool, device=weights.device)
    chosen[order[sums <= share * sums[-1:]]] = True
    return chosen

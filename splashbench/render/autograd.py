"""The renderer as a torch function: the array-level passes of cpu.py behind `torch.autograd.Function`."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splashbench.render import cpu
from splashbench.scene.camera import Camera


def _array(tensor: torch.Tensor) -> NDArray:
    return tensor.detach().to("cpu", torch.float32).contiguous().numpy()


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: torch.Tensor,
        covariances: torch.Tensor,
        opacities: torch.Tensor,
        colors: torch.Tensor,
        camera: Camera,
        background: NDArray | None,
        tile_mask: NDArray[np.bool_] | None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        inputs = (means, covariances, opacities, colors)
        rendering = cpu.forward(
            _array(means), _array(covariances), _array(opacities), _array(colors), camera, background, tile_mask
        )
        # The arrays are shared with the inputs, as with any saved tensor; here nothing would notice a change in place.
        ctx.rendering = rendering if any(tensor.requires_grad for tensor in inputs) else None
        ctx.like = [(tensor.dtype, tensor.device) for tensor in inputs]
        device = means.device
        return torch.from_numpy(rendering.rgb).to(device), torch.from_numpy(rendering.alpha).to(device)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_rgb: torch.Tensor, grad_alpha: torch.Tensor) -> tuple:
        gradients = cpu.backward(ctx.rendering, _array(grad_rgb), _array(grad_alpha))
        moved = [torch.from_numpy(gradient).to(device, dtype) for gradient, (dtype, device) in zip(gradients, ctx.like)]
        return (*moved, None, None, None)


def rasterize(
    means: torch.Tensor,
    covariances: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    camera: Camera,
    background: torch.Tensor | None = None,
    tile_mask: NDArray[np.bool_] | torch.Tensor | None = None,
    colors_needed: bool = True,
) -> tuple[torch.Tensor, torch.Tensor]:
    """See `splashbench.render.rasterize`."""
    behind = None if background is None else _array(torch.as_tensor(background))
    mask = None if tile_mask is None else np.asarray(tile_mask, dtype=bool)
    if colors_needed:
        return _Rasterize.apply(means, covariances, opacities, colors, camera, behind, mask)
    black = torch.zeros((len(means), 3), dtype=torch.float32)
    _, alpha = _Rasterize.apply(means, covariances, opacities, black, camera, None, mask)
    flat = np.zeros(3, np.float32) if behind is None else behind
    rgb = np.broadcast_to(flat, (camera.height, camera.width, 3)).copy()
    return torch.from_numpy(rgb).to(means.device), alpha

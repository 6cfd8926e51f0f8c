"""Gaussians to pixels: one differentiable function, on the CPU, with gsplat 1.5.3's conventions (constants.py).

`rasterize` takes and returns torch tensors and is differentiable; `rasterize_arrays` is the forward pass alone on numpy
arrays and needs no torch. Both give the same images bit for bit, on any number of threads.

Where the loss has nothing to say (outside the liquid's rectangle), pass a `tile_mask`: tiles that are False are not
rendered and hold the background with alpha 0. With a rectangle of one fifth of the image both passes take a third of
the time (20 000 Gaussians all over 360x240). Make it with `tile_mask(pixels)` from a bool image.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from splashbench.render import counters
from splashbench.render.constants import TILE_HEIGHT, TILE_WIDTH
from splashbench.render.cpu import forward as _forward
from splashbench.render.tiles import tile_grid, tile_mask
from splashbench.scene.camera import Camera

if TYPE_CHECKING:
    import torch

__all__ = [
    "TILE_HEIGHT", "TILE_WIDTH", "counters", "rasterize", "rasterize_arrays", "tile_grid", "tile_mask",
]  # fmt: skip


def rasterize_arrays(
    means: NDArray,
    covariances: NDArray,
    opacities: NDArray,
    colors: NDArray,
    camera: Camera,
    background: NDArray | None = None,
    tile_mask: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Render N Gaussians to (rgb float32 [H, W, 3], alpha float32 [H, W]) on numpy arrays; arguments as `rasterize`."""
    rendering = _forward(means, covariances, opacities, colors, camera, background, tile_mask)
    return rendering.rgb, rendering.alpha


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
    """Render N Gaussians to (rgb [H, W, 3], alpha [H, W]), float32; differentiable in the first four arguments.

    Args:
        means: [N, 3], scene units. covariances: [N, 3, 3], symmetric, scene units squared.
        opacities: [N] in [0, 1]; colors: [N, 3].
        camera: the view; its K may have any principal point, skew is not supported.
        background: [3] or [H, W, 3] colours seen through what stays transparent (black by default); gets no gradient.
        tile_mask: bool [tile rows, tile columns], see the module's text; all tiles by default.
        colors_needed: False renders alpha alone: rgb is then the background, without gradient.

    Gaussians with an entry that is not finite, behind the near plane, fainter than one grey level, or off the image are
    not drawn and get zero gradients. alpha is 1 minus the transmittance. Raises ValueError on wrong shapes.
    """
    from splashbench.render.autograd import rasterize as differentiable

    return differentiable(means, covariances, opacities, colors, camera, background, tile_mask, colors_needed)

"""Losses of a rendered window against a photograph and its mask, compiled, as a torch function.

With the error e = image - truth, all within the box that the photograph covers:

    foreground = sum over the mask of |e| / (3 pixels in the mask)
    gradient = sum over pairs of neighbours with at least one in the mask of |e' - e| / (3 such pairs)
    silhouette = sum over the whole window of |alpha - mask|

and SSIM of the box where it is asked for. Results and gradients do not depend on the number of threads.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from splashbench.gaussians.ssim import similarity
from splashbench.native import memory
from splashbench.native.library import DONE
from splashbench.native.threads import kernel_threads

from .library import KERNEL, WindowStruct


@dataclass(frozen=True)
class WindowPhotograph:
    """What a camera saw of a box within the window, where alone there is liquid.

    image: uint8 [rows, columns, 3]; mask: bool [rows, columns]; both contiguous. top, left: of the box.
    """

    image: Tensor
    mask: Tensor
    top: int
    left: int

    @property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns of the window."""
        rows, columns = self.mask.shape
        return slice(self.top, self.top + rows), slice(self.left, self.left + columns)

    def to(self, device: str) -> WindowPhotograph:
        """On `device`: this itself where it is there."""
        if self.image.device.type == torch.device(device).type:
            return self
        return WindowPhotograph(self.image.to(device), self.mask.to(device), self.top, self.left)


class WindowLosses(NamedTuple):
    """What is asked of a window, scalars; see above. ssim: None where it was not."""

    foreground: Tensor
    gradient: Tensor
    silhouette: Tensor
    ssim: Tensor | None = None


def window_losses(image: Tensor, alpha: Tensor, photograph: WindowPhotograph, with_ssim: bool = False) -> WindowLosses:
    """Differentiable by `image`, float32 [h, w, 3], and `alpha` [h, w].

    Raises TypeError or ValueError where these do not fit together.
    """
    truth, mask = photograph.image, photograph.mask
    if truth.dtype != torch.uint8 or mask.dtype != torch.bool or not (truth.is_contiguous() and mask.is_contiguous()):
        raise TypeError(f"the photograph is {truth.dtype} and {mask.dtype}, not contiguous uint8 and bool")
    if image.dtype != torch.float32 or alpha.dtype != torch.float32 or image.device.type != "cpu":
        raise TypeError(f"image and alpha are {image.dtype} and {alpha.dtype}, not float32 on the CPU")
    (rows, columns), (height, width) = mask.shape, alpha.shape
    if tuple(image.shape) != (height, width, 3) or tuple(truth.shape) != (rows, columns, 3):
        raise ValueError(f"an image {list(image.shape)} does not go with alpha {list(alpha.shape)}, nor {truth.shape}")
    inside = 0 <= photograph.top <= height - rows and 0 <= photograph.left <= width - columns
    if not inside:
        raise ValueError(
            f"a box of {columns}x{rows} px at {photograph.left}, {photograph.top} leaves {width}x{height} px"
        )
    losses = _WindowLosses.apply(image, alpha, photograph, with_ssim)
    return WindowLosses(losses[0], losses[1], losses[2], losses[3] if with_ssim else None)


def _run(function: Any, photograph: WindowPhotograph, image: Tensor, alpha: Tensor, *rest: Any) -> None:
    (rows, columns), (height, width) = photograph.mask.shape, alpha.shape
    truth, mask = photograph.image.data_ptr(), photograph.mask.data_ptr()
    window = WindowStruct(width, height, photograph.left, photograph.top, columns, rows, truth, mask)
    status = function(ctypes.byref(window), image.data_ptr(), alpha.data_ptr(), *rest, kernel_threads())
    if status != DONE:
        raise MemoryError("the window's losses are out of memory")


class _WindowLosses(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, alpha: Tensor, photograph: WindowPhotograph, with_ssim: bool) -> Tensor:
        image, alpha = image.contiguous(), alpha.contiguous()
        losses = (ctypes.c_double * 3)()
        _run(KERNEL.library.splash_window_losses, photograph, image, alpha, losses)
        ctx.photograph, ctx.by_ssim = photograph, None
        ctx.save_for_backward(image, alpha)
        found = list(losses)
        if with_ssim:
            value, by_ssim = similarity(image.detach().numpy()[photograph.box], photograph.image.numpy())
            ctx.by_ssim = torch.from_numpy(by_ssim)
            found.append(value)
        return torch.tensor(found, dtype=torch.float32)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor, Tensor, None, None]:
        image, alpha = ctx.saved_tensors
        weights = (ctypes.c_double * 3)(*outer[:3].tolist())
        by_image, by_alpha = (torch.from_numpy(memory.empty(tuple(t.shape))) for t in (image, alpha))
        function = KERNEL.library.splash_window_gradients
        _run(function, ctx.photograph, image, alpha, weights, by_image.data_ptr(), by_alpha.data_ptr())
        if ctx.by_ssim is not None:
            scaled = torch.from_numpy(memory.empty(tuple(ctx.by_ssim.shape)))
            by_image[ctx.photograph.box] += torch.mul(ctx.by_ssim, outer[3], out=scaled)
        return by_image, by_alpha, None, None

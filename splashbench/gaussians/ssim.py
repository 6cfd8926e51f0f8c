"""SSIM as a training loss, with its gradient, by the compiled kernel (Wang et al. 2004).

11x11 Gaussian window, sigma 1.5, zeros beyond the border. Mean over pixels and channels of

    (2 ma mb + C1)(2 cov + C2) / ((ma^2 + mb^2 + C1)(va + vb + C2)),

the moments under the window. The window is symmetric, so the gradient is three more blurs. On a CUDA device both are
torch's convolutions. Scores use the protocol's SSIM instead (splashbench.score).
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, Structure, c_double, c_float, c_int32, c_int64, c_void_p
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splashbench.native import memory
from splashbench.native.library import DONE, CompiledKernel
from splashbench.native.threads import kernel_threads

_RADIUS = 5
_SIGMA = 1.5
_C1, _C2 = np.float32(0.01**2), np.float32(0.03**2)
_offsets = np.arange(-_RADIUS, _RADIUS + 1)
_WINDOW = np.exp(-(_offsets**2) / (2 * _SIGMA**2))
_WINDOW = (_WINDOW / _WINDOW.sum()).astype(np.float32)


class _Images(Structure):
    """SplashSsim of api.h."""

    _fields_ = (
        ("height", c_int32),
        ("width", c_int32),
        ("channels", c_int32),
        ("image", c_void_p),
        ("stride", c_int64),
        ("truth", c_void_p),
        ("truth_bytes", c_void_p),
        ("weight", c_void_p),
        ("window", c_void_p),
        ("c1", c_float),
        ("c2", c_float),
    )


KERNEL = CompiledKernel(
    "gaussians",
    Path(__file__).parent / "kernel",
    abi_version=1,
    functions={"splash_ssim": (c_int32, (POINTER(_Images), c_void_p, c_void_p, c_int32))},
)


def similarity(
    image: NDArray[np.float32],
    truth: NDArray[Any],
    weight: NDArray[np.float32] | None = None,
) -> tuple[float, NDArray[np.float32]]:
    """SSIM of `image` [h, w, channels] in [0, 1] to `truth` of the same shape, and its gradient by the image, float32
    of that shape. The same bits on any processor and any number of threads.

    image: its rows may lie apart, as those of a part of another image. truth: in [0, 1], or uint8 in 255ths. weight:
    [h, w], what the image is multiplied by before, and its gradient afterwards; `truth` has it already.

    Raises ValueError where they are not of one size, and TypeError for other types.
    """
    if image.dtype != np.float32 or truth.dtype not in (np.float32, np.uint8):
        raise TypeError(f"images of {image.dtype} and {truth.dtype} are not float32, the second one also uint8")
    if image.ndim != 3 or image.shape != truth.shape:
        raise ValueError(f"an image of {image.shape} does not compare with one of another size, {truth.shape}")
    if weight is not None and (weight.shape != image.shape[:2] or weight.dtype != np.float32):
        raise ValueError(f"a weight {weight.dtype} {weight.shape} does not go with an image of {image.shape}")
    if image.size == 0:
        raise ValueError(f"an image of {image.shape} has no pixels to compare")
    height, width, channels = image.shape
    if image.strides[1:] != (4 * channels, 4) or image.strides[0] % 4 or image.strides[0] < 4 * channels * width:
        image = np.ascontiguousarray(image)
    truth = np.ascontiguousarray(truth)
    weight = None if weight is None else np.ascontiguousarray(weight)
    totals, gradient = (c_double * channels)(), memory.empty(image.shape)
    images = _Images(
        height,
        width,
        channels,
        image.ctypes.data,
        image.strides[0] // 4,
        truth.ctypes.data if truth.dtype == np.float32 else None,
        truth.ctypes.data if truth.dtype == np.uint8 else None,
        None if weight is None else weight.ctypes.data,
        _WINDOW.ctypes.data,
        float(_C1),
        float(_C2),
    )
    if KERNEL.library.splash_ssim(ctypes.byref(images), totals, gradient.ctypes.data, kernel_threads()) != DONE:
        raise MemoryError("SSIM is out of memory")
    return float(np.sum(totals) / image.size), gradient


class SsimTarget:
    """An image to compare with.

    image: float32 [h, w, channels]. weight: [h, w], 0 or 1, the pixels that count; the others are black in both images,
    and carry no gradient. All count by default.
    """

    def __init__(self, image: Tensor | NDArray[np.float32], weight: NDArray[np.float32] | None = None) -> None:
        self.weight = None if weight is None else np.ascontiguousarray(weight, np.float32)
        whole = np.ascontiguousarray(image, np.float32)
        self.image: NDArray[np.float32] = whole if self.weight is None else whole * self.weight[..., None]
        self._on_device: dict[torch.device, tuple[Tensor, Tensor | None]] = {}

    def on(self, device: torch.device) -> tuple[Tensor, Tensor | None]:
        """The image [channels, h, w] and the weight [h, w] on `device`, moved there once."""
        if device not in self._on_device:
            weight = None if self.weight is None else torch.from_numpy(self.weight).to(device)
            planes = np.ascontiguousarray(self.image.transpose(2, 0, 1))
            self._on_device[device] = torch.from_numpy(planes).to(device), weight
        return self._on_device[device]


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: SsimTarget) -> Tensor:
        value, gradient = similarity(image.detach().numpy(), target.image, target.weight)
        ctx.gradient = torch.from_numpy(gradient)
        return image.new_tensor(value)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor, None]:
        return outer * ctx.gradient, None


def ssim(image: Tensor, target: SsimTarget) -> Tensor:
    """SSIM of a float32 image [h, w, channels] in [0, 1] to `target`, differentiable by the image."""
    elsewhere = image.device.type != "cpu"
    return ssim_by_torch(image, *target.on(image.device)) if elsewhere else _Ssim.apply(image, target)


def ssim_by_torch(image: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """`ssim` by torch's operations, on the device where all lie.

    image: float32 [h, w, channels] in [0, 1]. target: [channels, h, w], zero where it does not count. weight: [h, w].
    """
    return _SsimByTorch.apply(image, target, weight)


class _SsimByTorch(torch.autograd.Function):
    """`_Ssim` by torch's operations; the formulas are those of the kernel."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, b: Tensor, weight: Tensor | None) -> Tensor:
        a = image.detach().permute(2, 0, 1)
        if a.shape != b.shape:
            raise ValueError(f"an image of {tuple(image.shape)} does not compare with one of another size")
        if weight is not None:
            a = a * weight
        mean_a, mean_b, square_a, square_b, product = _blurred(torch.stack([a, b, a * a, b * b, a * b]))
        squares = mean_a * mean_a + mean_b * mean_b
        luminance = 2 * mean_a * mean_b + float(_C1)
        structure = 2 * (product - mean_a * mean_b) + float(_C2)
        by_means = 1 / (squares + float(_C1))
        by_variances = 1 / (square_a + square_b - squares + float(_C2))
        value = luminance * structure * by_means * by_variances
        by_mean = 2 * mean_b * (structure - luminance) * by_means * by_variances
        by_mean = by_mean - 2 * mean_a * value * (by_means - by_variances)
        outer = torch.stack([by_mean, -value * by_variances, 2 * luminance * by_means * by_variances])
        first, second, third = _blurred(outer)
        gradient = first + 2 * a * second + b * third
        if weight is not None:
            gradient = gradient * weight
        ctx.gradient = gradient.permute(1, 2, 0) / a.numel()
        return value.mean()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor, None, None]:
        return outer * ctx.gradient, None, None


@lru_cache
def _window_on(device: torch.device) -> Tensor:
    return torch.from_numpy(_WINDOW).to(device)


def _blurred(images: Tensor) -> Tensor:
    """The window over each of `images` [n, channels, h, w], zero beyond the border."""
    flat = images.flatten(0, 1)[:, None]
    window = _window_on(images.device)
    # TF32, which cuDNN takes where it may, would spoil the variances: differences of nearly equal squares.
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        flat = torch.nn.functional.conv2d(flat, window.view(1, 1, -1, 1), padding=(_RADIUS, 0))
        flat = torch.nn.functional.conv2d(flat, window.view(1, 1, 1, -1), padding=(0, _RADIUS))
    return flat.view(images.shape)

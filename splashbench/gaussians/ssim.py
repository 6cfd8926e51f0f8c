"""SSIM as a training loss, with its gradient, compiled (Wang et al. 2004).

11x11 Gaussian window, sigma 1.5, zeros beyond the border. Mean over pixels and channels of

    (2 ma mb + C1)(2 cov + C2) / ((ma^2 + mb^2 + C1)(va + vb + C2)),

the moments under the window. The window is symmetric, so the gradient is three more blurs. Ten times faster than
torch's convolutions, which took a third of a fit; on a CUDA device it is those. Scores use the protocol's SSIM instead
(splashbench.score).
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splashbench.parallel import over_range

_RADIUS = 5
_SIGMA = 1.5
_C1, _C2 = np.float32(0.01**2), np.float32(0.03**2)
_offsets = np.arange(-_RADIUS, _RADIUS + 1)
_WINDOW = np.exp(-(_offsets**2) / (2 * _SIGMA**2))
_WINDOW = (_WINDOW / _WINDOW.sum()).astype(np.float32)


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _add(row: np.ndarray, weight: np.float32, source: np.ndarray) -> None:
    """row += weight * source, in a form that the compiler vectorises."""
    for x in range(row.shape[0]):
        row[x] += weight * source[x]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _blur(image: np.ndarray, padded_row: np.ndarray, out: np.ndarray) -> None:
    """Both passes of the separable window over [h, w] float32, zero beyond the border; padded_row: [w + 10], zeros."""
    height, width = image.shape
    inner = padded_row[_RADIUS : _RADIUS + width]
    for y in range(height):
        inner[:] = 0
        for source in range(max(0, y - _RADIUS), min(height, y + _RADIUS + 1)):
            _add(inner, _WINDOW[source - y + _RADIUS], image[source])
        row = out[y]
        row[:] = 0
        for tap in range(2 * _RADIUS + 1):
            _add(row, _WINDOW[tap], padded_row[tap : tap + width])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _blurred_product(a: np.ndarray, b: np.ndarray, product: np.ndarray, row: np.ndarray, out: np.ndarray) -> None:
    """Window over a * b, all [h, w]; product: scratch."""
    for y in range(a.shape[0]):
        for x in range(a.shape[1]):
            product[y, x] = a[y, x] * b[y, x]
    _blur(product, row, out)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _target_moments(image: np.ndarray, mean: np.ndarray, square: np.ndarray, start: int, stop: int) -> None:
    """Windows over the image and its square; all [channels, h, w]."""
    height, width = image.shape[1:]
    row = np.zeros(width + 2 * _RADIUS, np.float32)
    product = np.empty((height, width), np.float32)
    for channel in range(start, stop):
        _blur(image[channel], row, mean[channel])
        _blurred_product(image[channel], image[channel], product, row, square[channel])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _channels(
    a: np.ndarray,
    b: np.ndarray,
    mean: np.ndarray,
    square: np.ndarray,
    total: np.ndarray,
    gradient: np.ndarray,
    start: int,
    stop: int,
) -> None:
    """SSIM summed over the pixels of each channel, and its derivative by `a`; all but total: [channels, h, w]."""
    height, width = a.shape[1:]
    one = np.float32(1)
    two = np.float32(2)
    row = np.zeros(width + 2 * _RADIUS, np.float32)
    product = np.empty((height, width), np.float32)
    # Windows over a, a^2 and a b; their places are then taken by the derivatives with respect to them.
    moments = np.empty((3, height, width), np.float32)
    blurred = np.empty((2, height, width), np.float32)
    for channel in range(start, stop):
        first, second = a[channel], b[channel]
        _blur(first, row, moments[0])
        _blurred_product(first, first, product, row, moments[1])
        _blurred_product(first, second, product, row, moments[2])
        subtotal = 0.0
        for y in range(height):
            for x in range(width):
                mean_a, mean_b = moments[0, y, x], mean[channel, y, x]
                squares = mean_a * mean_a + mean_b * mean_b
                luminance = two * mean_a * mean_b + _C1
                structure = two * (moments[2, y, x] - mean_a * mean_b) + _C2
                by_means = one / (squares + _C1)
                by_variances = one / (moments[1, y, x] + square[channel, y, x] - squares + _C2)
                value = luminance * structure * by_means * by_variances
                subtotal += value
                moments[0, y, x] = two * mean_b * (
                    structure - luminance
                ) * by_means * by_variances - two * mean_a * value * (by_means - by_variances)
                moments[1, y, x] = -value * by_variances
                moments[2, y, x] = two * luminance * by_means * by_variances
        total[channel] = subtotal
        _blur(moments[0], row, gradient[channel])
        _blur(moments[1], row, blurred[0])
        _blur(moments[2], row, blurred[1])
        for y in range(height):
            for x in range(width):
                gradient[channel, y, x] += two * first[y, x] * blurred[0, y, x] + second[y, x] * blurred[1, y, x]


class SsimTarget:
    """An image to compare with, and what can be computed of it once.

    image: float32 [h, w, channels]. weight: [h, w], 0 or 1, the pixels that count; the others are black in both images,
    and carry no gradient. All count by default.
    """

    def __init__(self, image: Tensor | NDArray[np.float32], weight: NDArray[np.float32] | None = None) -> None:
        self.weight = None if weight is None else np.ascontiguousarray(weight, np.float32)
        self.image = self.masked(np.asarray(image))
        self._on_device: dict[torch.device, tuple[Tensor, Tensor | None]] = {}

    @cached_property
    def moments(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The windows over the image and over its square, [channels, h, w] each."""
        mean, square = np.empty_like(self.image), np.empty_like(self.image)
        over_range(_target_moments, len(self.image), self.image, mean, square)
        return mean, square

    def on(self, device: torch.device) -> tuple[Tensor, Tensor | None]:
        """The image [channels, h, w] and the weight [h, w] on `device`, moved there once."""
        if device not in self._on_device:
            weight = None if self.weight is None else torch.from_numpy(self.weight).to(device)
            self._on_device[device] = torch.from_numpy(self.image).to(device), weight
        return self._on_device[device]

    def masked(self, image: NDArray) -> NDArray[np.float32]:
        """[h, w, channels] to [channels, h, w], without the pixels that do not count."""
        planes = np.ascontiguousarray(image.transpose(2, 0, 1), np.float32)
        return planes if self.weight is None else planes * self.weight


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: SsimTarget) -> Tensor:
        a = target.masked(image.detach().numpy())
        if a.shape != target.image.shape:
            raise ValueError(f"an image of {tuple(image.shape)} does not compare with one of another size")
        total, gradient = np.zeros(len(a)), np.empty_like(a)
        over_range(_channels, len(a), a, target.image, *target.moments, total, gradient)
        if target.weight is not None:
            gradient *= target.weight
        ctx.gradient = torch.from_numpy(gradient.transpose(1, 2, 0) / np.float32(a.size))
        return image.new_tensor(total.sum() / a.size)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor, None]:
        return outer * ctx.gradient, None


def ssim(image: Tensor, target: SsimTarget) -> Tensor:
    """SSIM of a float32 image [h, w, channels] in [0, 1] to `target`, differentiable by the image."""
    return ssim_by_torch(image, *target.on(image.device)) if image.is_cuda else _Ssim.apply(image, target)


def ssim_by_torch(image: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """`ssim` by torch's operations, on the device where all lie.

    image: float32 [h, w, channels] in [0, 1]. target: [channels, h, w], zero where it does not count. weight: [h, w].
    """
    return _SsimByTorch.apply(image, target, weight)


class _SsimByTorch(torch.autograd.Function):
    """`_Ssim` by torch's operations; the formulas are those of `_channels`."""

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

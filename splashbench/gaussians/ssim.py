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
# An image of fewer pixels is worked on whole. More rows are worked on twice in narrower bands.
_BAND_PIXELS, _LEAST_ROWS = 1 << 17, 64
_offsets = np.arange(-_RADIUS, _RADIUS + 1)
_WINDOW = np.exp(-(_offsets**2) / (2 * _SIGMA**2))
_WINDOW = (_WINDOW / _WINDOW.sum()).astype(np.float32)


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _add(row: np.ndarray, weight: np.float32, source: np.ndarray) -> None:
    """row += weight * source, in a form that the compiler vectorises."""
    for x in range(row.shape[0]):
        row[x] += weight * source[x]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _blur(rows: np.ndarray, first: int, padded_row: np.ndarray, out: np.ndarray) -> None:
    """Both passes of the separable window, zero beyond `rows` [n, w] float32; padded_row: [w + 10], zeros.

    out: [m, w], the windows around `rows` from number `first` on.
    """
    height, width = rows.shape
    inner = padded_row[_RADIUS : _RADIUS + width]
    for y in range(out.shape[0]):
        inner[:] = 0
        for source in range(max(0, first + y - _RADIUS), min(height, first + y + _RADIUS + 1)):
            _add(inner, _WINDOW[source - first - y + _RADIUS], rows[source])
        row = out[y]
        row[:] = 0
        for tap in range(2 * _RADIUS + 1):
            _add(row, _WINDOW[tap], padded_row[tap : tap + width])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _blurred_product(
    a: np.ndarray, b: np.ndarray, first: int, product: np.ndarray, row: np.ndarray, out: np.ndarray
) -> None:
    """Window over a * b, both [n, w]; product: scratch of as many rows or more. For the others see `_blur`."""
    for y in range(a.shape[0]):
        for x in range(a.shape[1]):
            product[y, x] = a[y, x] * b[y, x]
    _blur(product[: a.shape[0]], first, row, out)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _band_rows(height: int, width: int) -> int:
    """How many rows are worked on at a time: all of a small image; of one of 4K so many that its scratch is small."""
    return max(1, min(height, max(_LEAST_ROWS, _BAND_PIXELS // max(1, width))))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _target_moments(image: np.ndarray, mean: np.ndarray, square: np.ndarray, start: int, stop: int) -> None:
    """Windows over the image and its square; all [channels, h, w]."""
    height, width = image.shape[1:]
    band = _band_rows(height, width)
    row = np.zeros(width + 2 * _RADIUS, np.float32)
    product = np.empty((min(height, band + 2 * _RADIUS), width), np.float32)
    for channel in range(start, stop):
        for top in range(0, height, band):
            bottom = min(height, top + band)
            around = max(0, top - _RADIUS)
            rows = image[channel, around : min(height, bottom + _RADIUS)]
            _blur(rows, top - around, row, mean[channel, top:bottom])
            _blurred_product(rows, rows, top - around, product, row, square[channel, top:bottom])


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
    """SSIM summed over the pixels of each channel, and its derivative by `a`; all but total: [channels, h, w].

    In bands of rows: scratch for whole images of 4K would take hundreds of megabytes. The derivative of a band needs
    the windows within one radius of it, and these the pixels within two.
    """
    height, width = a.shape[1:]
    band = _band_rows(height, width)
    one = np.float32(1)
    two = np.float32(2)
    row = np.zeros(width + 2 * _RADIUS, np.float32)
    product = np.empty((min(height, band + 4 * _RADIUS), width), np.float32)
    # Windows over a, a^2 and a b; their places are then taken by the derivatives with respect to them.
    # An array each, and a view of rows for each: these stay contiguous, without which loops are half as fast.
    reached = min(height, band + 2 * _RADIUS)
    of_a, of_square = np.empty((reached, width), np.float32), np.empty((reached, width), np.float32)
    of_product = np.empty((reached, width), np.float32)
    by_square, by_product = np.empty((band, width), np.float32), np.empty((band, width), np.float32)
    for channel in range(start, stop):
        subtotal = 0.0
        for top in range(0, height, band):
            bottom = min(height, top + band)
            low, high = max(0, top - _RADIUS), min(height, bottom + _RADIUS)
            lowest = max(0, low - _RADIUS)
            first = a[channel, lowest : min(height, high + _RADIUS)]
            second = b[channel, lowest : min(height, high + _RADIUS)]
            means, squares_a, products = of_a[: high - low], of_square[: high - low], of_product[: high - low]
            _blur(first, low - lowest, row, means)
            _blurred_product(first, first, low - lowest, product, row, squares_a)
            _blurred_product(first, second, low - lowest, product, row, products)
            for y in range(high - low):
                mean_row, square_row = mean[channel, low + y], square[channel, low + y]
                row_total = 0.0
                for x in range(width):
                    mean_a, mean_b = means[y, x], mean_row[x]
                    squares = mean_a * mean_a + mean_b * mean_b
                    luminance = two * mean_a * mean_b + _C1
                    structure = two * (products[y, x] - mean_a * mean_b) + _C2
                    by_means = one / (squares + _C1)
                    by_variances = one / (squares_a[y, x] + square_row[x] - squares + _C2)
                    value = luminance * structure * by_means * by_variances
                    row_total += value
                    means[y, x] = two * mean_b * (
                        structure - luminance
                    ) * by_means * by_variances - two * mean_a * value * (by_means - by_variances)
                    squares_a[y, x] = -value * by_variances
                    products[y, x] = two * luminance * by_means * by_variances
                if top <= low + y < bottom:
                    subtotal += row_total
            inner, by_a = a[channel, top:bottom], gradient[channel, top:bottom]
            target = b[channel, top:bottom]
            _blur(means, top - low, row, by_a)
            _blur(squares_a, top - low, row, by_square[: bottom - top])
            _blur(products, top - low, row, by_product[: bottom - top])
            for y in range(bottom - top):
                for x in range(width):
                    by_a[y, x] += two * inner[y, x] * by_square[y, x] + target[y, x] * by_product[y, x]
        total[channel] = subtotal


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
        gradient /= np.float32(a.size)
        ctx.gradient = torch.from_numpy(gradient.transpose(1, 2, 0))
        return image.new_tensor(total.sum() / a.size)

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

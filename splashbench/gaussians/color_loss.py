"""The colour loss over counting pixels, with its gradient, compiled: torch's passes over large images cost more.

On a CUDA device it is torch's passes, which cost little there.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray

from splashbench.parallel import over_range

_SMALLEST_ROWS = 32


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rows(
    image: np.ndarray,
    target: np.ndarray,
    seen: np.ndarray,
    scale: float,
    totals: np.ndarray,
    gradient: np.ndarray,
    start: int,
    stop: int,
) -> None:
    """Sums of absolute differences per row, and scale times their derivative by the image."""
    step = np.float32(scale)
    for y in range(start, stop):
        total = 0.0
        for x in range(image.shape[1]):
            for c in range(3):
                gradient[y, x, c] = 0
                if seen[y, x]:
                    difference = image[y, x, c] - target[y, x, c] * np.float32(1 / 255)
                    total += abs(difference)
                    gradient[y, x, c] = step * np.sign(difference)
        totals[y] = total


class _L1(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: torch.Tensor, target: NDArray[np.uint8], seen: NDArray[np.bool_]) -> torch.Tensor:
        rendered = np.ascontiguousarray(image.detach().numpy())
        scale = 1 / max(1, 3 * int(np.count_nonzero(seen)))
        totals, gradient = np.empty(len(rendered)), np.empty_like(rendered)
        over_range(_rows, len(rendered), rendered, target, seen, scale, totals, gradient, smallest=_SMALLEST_ROWS)
        ctx.gradient = torch.from_numpy(gradient)
        return image.new_tensor(totals.sum() * scale)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, outer: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        return outer * ctx.gradient, None, None


def l1(image: torch.Tensor, target: NDArray[np.uint8], seen: NDArray[np.bool_]) -> torch.Tensor:
    """Mean absolute difference of a float32 image [H, W, 3] in [0, 1] to uint8 `target`, over the pixels `seen` [H, W].

    Raises ValueError where they differ in size.
    """
    if image.shape != target.shape or target.shape != (*seen.shape, 3) or seen.ndim != 2:
        raise ValueError(f"an image of {tuple(image.shape)} does not compare with {target.shape} and {seen.shape}")
    return _l1_by_torch(image, target, seen) if image.device.type != "cpu" else _L1.apply(image, target, seen)


def _l1_by_torch(image: torch.Tensor, target: NDArray[np.uint8], seen: NDArray[np.bool_]) -> torch.Tensor:
    difference = (image - torch.tensor(target, device=image.device) / 255).abs()
    if seen.all():
        return difference.mean()
    counting = torch.tensor(seen, device=image.device)
    return (difference * counting[..., None]).sum() / max(1, 3 * int(np.count_nonzero(seen)))

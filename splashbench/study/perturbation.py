"""Worse liquid masks: a stand-in for those of an automatic segmentation (paper, supplement, "Annotation Protocol").

The paper compares raw SAM3 masks with refined ones. 8.6% of the raw masks are empty, their mean IoU is 0.772 and the
median 0.967, and refining adds almost only pixels. So a mask here loses a part and gains none, and the IoU with the
original mask is the share of pixels that remain. What is lost lies low in the image: an automatic segmentation finds
the falling stream and misses the water below. The paper gives no correlation between masks. Here frames that are hard
in one view tend to be hard in the others and a moment later.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from scipy.ndimage import gaussian_filter1d

#: bool [cameras, frames], true for masks with liquid -> share of each mask's pixels that remain, [cameras, frames].
Draw = Callable[[NDArray[np.bool_], np.random.Generator], NDArray[np.float64]]

# Most masks need almost no correction: this share of them loses less than _SLIGHT, evenly spread. With the paper's
# 8.6% of empty masks and a mean of .845 of the others it gives the paper's mean of .772 and its median of .967.
_ACCEPTED = 0.66
_SLIGHT = 0.04
_MOST_DAMAGED, _LEAST_DAMAGED = 0.02, 1.0 - _SLIGHT
# Correlation of hardness between views of one frame; its duration as a share of the sequence.
_SHARED = 0.5
_LASTING = 0.06
_TILT_DEGREES = 30.0


class EmptyMasks(BaseModel):
    """`share` of the masks that show liquid become empty."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    kind: Literal["empty_masks"]
    share: float = Field(ge=0, le=1)

    def draw(self) -> Draw:
        return empty_masks(self.share)


class MissingParts(BaseModel):
    """Masks lose parts, down to a mean IoU of `target_iou` over those that show liquid."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    kind: Literal["missing_parts"]
    target_iou: float = Field(ge=0.2, le=1)

    def draw(self) -> Draw:
        return missing_parts(self.target_iou)


Perturbation = Annotated[EmptyMasks | MissingParts, Field(discriminator="kind")]


def empty_masks(share: float) -> Draw:
    """Empties `share` of the masks with liquid, rounded to a number of masks, and leaves the others as they are."""

    def draw(wet: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.float64]:
        shares = np.ones(wet.shape)
        shares[wet] = np.where(_hardness_ranks(wet, rng) < round(share * wet.sum()), 0.0, 1.0)
        return shares

    return draw


def missing_parts(target_iou: float) -> Draw:
    """Takes little from most masks and much from the others, down to `target_iou` on average over masks with liquid."""
    slight = 1 - _SLIGHT / 2
    accepted = _ACCEPTED
    if target_iou < 1 and target_iou > accepted * slight + (1 - accepted) * _LEAST_DAMAGED:
        slight, accepted = target_iou, 1.0  # only slight damage
    elif target_iou < accepted * slight + (1 - accepted) * _MOST_DAMAGED:
        accepted = (target_iou - _MOST_DAMAGED) / (slight - _MOST_DAMAGED)
    damaged = (target_iou - accepted * slight) / (1 - accepted) if accepted < 1 else _LEAST_DAMAGED
    reach = min(damaged - _MOST_DAMAGED, _LEAST_DAMAGED - damaged)

    def remaining(quantile: NDArray[np.float64]) -> NDArray[np.float64]:
        """Share of pixels that remains, by the mask's quantile of hardness; 0 is the hardest."""
        among_damaged = quantile / max(1 - accepted, 1e-9)
        among_accepted = (quantile - (1 - accepted)) / max(accepted, 1e-9)
        return np.where(
            quantile < 1 - accepted,
            damaged + (2 * among_damaged - 1) * reach,
            slight + (2 * among_accepted - 1) * (1 - slight),
        )

    def draw(wet: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.float64]:
        shares = np.ones(wet.shape)
        quantiles = (_hardness_ranks(wet, rng) + 0.5) / max(1, wet.sum())
        shares[wet] = remaining(quantiles) if target_iou < 1 else 1.0
        return shares

    return draw


def _hardness_ranks(wet: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.int64]:
    """Rank among the masks with liquid, 0 the hardest: int [number of them]."""
    cameras, frames = wet.shape
    lasting = max(0.5, _LASTING * frames)
    noise = gaussian_filter1d(rng.normal(size=(cameras + 1, frames)), lasting, axis=1, mode="reflect")
    noise /= noise.std(axis=1, keepdims=True) + 1e-12
    hardness = np.sqrt(_SHARED) * noise[0] + np.sqrt(1 - _SHARED) * noise[1:]
    return np.argsort(np.argsort(-hardness[wet], kind="stable"), kind="stable")


def direction_of_loss(rng: np.random.Generator) -> NDArray[np.float64]:
    """Unit (x, y) in the image towards which a mask is lost: down, tilted by at most 30 degrees."""
    angle = np.radians(rng.uniform(-_TILT_DEGREES, _TILT_DEGREES))
    return np.array([np.sin(angle), np.cos(angle)])


def without_part(mask: NDArray[np.bool_], share: float, direction: NDArray[np.float64]) -> NDArray[np.bool_]:
    """`mask` [H, W] with `share` of its pixels, those least far in `direction` (x, y; y down)."""
    rows, columns = np.nonzero(mask)
    count = round(share * len(rows))
    nearest = np.argsort(columns * direction[0] + rows * direction[1], kind="stable")[:count]
    result = np.zeros_like(mask)
    result[rows[nearest], columns[nearest]] = True
    return result

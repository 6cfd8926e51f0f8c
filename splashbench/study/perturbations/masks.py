"""Worse liquid masks: those of an automatic segmentation (paper, supplement, "Annotation Protocol"), and simpler harm.

The paper compares raw SAM3 masks with refined ones. 8.6% of the raw masks are empty, their mean IoU is 0.772 and the
median 0.967, and refining adds almost only pixels. So a mask of `EmptyMasks` and `MissingParts` loses a part and gains
none, and the IoU with the original mask is the share of pixels that remain. What is lost lies low in the image: an
automatic segmentation finds the falling stream and misses the water below. The paper gives no correlation between
masks. Here frames that are hard in one view tend to be hard in the others and a moment later.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import ClassVar, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import gaussian_filter1d

from .recording import Dice, Recording, Step

#: bool [cameras, frames], true for masks with liquid -> share of each mask's pixels that remain, [cameras, frames].
Draw = Callable[[NDArray[np.bool_], np.random.Generator], NDArray[np.float64]]
_Mask = NDArray[np.bool_]

# Most masks need almost no correction: this share of them loses less than _SLIGHT, evenly spread. With the paper's
# 8.6% of empty masks and a mean of .845 of the others it gives the paper's mean of .772 and its median of .967.
_ACCEPTED = 0.66
_SLIGHT = 0.04
_MOST_DAMAGED, _LEAST_DAMAGED = 0.02, 1.0 - _SLIGHT
# Correlation of hardness between views of one frame; its duration as a share of the sequence.
_SHARED = 0.5
_LASTING = 0.06
_TILT_DEGREES = 30.0
# Holes and flickering outlines: their size as a share of the image's longest side.
_BLOT = 0.02


class MaskShare(Step):
    """Masks of which a share of the pixels remains. Several of these are drawn together, see `with_shares`."""

    def draw(self) -> Draw:
        """What draws the shares."""
        raise NotImplementedError

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        return with_shares(recording, (self,), dice)


class EmptyMasks(MaskShare):
    """`share` of the masks that show liquid become empty."""

    kind: Literal["empty_masks"]
    share: float = Field(ge=0, le=1)
    unit: ClassVar[str] = "share of masks"
    remedy: ClassVar[str] = "Look through masks (`splashbench masks sheet`), and mend or leave out those that failed."
    ladder: ClassVar[tuple[float, ...]] = (0.02, 0.05, 0.086, 0.15, 0.3)
    measured: ClassVar[str] = "share"

    def draw(self) -> Draw:
        return empty_masks(self.share)


class MissingParts(MaskShare):
    """Masks lose parts, down to a mean IoU of `target_iou` over those that show liquid."""

    kind: Literal["missing_parts"]
    target_iou: float = Field(ge=0.2, le=1)
    unit: ClassVar[str] = "IoU with the true mask"
    remedy: ClassVar[str] = "Mend masks that miss parts: most of all lower ones, which hide in highlights."
    ladder: ClassVar[tuple[float, ...]] = (0.96, 0.9, 0.77, 0.6, 0.36)
    measured: ClassVar[str] = "target_iou"
    none: ClassVar[float] = 1.0

    def draw(self) -> Draw:
        return missing_parts(self.target_iou)


def with_shares(recording: Recording, steps: Sequence[MaskShare], dice: Dice) -> Recording:
    """`recording` with what `steps` leave of its masks; shares of one mask are multiplied."""

    @cache
    def drawn() -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Of each view the shares of its masks, and the direction in which they lose."""
        rng, frames = dice.all(), range(recording.n_frames)
        wet = np.array([[recording.mask(name, t).any() for t in frames] for name in recording.views])
        shares = np.ones(wet.shape)
        for step in steps:
            shares *= step.draw()(wet, rng)
        return {name: (of_view, direction_of_loss(rng)) for name, of_view in zip(recording.views, shares)}

    def change(name: str, t: float, mask: _Mask) -> _Mask:
        shares, direction = drawn()[name]
        share = shares[min(int(t), recording.n_frames - 1)]
        return without_part(mask, share, direction) if share < 1 else mask

    return recording.with_masks(change)


class ErodedMasks(Step):
    """All masks lose `amount` pixels along their outline."""

    kind: Literal["eroded_masks"] = "eroded_masks"
    amount: int = Field(ge=0, le=500)
    unit: ClassVar[str] = "px"
    remedy: ClassVar[str] = "Check that masks reach the outline, and grow them where they do not."
    ladder: ClassVar[tuple[float, ...]] = (1, 2, 4, 8, 16)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        return recording.with_masks(lambda name, t, mask: ~_grown(~mask, self.amount))


class GrownMasks(Step):
    """All masks reach `amount` pixels beyond their outline."""

    kind: Literal["grown_masks"] = "grown_masks"
    amount: int = Field(ge=0, le=500)
    unit: ClassVar[str] = "px"
    remedy: ClassVar[str] = "Check that masks end at the outline: glow and wet edges are no liquid."
    ladder: ClassVar[tuple[float, ...]] = (1, 2, 4, 8, 16)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        return recording.with_masks(lambda name, t, mask: _grown(mask, self.amount))


class HoledMasks(Step):
    """`amount` of the pixels of every mask are lost in holes, which are elsewhere in each frame, as on highlights."""

    kind: Literal["holed_masks"] = "holed_masks"
    amount: float = Field(ge=0, le=1)
    unit: ClassVar[str] = "share of pixels"
    remedy: ClassVar[str] = "Fill holes at highlights."
    ladder: ClassVar[tuple[float, ...]] = (0.02, 0.05, 0.1, 0.2, 0.4)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        def change(name: str, t: float, mask: _Mask) -> _Mask:
            if self.amount == 0 or not mask.any():
                return mask
            blots = _blots(mask.shape, dice.of("holes", name, t))
            return mask & (blots > np.quantile(blots[mask], self.amount))

        return recording.with_masks(change)


class FlickeringMasks(Step):
    """Outlines waver by `amount` pixels (root mean square), elsewhere in each frame."""

    kind: Literal["flickering_masks"] = "flickering_masks"
    amount: float = Field(ge=0, le=100)
    unit: ClassVar[str] = "px"
    remedy: ClassVar[str] = "Smooth masks over time, or track them instead of segmenting each frame."
    ladder: ClassVar[tuple[float, ...]] = (0.5, 1, 2, 4, 8)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        def change(name: str, t: float, mask: _Mask) -> _Mask:
            if not mask.any() or mask.all():
                return mask
            inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            depth = np.where(mask, inside - 0.5, 0.5 - outside)
            return depth > self.amount * _blots(mask.shape, dice.of("outline", name, t))

        return recording.with_masks(change)


class WrongMasks(Step):
    """In `amount` of its frames, without a gap, one camera's mask is that of something else: its mirror image."""

    kind: Literal["wrong_masks"] = "wrong_masks"
    amount: float = Field(ge=0, le=1)
    unit: ClassVar[str] = "share of a camera's masks"
    remedy: ClassVar[str] = "Look through the masks of each camera: a tracker may have followed something else."
    ladder: ClassVar[tuple[float, ...]] = (0.1, 0.25, 0.5, 0.75, 1.0)

    def applied(self, recording: Recording, dice: Dice) -> Recording:
        rng = dice.of("camera")
        chosen = str(rng.choice(recording.views))
        count = max(1, round(self.amount * recording.n_frames)) if self.amount > 0 else 0
        start = int(rng.integers(0, recording.n_frames - count + 1))

        def change(name: str, t: float, mask: _Mask) -> _Mask:
            return mask[:, ::-1] if name == chosen and start <= t < start + count else mask

        return recording.with_masks(change)


def _grown(mask: _Mask, pixels: int) -> _Mask:
    """`mask` and what lies within `pixels` of it."""
    if pixels == 0 or not mask.any():
        return mask
    return np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= pixels)


def _blots(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float64]:
    """Smooth noise [H, W] with a mean of 0 and a standard deviation of 1."""
    height, width = shape
    noise = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), max(1.0, _BLOT * max(shape)))
    return np.asarray((noise - noise.mean()) / max(float(noise.std()), 1e-12))


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

"""Liquid masks without annotation: what differs from the empty scene before the liquid comes.

Per camera, the median of frames before the motion is the background and their spread is the noise. A pixel of a later
frame is split, after Horprasert, Harwood and Davis (ICCV FRAME-RATE Workshop, 1999), into its brightness relative to
the background and the colour that this leaves unexplained. A cast shadow or a soft reflection changes brightness
alone, within limits, and is let pass; liquid changes colour, or brightness beyond what a shadow does. Thresholds are
multiples of the noise, never of a particular colour.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.native.memory import give_back
from splashbench.prepare.masks.provider import Mask
from splashbench.prepare.video.strips import median_and_deviation

Floats = NDArray[np.float32]

MIN_BACKGROUND_FRAMES = 5
# Brightness of a background pixel, relative to itself, that a shadow or soft reflection may cause.
SHADOW_DARKEST, SHADOW_BRIGHTEST = 0.45, 1.2
# Hysteresis, in standard deviations of the noise: a region needs one pixel beyond HIGH and extends to LOW.
HIGH, LOW = 9.0, 5.0
# Video compression smooths a still scene until it shows no noise, and errs anew wherever something moves nearby: by a
# few grey levels, and by a fraction of a pixel where the picture has edges.
MIN_NOISE = 2.0
EDGE_SHIFT_PX = 0.1
# A shadow's light has another colour than the lamp's: share of the brightness lost that may show up as colour.
SHADOW_TINT = 0.15
# A pixel on the outline belongs to the liquid when the liquid covers at least half of it.
EDGE_SHARE = 0.5
EDGE_RADIUS = 3
CONTRAST_SIGMA_PX = 3.0
MIN_AREA_SHARE = 1e-5  # of the image: smaller regions are compression artefacts
MIN_AREA_PX = 4
_STRIP_ROWS = 128  # compared at once


@dataclass(frozen=True, eq=False)
class EmptyScene:
    """The empty scene of one camera. `median`: [H, W, 3] grey levels; `noise`: [H, W] standard deviation of a
    channel."""

    median: Floats
    noise: Floats

    @classmethod
    def fit(cls, read: Callable[[], Iterable[NDArray[np.uint8]]], count: int) -> EmptyScene:
        """From the `count` frames [H, W, 3] without liquid that `read` gives, as often as it is called."""
        median, deviation = median_and_deviation(read, count)
        # The median absolute deviation of whole grey levels is coarse: neighbours share their noise.
        noise = cv2.blur((1.4826 * deviation).astype(np.float32), (9, 9))
        grey = median.mean(axis=-1)
        gradient = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 8
        nearby = cv2.dilate(gradient, np.ones((3, 3), np.uint8))
        return cls(median, np.hypot(np.maximum(noise, MIN_NOISE), EDGE_SHIFT_PX * nearby).astype(np.float32))

    def compare(self, frame: NDArray[np.uint8]) -> tuple[Floats, Floats]:
        """How a frame [H, W, 3] differs from the background, per pixel, [H, W] each, >= 0.

        First, by how many standard deviations, after taking out what a shadow explains; second, by how many grey
        levels, with nothing taken out.
        """
        gain = self._gain(frame)
        found = np.empty((2, *frame.shape[:2]), np.float32)
        # In strips: the steps between of a whole 4K frame take 800 MB.
        for top in range(0, len(frame), _STRIP_ROWS):
            rows = slice(top, top + _STRIP_ROWS)
            found[:, rows] = self._compared(frame[rows].astype(np.float32) / gain, rows)
        return found[0], found[1]

    def _compared(self, image: Floats, rows: slice) -> tuple[Floats, Floats]:
        """`compare` of some rows, at the background's exposure."""
        median = self.median[rows]
        energy = np.maximum((median**2).sum(-1), 1.0)
        brightness = (image * median).sum(-1) / energy
        colour = np.sqrt(((image - brightness[..., None] * median) ** 2).sum(-1))
        change = np.abs(brightness - 1) * np.sqrt(energy)
        shadow = (brightness >= SHADOW_DARKEST) & (brightness <= SHADOW_BRIGHTEST)
        tint = SHADOW_TINT * change
        unexplained = np.where(shadow, np.sqrt(np.maximum(colour**2 - tint**2, 0.0)), np.hypot(colour, change))
        return unexplained / self.noise[rows], np.sqrt(((image - median) ** 2).sum(-1))

    def _gain(self, frame: NDArray[np.uint8]) -> Floats:
        """Exposure of the frame relative to the background, per channel: most of the image shows no liquid."""
        usable = self.median.min(-1) > 16
        if usable.mean() < 0.05:
            return np.ones(3, np.float32)
        channels = zip(np.moveaxis(frame, -1, 0), np.moveaxis(self.median, -1, 0))
        ratio = [np.median(shown[usable].astype(np.float32) / empty[usable]) for shown, empty in channels]
        return np.clip(ratio, 0.7, 1.4).astype(np.float32)


def segment(distance: Floats, difference: Floats) -> Mask:
    """Liquid mask [H, W] from `EmptyScene.compare`: hysteresis, a trimmed outline, clean-up."""
    low = distance > LOW
    count, labels = cv2.connectedComponents(low.astype(np.uint8), connectivity=8)
    seeded = np.zeros(count, bool)
    seeded[np.unique(labels[distance > HIGH])] = True
    seeded[0] = False
    return _clean(_trim_outline(seeded[labels], difference))


def _trim_outline(mask: Mask, difference: Floats) -> Mask:
    """Drop pixels near the outline that the liquid covers by less than half, judged by its contrast thereabouts.

    A camera mixes colours at an outline, and chroma subsampling spreads them further; without this, masks are a pixel
    too wide all around, which matters for a stream ten pixels wide. The contrast is the mean over the mask nearby, each
    pixel weighted by its own difference, so that full pixels count for more than mixed ones. It is taken in grey
    levels: the noise, by which the distance is divided, changes from pixel to pixel with the background's own edges.
    """
    size = 2 * EDGE_RADIUS + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    inside = cv2.erode(mask.astype(np.uint8), kernel, borderValue=1) > 0
    masked = np.where(mask, difference, 0.0).astype(np.float32)
    weight = cv2.GaussianBlur(masked, (0, 0), CONTRAST_SIGMA_PX)
    contrast = cv2.GaussianBlur(masked**2, (0, 0), CONTRAST_SIGMA_PX) / np.maximum(weight, 1e-3)
    return mask & (inside | (difference >= EDGE_SHARE * contrast))


def _clean(mask: Mask) -> Mask:
    """Fill pinholes and drop specks too small to be told from compression artefacts."""
    smallest = max(MIN_AREA_PX, round(MIN_AREA_SHARE * mask.size))
    return _without_small(~_without_small(~mask, smallest), smallest)


def _without_small(mask: Mask, smallest: int) -> Mask:
    """The mask without its 8-connected regions of fewer than `smallest` pixels."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    keep = stats[:, cv2.CC_STAT_AREA] >= smallest
    keep[0] = False
    return np.asarray(keep[labels])


class BackgroundMasks:
    """Masks by background subtraction.

    `read_frames(camera, indices)` yields (index, frame [H, W, 3]); `quiet[camera]` lists source frames without liquid.
    """

    name = "background"

    def __init__(
        self,
        read_frames: Callable[[str, Sequence[int]], Iterator[tuple[int, NDArray[np.uint8]]]],
        quiet: dict[str, list[int]],
        sources: dict[str, str],
    ) -> None:
        self._read_frames = read_frames
        self._quiet = quiet
        self._sources = sources  # camera -> file to name in errors

    def masks(self, camera: str, indices: Sequence[int]) -> Iterator[tuple[int, Mask]]:
        """See `MaskProvider.masks`."""
        quiet = self._quiet[camera]
        if len(quiet) < MIN_BACKGROUND_FRAMES:
            raise SplashbenchError(
                f"{self._sources[camera]}: {len(quiet)} frames before the liquid comes,"
                f" {MIN_BACKGROUND_FRAMES} are needed to learn the background;"
                " give masks in a folder, or start recording earlier"
            )
        background = EmptyScene.fit(lambda: (frame for _, frame in self._read_frames(camera, quiet)), len(quiet))
        give_back()  # the frames, which small arrays may hold in place
        for index, frame in self._read_frames(camera, indices):
            yield index, segment(*background.compare(frame))

    def made_from(self, camera: str, indices: Sequence[int]) -> Mapping[str, Any]:
        """See `MaskProvider.made_from`: the frames without liquid."""
        return {"quiet": self._quiet[camera]}

"""The liquid-free plate: what a training view shows when no liquid is in front of it.

The paper fits its background to frame 0. Liquid already in that frame leaves the Gaussians under it without evidence,
and they show in other views as black blobs. The median over the frames in which a pixel is free of liquid uses more of
the recording; pixels that are never free carry no loss.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.scene import Camera, TrainingScene

# A median needs no more; reading every frame of a long 4K recording takes memory and minutes.
MAX_FRAMES = 32
# Mask outlines are a few pixels off, and wet edges glisten beyond them: share of the image's longest side.
_MARGIN = 0.006
_ABSENT = 256
_BAND_ROWS = 128


@dataclass(frozen=True)
class Plate:
    """One view without its liquid.

    Attributes:
        camera: the view, of the plate's size.
        image: float32 [H, W, 3] in [0, 1]; black where `seen` is False.
        seen: bool [H, W], the pixel was free of liquid in at least one frame.
    """

    camera: Camera
    image: NDArray[np.float32]
    seen: NDArray[np.bool_]


def make_plate(scene: TrainingScene, name: str, longest_side: int) -> Plate:
    """The plate of training camera `name`, shrunk so that no side exceeds `longest_side`."""
    camera = scene.cameras[name]
    frames = np.unique(np.linspace(0, scene.n_frames - 1, min(scene.n_frames, MAX_FRAMES)).round().astype(int))
    images = np.stack([scene.image(name, t) for t in frames])
    radius = max(2, round(_MARGIN * max(camera.width, camera.height)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    wet = np.stack([cv2.dilate(scene.mask(name, t).astype(np.uint8), disc) > 0 for t in frames])
    median = masked_median(images, ~wet)
    colors: NDArray[np.float32] = np.asarray(median / 255, dtype=np.float32)
    return shrunk(Plate(camera, colors, np.asarray(~wet.all(axis=0))), longest_side)


def masked_median(images: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Lower median over the first axis of uint8 [T, H, W, 3] where bool [T, H, W] allows; 0 where it never does."""
    median = np.zeros(images.shape[1:], np.uint8)
    for top in range(0, images.shape[1], _BAND_ROWS):
        rows = slice(top, top + _BAND_ROWS)
        band = np.where(valid[:, rows, :, None], images[:, rows], np.uint16(_ABSENT))
        band.sort(axis=0)
        middle = np.maximum(valid[:, rows].sum(axis=0) - 1, 0) // 2
        chosen = np.take_along_axis(band, middle[None, :, :, None], axis=0)[0]
        median[rows] = np.where(chosen == _ABSENT, 0, chosen)
    return median


def shrunk(plate: Plate, longest_side: int) -> Plate:
    """`plate`, smaller so that no side exceeds `longest_side`."""
    factor = min(1.0, longest_side / max(plate.camera.width, plate.camera.height))
    if factor == 1.0:
        return plate
    small = plate.camera.scaled(factor)
    size = (small.width, small.height)
    # A shrunk pixel counts where most of it was seen, with the mean of what was.
    share = cv2.resize(plate.seen.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    total = cv2.resize(plate.image * plate.seen[..., None], size, interpolation=cv2.INTER_AREA)
    kept = np.asarray(share > 0.9)
    mean: NDArray[np.float32] = np.where(kept[..., None], total / np.maximum(share, 1e-6)[..., None], np.float32(0))
    return Plate(small, mean, kept)

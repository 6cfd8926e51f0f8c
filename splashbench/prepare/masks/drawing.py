"""Masks drawn onto images, small and legible: thumbnails with outlines, colours for changes, and captions.

Everything is an sRGB uint8 array [H, W, 3], so that a report, a file or a window can take it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.prepare.crop import bounding_box
from splashbench.prepare.masks.provider import Mask

Image = NDArray[np.uint8]

# Okabe and Ito: told apart by colour-blind readers as well.
ADDED, REMOVED, KEPT = (0, 158, 255), (255, 120, 0), (255, 255, 255)
OUTLINE = (255, 235, 0)
_DARK = (0, 0, 0)
FAULT = (214, 20, 20)
INK, PAPER, GREY = (25, 25, 25), (255, 255, 255), (110, 110, 110)


def thumbnail(image: Image, mask: Mask, width: int, height: int) -> tuple[Image, Mask]:
    """Both scaled into `width` x `height`; a mask's pixel is set where half of it was (or any, were it to vanish)."""
    scale = min(width / image.shape[1], height / image.shape[0])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    small = cv2.resize(image, size, interpolation=how)
    share = cv2.resize(mask.astype(np.float32), size, interpolation=how)
    covered = share >= 0.5
    return np.asarray(small, np.uint8), np.asarray(covered if covered.any() else share > 0)


def outlined(image: Image, mask: Mask) -> Image:
    """The image with a bright line just outside the mask, and a dark one beside it for bright backgrounds."""
    drawn = image.copy()
    inner = mask.astype(np.uint8)
    near = cv2.dilate(inner, np.ones((3, 3), np.uint8))
    far = cv2.dilate(near, np.ones((3, 3), np.uint8))
    drawn[(far > 0) & (near == 0)] = _DARK
    drawn[(near > 0) & (inner == 0)] = OUTLINE
    for edge in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):  # where it runs out of the image
        drawn[edge][mask[edge]] = OUTLINE
    return drawn


def changed(image: Image, raw: Mask, refined: Mask) -> Image:
    """The image in grey, with what was added and what was removed in colour and what was kept tinted white."""
    grey = np.repeat(np.asarray(image).mean(axis=-1, keepdims=True) * 0.75, 3, axis=-1)
    for region, colour, weight in (
        (raw & refined, KEPT, 0.35),
        (refined & ~raw, ADDED, 0.7),
        (raw & ~refined, REMOVED, 0.7),
    ):
        grey[region] = (1 - weight) * grey[region] + weight * np.array(colour)
    return grey.round().astype(np.uint8)


def around_masks(shape: tuple[int, int], *masks: Mask, margin: float = 0.15) -> tuple[slice, slice]:
    """Rows and columns of an image [H, W] that hold the masks and some surroundings; all of it where they are empty."""
    box = bounding_box(np.any(masks, axis=0))
    if box is None:
        return slice(0, shape[0]), slice(0, shape[1])
    spare = max(8, round(margin * max(box.x1 - box.x0, box.y1 - box.y0)))
    rows = slice(max(0, box.y0 - spare), min(shape[0], box.y1 + spare))
    columns = slice(max(0, box.x0 - spare), min(shape[1], box.x1 + spare))
    return rows, columns


@lru_cache(maxsize=8)
def _font(size: int, bold: bool) -> Any:
    from matplotlib import font_manager
    from PIL import ImageFont

    weight = "bold" if bold else "normal"
    font_file = font_manager.findfont(font_manager.FontProperties(family="DejaVu Sans", weight=weight))
    return ImageFont.truetype(font_file, size)


def write_line(
    canvas: Image,
    x: int,
    y: int,
    text: str,
    size: int = 13,
    colour: tuple[int, int, int] = INK,
    bold: bool = False,
    room: int | None = None,
) -> None:
    """Write one line onto `canvas` with its top left at (x, y), cut short with an ellipsis to `room` pixels."""
    from PIL import Image as Pillow
    from PIL import ImageDraw

    font = _font(size, bold)
    if room is not None and font.getlength(text) > room:
        while text and font.getlength(text + "…") > room:
            text = text[:-1]
        text = text.rstrip() + "…"
    page = Pillow.fromarray(canvas)
    ImageDraw.Draw(page).text((x, y), text, fill=colour, font=font)
    canvas[:] = np.asarray(page)

"""The image as tiles: which are rendered to what, and images cut into tiles and put together again.

The renderer works tile by tile, so a mode per tile says where it has to work at all: COLOR, OPACITY (colours are left
out) or SKIP. In the compact layout an image is the tiles whose mode is not SKIP, row by row, each planar: a fit that
keeps its targets so never touches the pixels that its loss does not read.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from splashbench.render.constants import TILE_HEIGHT, TILE_WIDTH

SKIP, OPACITY, COLOR = 0, 1, 2

Modes = NDArray[np.uint8]
Number = TypeVar("Number", bound=np.generic)


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """(rows, columns) of tiles of a `width` x `height` image."""
    return -(-height // TILE_HEIGHT), -(-width // TILE_WIDTH)


def _any_in_tile(pixels: NDArray, name: str) -> NDArray[np.bool_]:
    pixels = np.asarray(pixels)
    if pixels.dtype != bool or pixels.ndim != 2:
        raise TypeError(f"{name} is {pixels.dtype} {list(pixels.shape)}, not a mask of pixels, bool [H, W]")
    rows, columns = tile_grid(pixels.shape[1], pixels.shape[0])
    padded = np.zeros((rows * TILE_HEIGHT, columns * TILE_WIDTH), dtype=bool)
    padded[: pixels.shape[0], : pixels.shape[1]] = pixels
    return np.asarray(padded.reshape(rows, TILE_HEIGHT, columns, TILE_WIDTH).any(axis=(1, 3)))


def tile_modes(color: NDArray[np.bool_], opacity: NDArray[np.bool_] | None = None) -> Modes:
    """Modes uint8 [tile rows, tile columns] that cover masks of pixels, bool [H, W].

    COLOR where a tile holds a pixel of `color`, else OPACITY where it holds one of `opacity`, else SKIP. A loss that
    compares colours within a mask and opacity everywhere takes tile_modes(mask, np.ones_like(mask)).
    """
    modes = np.where(_any_in_tile(color, "color"), COLOR, SKIP).astype(np.uint8)
    if opacity is not None:
        if np.shape(opacity) != np.shape(color):
            raise ValueError(f"opacity is {list(np.shape(opacity))}, color {list(np.shape(color))}")
        modes[(modes == SKIP) & _any_in_tile(opacity, "opacity")] = OPACITY
    return modes


def to_tiles(image: NDArray[Number], modes: Modes) -> NDArray[Number]:
    """An image [H, W, C] or [H, W] in the compact layout: [K, C, TILE_HEIGHT, TILE_WIDTH], or without C.

    K is the number of tiles whose mode is not SKIP. Pixels beyond the image are 0.
    """
    image = np.asarray(image)
    if image.ndim not in (2, 3):
        raise ValueError(f"image is {list(image.shape)}, not [H, W, C] or [H, W]")
    height, width = image.shape[:2]
    grid = tile_grid(width, height)
    if np.shape(modes) != grid:
        raise ValueError(f"modes are {list(np.shape(modes))}, not {list(grid)} for an image of {height}x{width}")
    rows, columns = grid
    padded = np.zeros((rows * TILE_HEIGHT, columns * TILE_WIDTH, *image.shape[2:]), image.dtype)
    padded[:height, :width] = image
    tiles = padded.reshape(rows, TILE_HEIGHT, columns, TILE_WIDTH, *image.shape[2:]).swapaxes(1, 2)
    tiles = tiles[np.asarray(modes) != SKIP]
    return np.ascontiguousarray(np.moveaxis(tiles, 3, 1) if image.ndim == 3 else tiles)


def from_tiles(tiles: NDArray[Number], modes: Modes, height: int, width: int) -> NDArray[Number]:
    """The image [H, W, C] or [H, W] of a compact layout (see `to_tiles`); 0 in skipped tiles."""
    tiles = np.asarray(tiles)
    grid = tile_grid(width, height)
    rendered = np.asarray(modes) != SKIP
    if tiles.ndim not in (3, 4) or tiles.shape[-2:] != (TILE_HEIGHT, TILE_WIDTH):
        raise ValueError(f"tiles is {list(tiles.shape)}, not [K, C, {TILE_HEIGHT}, {TILE_WIDTH}] or without C")
    if rendered.shape != grid or len(tiles) != rendered.sum():
        raise ValueError(
            f"{len(tiles)} tiles and modes {list(rendered.shape)} with {rendered.sum()} tiles do not make an image of "
            f"{height}x{width}, which has {list(grid)}"
        )
    planar = tiles.ndim == 4
    tiles = np.moveaxis(tiles, 1, 3) if planar else tiles
    blocks = np.zeros((*grid, TILE_HEIGHT, TILE_WIDTH, *tiles.shape[3:]), tiles.dtype)
    blocks[rendered] = tiles
    rows, columns = grid
    image = blocks.swapaxes(1, 2).reshape(rows * TILE_HEIGHT, columns * TILE_WIDTH, *tiles.shape[3:])
    return np.ascontiguousarray(image[:height, :width])

"""Procedural textures: rich at every scale, so that feature matching finds its way in small images.

Albedos are linear (not sRGB), float32 in [0, 1].
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Albedo = NDArray[np.float32]
Color = tuple[float, float, float]

BOARD_PIXELS_PER_SQUARE = 120


def fractal_noise(
    rng: np.random.Generator, height: int, width: int, coarsest: int = 4, persistence: float = 0.75
) -> Albedo:
    """Multi-octave value noise [height, width], mean 0, standard deviation 1; the finest octave is one texel."""
    import cv2

    total = np.zeros((height, width), np.float32)
    cells, weight = coarsest, 1.0
    while cells <= max(height, width):
        grid = rng.standard_normal((max(2, cells * height // width), cells)).astype(np.float32)
        total += weight * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        cells, weight = cells * 2, weight * persistence
    return (total - total.mean()) / total.std()


def mottled(
    rng: np.random.Generator, size: tuple[int, int], base: Color, contrast: float, persistence: float = 0.75
) -> Albedo:
    """A stone-like surface [height, width, 3] about the colour `base`; `size` is (height, width)."""
    grey = fractal_noise(rng, *size, persistence=persistence)
    tint = fractal_noise(rng, *size, persistence=0.5)
    albedo = np.array(base, np.float32) * np.exp(contrast * grey)[..., None]
    albedo *= 1 + np.float32(0.06) * tint[..., None] * np.array([1, 0, -1], np.float32)
    return np.clip(albedo, 0.02, 0.95)


def printed(rng: np.random.Generator, size: tuple[int, int], base: Color) -> Albedo:
    """A sheet of random shapes in strong contrasts [height, width, 3], as people print them for photogrammetry."""
    import cv2

    height, width = size
    sheet = mottled(rng, size, base, 0.2)
    for _ in range(90):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        extent = rng.uniform(0.015, 0.08, 2) * width
        color = tuple(float(value) for value in np.clip(rng.uniform(0.03, 0.85) + rng.uniform(-0.1, 0.1, 3), 0.02, 0.9))
        angle = float(rng.uniform(0, 180))
        if rng.random() < 0.5:
            axes = (max(1, int(extent[0])), max(1, int(extent[1])))
            cv2.ellipse(sheet, centre, axes, angle, 0, 360, color, -1, cv2.LINE_AA)
        else:
            corners = cv2.boxPoints((centre, (2 * extent[0], 2 * extent[1]), angle))
            cv2.fillConvexPoly(sheet, np.round(corners).astype(np.int32), color, cv2.LINE_AA)
    return sheet


def banded(rng: np.random.Generator, size: tuple[int, int], base: Color, ink: Color) -> Albedo:
    """Glazed clay [height, width, 3] painted with bands and rows of leaves and dots; its left and right edges meet."""
    import cv2

    height, width = size
    half = mottled(rng, (height, width // 2), base, 0.05)
    clay = np.ascontiguousarray(np.concatenate([half, half[:, ::-1]], axis=1))
    for row, thick in ((0.30, 0.006), (0.33, 0.014), (0.60, 0.008), (0.86, 0.012), (0.93, 0.006)):
        cv2.line(clay, (0, int(row * height)), (width, int(row * height)), ink, max(1, int(thick * height)))
    for row, count, long, wide in ((0.16, 10, 0.09, 0.030), (0.465, 24, 0.085, 0.014), (0.73, 36, 0.02, 0.008)):
        for k in range(count):
            # Painted by hand: no two strokes are quite alike.
            angle = float((-1) ** k * 35 + rng.normal(0, 7))
            centre = (int((k + 0.5 + rng.normal(0, 0.05)) * width / count), int((row + rng.normal(0, 0.004)) * height))
            axes = (max(1, int(long * height * rng.uniform(0.85, 1.1))), max(1, int(wide * width / 3)))
            shade = tuple(float(value) for value in np.array(ink) * rng.uniform(0.8, 1.5))
            cv2.ellipse(clay, centre, axes, angle, 0, 360, shade, -1, cv2.LINE_AA)
    return clay


def charuco_board(board: dict[str, Any]) -> Any:
    """OpenCV's board object for the `[board]` table of session.toml."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board["dictionary"]))
    charuco = cv2.aruco.CharucoBoard(
        (board["squares_x"], board["squares_y"]), board["square_metres"], board["marker_metres"], dictionary
    )
    charuco.setLegacyPattern(board["legacy"])
    return charuco


def board_albedo(board: dict[str, Any], margin_squares: float = 0.35) -> Albedo:
    """The printed board on its white sheet [h, w, 3]; the sheet is `margin_squares` wider on every side."""
    pixels = BOARD_PIXELS_PER_SQUARE
    size = (board["squares_x"] * pixels, board["squares_y"] * pixels)
    pattern = charuco_board(board).generateImage(size, marginSize=0)
    margin = round(margin_squares * pixels)
    sheet = np.pad(pattern, margin, constant_values=255).astype(np.float32) / 255
    return np.repeat((0.04 + 0.76 * sheet)[..., None], 3, axis=2).astype(np.float32)


def to_srgb(linear: NDArray[np.float32]) -> NDArray[np.float32]:
    """Linear light to sRGB values in [0, 1] (IEC 61966-2-1), clipped."""
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(np.maximum(x, 1e-8), 1 / 2.4) - 0.055)


def sample(texture: Albedo, u: NDArray[np.float32], v: NDArray[np.float32]) -> Albedo:
    """Bilinear look-up of `texture` at u, v in [0, 1] (texel centres at half steps, clamped at the rim): [N, 3]."""
    height, width = texture.shape[:2]
    x = np.clip(u * width - 0.5, 0, width - 1)
    y = np.clip(v * height - 0.5, 0, height - 1)
    x0 = np.minimum(x.astype(np.int32), width - 2)
    y0 = np.minimum(y.astype(np.int32), height - 2)
    fx, fy = (x - x0)[:, None].astype(np.float32), (y - y0)[:, None].astype(np.float32)
    flat = texture.reshape(-1, 3)
    index = y0 * width + x0
    top = flat[index] * (1 - fx) + flat[index + 1] * fx
    bottom = flat[index + width] * (1 - fx) + flat[index + width + 1] * fx
    return top * (1 - fy) + bottom * fy

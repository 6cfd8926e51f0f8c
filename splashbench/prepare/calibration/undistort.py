"""Raw, distorted frames to the pinhole images that scenes hold.

The pinhole keeps the lens's matrix K and the frame's size, so nothing is scaled in the middle of the image, where the
liquid is. Barrel distortion: what the lens squeezed into the corners is cut off, and every pixel has a source.
Pincushion distortion: the corners have no source, and are black and outside every mask. `source_share` tells how much
of the image has a source.

Images are interpolated with cubics, as bilinear interpolation blurs a thin stream visibly. Masks are interpolated
linearly as 0/1 and cut at one half: their outline then lies right to a fraction of a pixel, without bias. The nearest
pixel would shift it by up to half a pixel, and a cubic's overshoot could make islands.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.prepare.calibration.lens import OPENCV_PIXEL_SHIFT, Lens
from splashbench.prepare.crop import PixelBox
from splashbench.scene.camera import Camera

_BAND_ROWS = 128


def pinhole_cameras(lenses: Mapping[str, Lens], w2c: Mapping[str, NDArray[np.float64]]) -> dict[str, Camera]:
    """The cameras of undistorted, uncropped frames."""
    return {name: Camera(name, lens.width, lens.height, lens.K, w2c[name]) for name, lens in lenses.items()}


class Undistorter:
    """Resamples the raw frames and masks of one lens. The tables are made once: 8 bytes per pixel."""

    def __init__(self, lens: Lens) -> None:
        self.lens = lens
        self._x, self._y = np.empty((2, lens.height, lens.width), np.float32)
        # In bands of rows: at once, the steps between take thirty times the tables of a 4K frame.
        for top in range(0, lens.height, _BAND_ROWS):
            band = slice(top, min(top + _BAND_ROWS, lens.height))
            rows, columns = np.mgrid[band, 0 : lens.width]
            pinhole = np.stack([columns + 0.5, rows + 0.5], axis=-1).reshape(-1, 2)
            normalised = (pinhole - lens.K[:2, 2]) @ np.linalg.inv(lens.K[:2, :2]).T
            source = lens.distort(normalised) @ lens.K[:2, :2].T + lens.K[:2, 2]
            table = (source - OPENCV_PIXEL_SHIFT).astype(np.float32).reshape(*rows.shape, 2)
            self._x[band], self._y[band] = table[..., 0], table[..., 1]

    @property
    def n_pixels(self) -> int:
        """Pixels of the frame."""
        return self.lens.width * self.lens.height

    def source_share(self, window: PixelBox | None = None) -> float:
        """Share of the pinhole image's pixels that the raw frame covers, within `window` where one is given."""
        inside = (self._x >= -0.5) & (self._x <= self.lens.width - 0.5)
        inside &= (self._y >= -0.5) & (self._y <= self.lens.height - 0.5)
        return float((window.cut(inside) if window else inside).mean())

    def image(self, raw: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A raw frame [H, W, 3] as the pinhole camera sees it, same size."""
        return np.asarray(
            cv2.remap(raw, self._x, self._y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        )

    def mask(self, raw: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """A raw mask [H, W] as the pinhole camera sees it, same size."""
        grey = raw.astype(np.uint8) * 255
        mapped = cv2.remap(grey, self._x, self._y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return np.asarray(mapped >= 128)

"""Where images end before the liquid does.

An image that cuts liquid off is no evidence of absence past that side, near where liquid crosses it. How far liquid
spreads there is not seen, and taken to be within a cone: as far to either side as past the image. Liquid that crosses
no side is in the image, or nowhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

from splashbench.observe.grid import Grid
from splashbench.observe.image_window import ImageWindow
from splashbench.parallel import over_range
from splashbench.scene.camera import Camera

# How far past an image liquid may go, as a share of the image's longest side.
_REACH = 0.5
# Places along a grid's longest side by which it is told how far past the sides images have to be looked at.
_RASTER = 64


@dataclass(frozen=True, eq=False)
class CutOff:
    """What lies past the sides of one view's images.

    window: of the image, with what is past the sides at which liquid is cut off: rows and columns may be negative.
    inner: the part of it that is in the image. image: the window that the image itself is. borders: of the left and
    right column [T, H] and the top and bottom row [T, W] of the masks, where they are liquid.
    """

    window: ImageWindow
    inner: ImageWindow
    image: ImageWindow
    borders: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]

    @classmethod
    def of(cls, borders: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], window: ImageWindow) -> CutOff | None:
        """That of a view with the `borders`, None where nothing is cut off. window: of its images, that holds all that
        it sees of liquid."""
        left, right, top, bottom = (bool(border.any()) for border in borders)
        if not (left or right or top or bottom):
            return None
        height, width = borders[0].shape[1], borders[2].shape[1]
        reach = max(1, round(_REACH * max(height, width)))
        larger = ImageWindow(
            -reach if top else window.y0,
            height + reach if bottom else window.y1,
            -reach if left else window.x0,
            width + reach if right else window.x1,
        )
        return cls(larger, window, ImageWindow(0, height, 0, width), borders)

    @property
    def sides(self) -> tuple[bool, bool, bool, bool]:
        """Whether liquid is cut off left, right, at the top and at the bottom."""
        left, right, top, bottom = (bool(border.any()) for border in self.borders)
        return left, right, top, bottom

    def window_of(self, camera: Camera, places: np.ndarray, reach: float) -> ImageWindow:
        """The part of `window` in which `camera` sees what is within `reach` of `places` [N, 3], scene units, with all
        that is in the image."""
        whole, inner = self.window, self.inner
        if len(places) == 0:
            return inner
        pixels, depth = camera.project(places)
        nearest = float(depth.min()) - reach
        if nearest <= 0:
            return whole
        margin = reach * max(camera.K[0, 0], camera.K[1, 1]) / nearest
        (left, top), (right, bottom) = np.floor(pixels.min(axis=0) - margin), np.ceil(pixels.max(axis=0) + margin)
        return ImageWindow(
            min(max(whole.y0, int(top)), inner.y0),
            max(min(whole.y1, int(bottom)), inner.y1),
            min(max(whole.x0, int(left)), inner.x0),
            max(min(whole.x1, int(right)), inner.x1),
        )

    def liquid(self, first: int, last: int, window: ImageWindow) -> np.ndarray:
        """Where liquid that crosses sides in the frames `first` to `last` may be past them: bool, of `window`."""
        left, right, top, bottom = (np.logical_or.reduce(border[first : last + 1]) for border in self.borders)
        image = self.image
        rows, columns = np.arange(window.y0, window.y1), np.arange(window.x0, window.x1)
        liquid = np.zeros(window.shape, dtype=bool)
        before, after = max(-window.x0, 0), max(window.x1 - image.x1, 0)
        if left.any() and before:
            liquid[:, :before] |= _aside(left, rows)[:, None] <= -columns[:before]
        if right.any() and after:
            liquid[:, -after:] |= _aside(right, rows)[:, None] <= columns[-after:] - (image.x1 - 1)
        before, after = max(-window.y0, 0), max(window.y1 - image.y1, 0)
        if top.any() and before:
            liquid[:before] |= _aside(top, columns) <= -rows[:before, None]
        if bottom.any() and after:
            liquid[-after:] |= _aside(bottom, columns) <= rows[-after:, None] - (image.y1 - 1)
        return liquid

    @property
    def ends(self) -> tuple[float, float, float, float]:
        """Where in the image it sees no farther: left, right, top and bottom, pixels; infinite where nothing is cut
        off."""
        left, right, top, bottom = self.sides
        return (
            0.0 if left else -np.inf,
            float(self.image.x1) if right else np.inf,
            0.0 if top else -np.inf,
            float(self.image.y1) if bottom else np.inf,
        )


#: `CutOff.ends` of a view that cuts nothing off.
ENDLESS = (-np.inf, np.inf, -np.inf, np.inf)


def in_images(views: Sequence[tuple[Camera, CutOff | None]], grid: Grid, share: float, limit: float) -> np.ndarray:
    """Voxels by which a node of `grid` lies within the images of a `share` of the views: float32 [nx, ny, nz], < 0
    where fewer have it, clipped to +-`limit`. Sides at which nothing is cut off end no image."""
    within = np.empty(grid.shape, dtype=np.float32)
    over_range(
        _in_images,
        grid.shape[0],
        np.ascontiguousarray(grid.origin),
        grid.voxel,
        np.stack([camera.projection for camera, _ in views]),
        np.array([ENDLESS if cut_off is None else cut_off.ends for _, cut_off in views]),
        np.array([0.5 * (camera.K[0, 0] + camera.K[1, 1]) for camera, _ in views]),
        len(views) - int(np.ceil(share * len(views))),
        limit,
        within,
    )
    return within


def places_in_images(
    views: Sequence[tuple[Camera, CutOff | None]], grid: Grid, share: float
) -> tuple[np.ndarray, float]:
    """Places of `grid` that the images of a `share` of the views have, [N, 3] on a raster; and how far, in scene units,
    others may be from the nearest of these."""
    step = max(1, max(grid.shape) // _RASTER)
    nx, ny, nz = (-(-n // step) + 1 for n in grid.shape)
    rough = Grid(grid.origin, grid.voxel * step, (nx, ny, nz))
    within = in_images(views, rough, share, 1.0)
    return rough.to_scene(np.argwhere(within > -1.0)), rough.voxel


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _in_images(
    origin: np.ndarray,
    voxel: float,
    projections: np.ndarray,
    ends: np.ndarray,
    focals: np.ndarray,
    lacking: int,
    limit: float,
    within: np.ndarray,
    start: int,
    stop: int,
) -> None:
    _, ny, nz = within.shape
    least = np.empty(lacking + 1)
    for i in range(start, stop):
        x = origin[0] + i * voxel
        for j in range(ny):
            y = origin[1] + j * voxel
            for k in range(nz):
                z = origin[2] + k * voxel
                least[:] = limit
                for view in range(len(projections)):
                    p, end = projections[view], ends[view]
                    depth = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
                    value = -limit
                    if depth > 0:
                        u = (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / depth
                        v = (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / depth
                        pixels = min(min(u - end[0], end[1] - u), min(v - end[2], end[3] - v))
                        value = min(max(pixels * depth / (focals[view] * voxel), -limit), limit)
                    # The least values of all views, rising.
                    for rank in range(lacking + 1):
                        if value < least[rank]:
                            value, least[rank] = least[rank], value
                within[i, j, k] = least[lacking]


def _aside(border: np.ndarray, places: np.ndarray) -> np.ndarray:
    """How far each of `places` is from the nearest pixel of `border`, bool [n], some of which is set: int [m]."""
    wet = np.flatnonzero(border)
    after = np.searchsorted(wet, places)
    before = wet[np.maximum(after - 1, 0)]
    return np.minimum(np.abs(places - before), np.abs(wet[np.minimum(after, len(wet) - 1)] - places))

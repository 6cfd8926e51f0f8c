"""How well the outline of a body fits what a view shows: what depths say is the container, and edges of the plate."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.arrays import Floats
from splashbench.background.clean_plate import shrunk
from splashbench.container.outline_kernels import strength_along, sum_within
from splashbench.container.standing import ContainerView
from splashbench.scene.camera import Camera

# The longest side of what shows the container, in pixels: of depths, and of edges. Room beside it, as a share.
_DEPTH_PIXELS, _EDGE_PIXELS, _ROOM = 160.0, 240.0, 0.4
# An edge counts half that is so many times as strong as the median one.
_STRONG = 4.0
# The direction of an outline is that between the pixels so many before and after.
_ALONG = 5


@dataclass(frozen=True, eq=False)
class _Window:
    """The part of a view's image that shows the container, larger or smaller. camera: of the window. scaled: width and
    height of the image that it is cut out of. corner: where, (column, row)."""

    camera: Camera
    scaled: tuple[int, int]
    corner: tuple[int, int]

    @classmethod
    def about(cls, camera: Camera, shown: NDArray[np.bool_], pixels: float) -> _Window:
        """That in which what is `shown` [H, W] is as large as `pixels`."""
        rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
        longer = max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1
        scaled = camera.scaled(pixels / longer)
        size, room = (scaled.width, scaled.height), _ROOM * pixels
        ratio = size[0] / camera.width, size[1] / camera.height
        low = [max(0, int(along[0] * r - room)) for along, r in zip((columns, rows), ratio)]
        high = [
            min(most, int(np.ceil((along[-1] + 1) * r + room))) for along, r, most in zip((columns, rows), ratio, size)
        ]
        window = scaled.cropped(low[0], low[1], high[0] - low[0], high[1] - low[1])
        return cls(window, size, (low[0], low[1]))

    def of(self, image: NDArray, nearest: bool = False) -> NDArray:
        """What it shows of `image` [H, W, ...], which is of the whole view, in any size."""
        ratio = image.shape[1] / self.scaled[0], image.shape[0] / self.scaled[1]
        # OpenCV has the middles of pixels at whole numbers.
        (across, down), (x, y) = ratio, ((at + 0.5) * r - 0.5 for at, r in zip(self.corner, ratio))
        how = (cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR) | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(
            image,
            np.array([[across, 0, x], [0, down, y]]),
            (self.camera.width, self.camera.height),
            flags=how,
            borderMode=cv2.BORDER_REPLICATE,
        )

    def within_image(self) -> NDArray[np.bool_]:
        """bool [H, W] of the window: all but its pixels along the border of the image."""
        rows = np.arange(self.camera.height) + self.corner[1]
        columns = np.arange(self.camera.width) + self.corner[0]
        inner_rows = (rows > 0) & (rows < self.scaled[1] - 1)
        inner_columns = (columns > 0) & (columns < self.scaled[0] - 1)
        return inner_rows[:, None] & inner_columns


@dataclass(frozen=True, eq=False)
class DepthView:
    """camera: of a window. says: `ContainerView.says` in it."""

    camera: Camera
    says: NDArray[np.int8]

    @classmethod
    def of(cls, view: ContainerView) -> DepthView:
        """The window of `view` that shows the container."""
        window = _Window.about(view.camera, view.says > 0, _DEPTH_PIXELS)
        return cls(window.camera, window.of(view.says, nearest=True))

    @property
    def speaking(self) -> float:
        """How many pixels speak for the container."""
        return float((self.says > 0).sum())

    def held(self, rings: Floats) -> float:
        """How many of them the silhouette of `rings` holds, less those that speak against it."""
        return sum_within(self.says, silhouette_of(rings, self.camera))


@dataclass(frozen=True, eq=False)
class EdgeView(DepthView):
    """across, down: float32 [H, W, 3], by how much the plate changes along columns and along rows, by what counts half.
    seen: bool [H, W], where it shows something, and no border of the image is beside it."""

    across: NDArray[np.float32]
    down: NDArray[np.float32]
    seen: NDArray[np.bool_]

    @classmethod
    def blurred(cls, view: ContainerView, shown: NDArray[np.bool_], blur: float) -> EdgeView:
        """The window of `view` about what is `shown` [H, W], blurred by so many pixels."""
        window = _Window.about(view.camera, shown, _EDGE_PIXELS)
        # Cut out of a plate of about that size: of a larger one only some pixels would be looked at.
        plate = shrunk(view.plate, max(window.scaled))
        filled = cv2.inpaint(plate.image, (~plate.seen).astype(np.uint8), 3, cv2.INPAINT_TELEA)
        seen = window.of(cv2.erode(plate.seen.astype(np.uint8), np.ones((3, 3), np.uint8)), nearest=True) > 0
        smooth = cv2.GaussianBlur(window.of(filled.astype(np.float32)), (0, 0), blur)
        across, down = (cv2.Sobel(smooth, cv2.CV_32F, dx, 1 - dx, ksize=3) for dx in (1, 0))
        strength = np.sqrt(across**2 + down**2).max(axis=2)[seen]
        usual = np.median(strength[strength > 0]) if (strength > 0).any() else 1.0
        scale = np.float32(1 / (_STRONG * usual))
        says = window.of(view.says, nearest=True)
        # An outline along the image's border shows nothing of the container's.
        return cls(window.camera, says, across * scale, down * scale, seen & window.within_image())

    def strength_and_held(self, rings: Floats) -> tuple[float, float]:
        """How strong edges are across the outline of the silhouette of `rings`, in the mean, 0 to 1; and `held`
        of it."""
        drawn = silhouette_of(rings, self.camera)
        held = sum_within(self.says, drawn)
        contours, _ = cv2.findContours(drawn, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        if not contours:
            return 0.0, held
        outline = np.ascontiguousarray(max(contours, key=len)[:, 0])
        return strength_along(outline, self.across, self.down, self.seen, _ALONG), held


def silhouette_of(rings: Floats, camera: Camera) -> NDArray[np.uint8]:
    """1 where `rings` [K, N, 3] and what lies between two of them is drawn, 0 elsewhere, uint8 [H, W]; nothing where
    some of it is not before the camera."""
    drawn = np.zeros((camera.height, camera.width), np.uint8)
    pixels, depth = camera.project(rings.reshape(-1, 3))
    if (depth <= 0).any() or not np.isfinite(pixels).all() or np.abs(pixels).max() > 1e5:
        return drawn
    # A sixteenth of a pixel is the drawing's unit; its pixels have their middles at whole numbers.
    fixed = np.rint((pixels - 0.5) * 16).astype(np.int32).reshape(*rings.shape[:2], 2)
    for lower, upper in pairwise(fixed):
        cv2.fillConvexPoly(drawn, cv2.convexHull(np.concatenate([lower, upper])), 1, lineType=8, shift=4)
    return drawn

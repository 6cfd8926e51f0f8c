"""How much of what lies behind the liquid shows through it, by photographs and clean plates alone. Not in the paper.

Where the background's texture is known from frames without liquid, it is looked for in the liquid: brightness
differences between neighbouring pixels of a photograph are fitted by those of the plate. Clear liquid shows most of
them, opaque liquid none. Liquid that is never gone from before its background, as a pool is, says nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.observe.image_window import ImageWindow
from splashbench.parallel import each
from splashbench.scene.frames import spread_frames
from splashbench.scene.scene import TrainingScene

if TYPE_CHECKING:
    from ..scaffold_gs import Plates

# Frames of every view that are looked at, evenly spread.
_FRAMES = 8
# Outlines of masks are a few pixels off: share of the image's longest side.
_MARGIN = 0.006
# Pairs of pixels that a view has to have, as a share of its pixels.
_LEAST = 0.005


def transmittance(scene: TrainingScene, plates: Plates) -> float:
    """The share of the background's texture that shows through the liquid of `scene`, in [0, 1]: the median over views.

    plates: of the training views, in their size. 0 where no view says anything.
    """
    frames = spread_frames(scene.n_frames, _FRAMES)
    shares = [share for name in scene.train if (share := _of_view(scene, plates, name, frames)) is not None]
    return float(np.clip(np.median(shares), 0, 1)) if shares else 0.0


def _of_view(scene: TrainingScene, plates: Plates, name: str, frames: NDArray[np.int64]) -> float | None:
    """The share in one view; None where too little of what lies behind its liquid is known, or that is flat."""
    plate = plates[name]
    radius = max(2, round(_MARGIN * max(plate.seen.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    behind = plate.floats()

    def found(t: np.int64) -> list[tuple[float, float, int]]:
        """Along either axis: how the photograph's differences go with the plate's, the plate's squares, and pairs."""
        mask = scene.mask(name, int(t))
        if not mask.any():
            return []
        box = ImageWindow.around(mask, radius).slices
        known = (cv2.erode(mask[box].astype(np.uint8), disc) > 0) & plate.seen[box]
        if not known.any():
            return []
        image, plain = scene.image(name, int(t))[box] * np.float32(1 / 255), behind[box]
        sums = []
        for axis in (0, 1):
            both = known[1:] & known[:-1] if axis == 0 else known[:, 1:] & known[:, :-1]
            shown = np.diff(image, axis=axis)[both]
            wanted = np.diff(plain, axis=axis)[both].astype(np.float64)
            sums.append((float((wanted * shown).sum()), float((wanted * wanted).sum()), len(wanted)))
        return sums

    together, alone, pairs = 0.0, 0.0, 0
    for sums in each(found, frames):
        for product, squares, count in sums:
            together += product
            alone += squares
            pairs += count
    if pairs < _LEAST * plate.seen.size or alone == 0:
        return None
    return together / alone

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
    texture = [np.diff(behind, axis=axis) for axis in (0, 1)]
    together, alone, pairs = 0.0, 0.0, 0
    for t in frames:
        known = (cv2.erode(scene.mask(name, int(t)).astype(np.uint8), disc) > 0) & plate.seen
        if not known.any():
            continue
        image = scene.image(name, int(t)) * np.float32(1 / 255)
        for axis, there in enumerate(texture):
            both = known[1:] & known[:-1] if axis == 0 else known[:, 1:] & known[:, :-1]
            wanted, shown = there[both].astype(np.float64), np.diff(image, axis=axis)[both]
            together += float((wanted * shown).sum())
            alone += float((wanted * wanted).sum())
            pairs += len(wanted)
    if pairs < _LEAST * plate.seen.size or alone == 0:
        return None
    return together / alone

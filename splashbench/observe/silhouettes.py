"""The training views' liquid masks, ready for carving: cropped, checked, and turned into 2-D signed distances.

A view whose mask is empty while other views see liquid is a failed mask, not evidence of absence: it gives only what
that view says over the whole sequence. (Letting k of n views dissent everywhere instead was measured to cost .1
mIoU.)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.scene.camera import Camera

MARGIN_PIXELS = 8
MIN_WITNESSES = 2


class MaskedScene(Protocol):
    """What carving needs of a scene; `Scene` and `TrainingScene` both have it."""

    @property
    def name(self) -> str: ...
    @property
    def cameras(self) -> dict[str, Camera]: ...
    @property
    def train(self) -> tuple[str, ...]: ...
    @property
    def n_frames(self) -> int: ...
    def mask(self, camera: str, t: int) -> np.ndarray: ...


def signed_distance_2d(mask: np.ndarray) -> np.ndarray:
    """Signed distance in pixels from pixel centres to the outline of `mask`, negative inside.

    mask: bool [h, w]; the result is float32 [h, w].
    The outline runs between pixels, half a pixel from the centres on either side. Beyond the image there is no liquid.
    """
    import cv2

    padded = np.pad(mask, 1).astype(np.uint8)
    outside, inside = (
        # OpenCV's root differs in the last bit with the alignment of its buffers; the squares are whole numbers.
        np.sqrt(np.rint(cv2.distanceTransform(region, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) ** 2))
        for region in (1 - padded, padded)
    )
    distance = np.where(padded > 0, 0.5 - inside, outside - 0.5)
    return np.ascontiguousarray(distance[1:-1, 1:-1], dtype=np.float32)


class Silhouettes:
    """Liquid masks of all frames of some views, kept as windows around what each view ever sees of the liquid."""

    def __init__(self, scene: MaskedScene, views: Sequence[str] | None = None):
        """views: names of the views that carve; all training views by default."""
        self.views = tuple(scene.train if views is None else views)
        self.cameras = [scene.cameras[view] for view in self.views]
        self.n_frames = scene.n_frames
        self._masks: list[np.ndarray] = []
        self.corners: list[np.ndarray] = []
        self.sequence_masks: list[np.ndarray] = []
        for view in self.views:
            masks: np.ndarray = np.stack([scene.mask(view, t) for t in range(scene.n_frames)])
            ever: np.ndarray = np.logical_or.reduce(masks, axis=0)
            rows, columns = np.nonzero(ever.any(axis=1))[0], np.nonzero(ever.any(axis=0))[0]
            height, width = ever.shape
            if len(rows) == 0:
                rows, columns = np.array([0]), np.array([0])
            y0, y1 = max(rows[0] - MARGIN_PIXELS, 0), min(rows[-1] + 1 + MARGIN_PIXELS, height)
            x0, x1 = max(columns[0] - MARGIN_PIXELS, 0), min(columns[-1] + 1 + MARGIN_PIXELS, width)
            self.corners.append(np.array([x0, y0], dtype=np.float64))
            self._masks.append(masks[:, y0:y1, x0:x1].copy())
            self.sequence_masks.append(ever[y0:y1, x0:x1].copy())
        #: bool [T, V]: views that see liquid in a frame
        self.sees_liquid: np.ndarray = np.stack([masks.any(axis=(1, 2)) for masks in self._masks], axis=1)
        if np.any(self.sees_liquid, axis=0).sum() < MIN_WITNESSES:
            raise SplashbenchError(
                f"{scene.name}: fewer than {MIN_WITNESSES} training views have any liquid in their masks; "
                "check the folder seg/ of the scene"
            )

    def has_liquid(self, t: int) -> bool:
        """Whether enough views see liquid in frame `t` for a hull."""
        return int(self.sees_liquid[t].sum()) >= MIN_WITNESSES

    def failed(self, t: int) -> list[str]:
        """Views whose mask of frame `t` is empty although other views see liquid."""
        if not self.has_liquid(t):
            return []
        return [view for view, sees in zip(self.views, self.sees_liquid[t]) if not sees]

    def distance(self, view: int, t: int) -> np.ndarray:
        """2-D signed distance of view number `view` in frame `t`; of all frames together where that mask failed."""
        if self.sees_liquid[t, view]:
            return signed_distance_2d(self._masks[view][t])
        return self.sequence_distance(view)

    def sequence_distance(self, view: int) -> np.ndarray:
        """2-D signed distance to everything that view number `view` ever sees as liquid."""
        mask = self.sequence_masks[view]
        if not mask.any():  # a camera without a single usable mask votes for nothing and against nothing
            return np.full(mask.shape, -np.float32(1e6))
        return signed_distance_2d(mask)

"""Training targets: for each time-camera pair, the window of the image that the liquid and its carriers cover.

Outside the window neither mask nor carriers reach, so the losses lose nothing by leaving it out, and rasterising the
window alone is several times cheaper than the whole view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from splashbench.scene.camera import Camera
from splashbench.scene.scene import TrainingScene

MASK_MARGIN = 8


@dataclass
class Target:
    """One time-camera pair.

    camera: of the window. image: uint8 [h, w, 3]; mask: bool [h, w]; background: float32 [h, w, 3] in [0, 1]. box:
    rows and columns of the mask's padded bounding box within the window. area: pixels over which the silhouette term
    averages.
    """

    frame: int
    camera: Camera
    eye: Tensor
    image: Tensor
    mask: Tensor
    background: Tensor
    box: tuple[slice, slice]
    area: float


def _extent(mask: np.ndarray, margin: int) -> tuple[int, int, int, int]:
    """x0, y0, x1, y1 of the bounding box of `mask` (not empty) grown by `margin`, within the image."""
    rows, columns = np.nonzero(mask.any(axis=1))[0], np.nonzero(mask.any(axis=0))[0]
    height, width = mask.shape
    return (
        max(int(columns[0]) - margin, 0),
        max(int(rows[0]) - margin, 0),
        min(int(columns[-1]) + 1 + margin, width),
        min(int(rows[-1]) + 1 + margin, height),
    )


def _window(camera: Camera, box: tuple[int, int, int, int], points: np.ndarray) -> tuple[int, int, int, int]:
    """`box` grown so that it holds the projections of `points` too, within the image."""
    pixels, depth = camera.project(points)
    pixels = pixels[depth > 0]
    if len(pixels) == 0:
        return box
    low = np.floor(pixels.min(axis=0)).astype(int) - MASK_MARGIN
    high = np.ceil(pixels.max(axis=0)).astype(int) + MASK_MARGIN
    return (
        int(np.clip(low[0], 0, box[0])),
        int(np.clip(low[1], 0, box[1])),
        int(np.clip(high[0], box[2], camera.width)),
        int(np.clip(high[1], box[3], camera.height)),
    )


def collect_targets(
    scene: TrainingScene,
    backgrounds: dict[str, np.ndarray],
    positions: list[np.ndarray],
    silhouette_norm: str,
) -> list[Target]:
    """All pairs whose mask is not empty and whose frame has carriers; a failed (empty) mask is no target.

    backgrounds: float32 [H, W, 3] of each training view. positions: of the carriers of each frame [n, 3], scene
    units. silhouette_norm: "image" averages the silhouette term over the view's sequence-wide liquid window (the
    paper's images are such crops), "mask" over the mask.
    """
    targets = []
    for name in scene.train:
        camera = scene.cameras[name]
        masks = [scene.mask(name, t) for t in range(scene.n_frames)]
        ever = np.any(masks, axis=0)
        if not ever.any():
            continue
        x0, y0, x1, y1 = _extent(ever, MASK_MARGIN)
        crop_area = float((x1 - x0) * (y1 - y0))
        eye = torch.tensor(camera.center, dtype=torch.float32)
        for t, mask in enumerate(masks):
            if not mask.any() or len(positions[t]) == 0:
                continue
            box = _extent(mask, MASK_MARGIN)
            x0, y0, x1, y1 = _window(camera, box, positions[t])
            inner = (slice(box[1] - y0, box[3] - y0), slice(box[0] - x0, box[2] - x0))
            targets.append(
                Target(
                    frame=t,
                    camera=camera.cropped(x0, y0, x1 - x0, y1 - y0),
                    eye=eye,
                    image=torch.from_numpy(scene.image(name, t)[y0:y1, x0:x1].copy()),
                    mask=torch.from_numpy(mask[y0:y1, x0:x1].copy()),
                    background=torch.from_numpy(backgrounds[name])[y0:y1, x0:x1],
                    box=inner,
                    area=crop_area if silhouette_norm == "image" else float(mask.sum()),
                )
            )
    return targets

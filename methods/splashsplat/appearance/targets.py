"""Training targets: for each time-camera pair, the window of the image that the liquid and its carriers cover.

Outside the window neither mask nor carriers reach, so the losses lose nothing by leaving it out, and rasterising the
window alone is several times cheaper than the whole view. Where the silhouette term is the image's, as in the paper,
the window is the image: Gaussians that reach far beyond their carriers are held to it, too. Of photograph and mask a
target keeps the mask's bounding box and 8 pixels around it, at four bytes a pixel; backgrounds are shared.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from splashbench.gaussians.devices import CPU
from splashbench.render import Frozen, tile_modes
from splashbench.scene.camera import Camera
from splashbench.scene.scene import TrainingScene

from ..carriers.subframe import Track, locate
from ..kernel.window_loss import WindowPhotograph
from .photographs import KEPT_BYTES, Deferred, Photograph, Shelf
from .projection import projected_extent

#: Name and background of training views, float32 [H, W, 3] or [3], one after the other, as they are large.
Views = Iterable[tuple[str, np.ndarray]]

SilhouetteNorm = Literal["image", "window", "mask"]

MASK_MARGIN = 8
# `TrainingTarget.hidden` of carriers that the container hides as a whole.
HIDDEN = 255
# A photograph taken this near to its frame's time, as a share of the step, is taken as taken then.
SAME_TIME = 0.01
# So many steps before the first timestep or after the last one a photograph still shows that timestep's liquid, about.
_BESIDE = 0.5


@dataclass
class TrainingTarget:
    """One time-camera pair.

    frame, fraction: whose carriers explain it, and how long after the frame it was taken; see `locate`. camera: of the
    window, [h, w] pixels. corner: x and y of the window's first pixel in the image. photograph: image and mask of the
    mask's padded bounding box, kept or read anew (photographs.py). background: float32 [h, w, 3] or [3] in [0, 1], what
    lies behind all Gaussians. area: pixels over which the silhouette term averages. hidden: uint8 [n], by how many
    255ths the container hides each carrier of the frame from the view, or None.
    wall: float32 [h, w], share of each pixel in which the container's near wall lies before the liquid, or None;
    in_front: bool [n], carriers of the frame that lie before the wall, or None for none.
    frozen: the background's Gaussians, where they are drawn together with the liquid's; modes: the tiles whose colour
    the losses read, see `splashbench.render.tile_modes`.
    coarse: the same at half the size, for the fit's first part, which may have one itself, or None; see coarse.py.
    """

    frame: int
    fraction: float
    camera: Camera
    eye: Tensor
    photograph: Photograph
    background: Tensor
    area: float
    hidden: Tensor | None = None
    frozen: Frozen | None = None
    modes: np.ndarray | None = None
    wall: Tensor | None = None
    in_front: Tensor | None = None
    corner: tuple[int, int] = (0, 0)
    coarse: TrainingTarget | None = None

    def to(self, device: str) -> TrainingTarget:
        """The same with what it is rendered by on `device`: the photograph stays, and what the container hides."""
        if device == CPU:
            return self
        wall = None if self.wall is None else self.wall.to(device)
        return replace(self, eye=self.eye.to(device), background=self.background.to(device), wall=wall)


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
    extent = projected_extent(camera, points)
    if extent is None:
        return box
    # Far beyond the image is beside it: no number is too large for an integer.
    extent = np.clip(extent, -1, np.array([camera.width, camera.height] * 2) + 1)
    low = np.floor(extent[:2]).astype(int) - MASK_MARGIN
    high = np.ceil(extent[2:]).astype(int) + MASK_MARGIN
    return (
        int(np.clip(low[0], 0, box[0])),
        int(np.clip(low[1], 0, box[1])),
        int(np.clip(high[0], box[2], camera.width)),
        int(np.clip(high[1], box[3], camera.height)),
    )


def _photograph(
    scene: TrainingScene,
    name: str,
    t: int,
    part: tuple[slice, slice],
    at: tuple[int, int],
    mask: np.ndarray | None = None,
) -> WindowPhotograph:
    """The `part` of a photograph and its mask, which begins at column and row `at` of the window.

    mask: where it was read already.
    """
    mask = scene.mask(name, t) if mask is None else mask
    return WindowPhotograph(
        torch.from_numpy(scene.image(name, t)[part].copy()),
        torch.from_numpy(mask[part].copy()),
        top=at[1],
        left=at[0],
    )


def _in_bytes(shares: np.ndarray) -> Tensor:
    """Shares in [0, 1] as uint8: there is one for every carrier of every photograph."""
    return torch.from_numpy(np.rint(HIDDEN * shares).astype(np.uint8))


def _modes(camera: Camera, box: tuple[int, int, int, int]) -> np.ndarray:
    """Tiles of the whole image in which the losses read colours: those of `box`."""
    read = np.zeros((camera.height, camera.width), dtype=bool)
    read[box[1] : box[3], box[0] : box[2]] = True
    return tile_modes(read)


def release_backgrounds(targets: list[TrainingTarget]) -> None:
    """Let go of what is behind `targets`, in place, until others are put there."""
    nothing = torch.zeros(3)
    for target in targets:
        target.background = nothing


def set_backgrounds(targets: list[TrainingTarget], views: Views, device: str = CPU) -> None:
    """Put others behind `targets`, in place, on `device`."""
    for name, image in views:
        behind = torch.from_numpy(image).to(device)
        for target in targets:
            if target.camera.name == name:
                target.background = windowed(behind, target.corner, target.camera)


def windowed(image: Tensor, corner: tuple[int, int], camera: Camera) -> Tensor:
    """The part of a view's `image` [H, W, ...] that `camera` has, from column and row `corner` on; a [3] as it is."""
    if image.ndim == 1:
        return image
    x, y = corner
    return image[y : y + camera.height, x : x + camera.width]


def _is_beyond(times: np.ndarray, time: float) -> bool:
    """Whether nothing is fitted that was to be seen at `time`."""
    beside = _BESIDE * float(np.diff(times).mean()) if len(times) > 1 else np.inf
    return not times[0] - beside <= time <= times[-1] + beside


def collect_targets(
    scene: TrainingScene,
    backgrounds: dict[str, np.ndarray],
    track: Track,
    silhouette_norm: SilhouetteNorm,
    camera_times: bool = False,
    trusted: np.ndarray | None = None,
    hidden: Callable[[str, np.ndarray], np.ndarray] | None = None,
    cut: Callable[[str, np.ndarray], tuple[np.ndarray, np.ndarray] | None] | None = None,
    frozen: Mapping[str, Frozen] | None = None,
    blocks: int = 1,
) -> list[TrainingTarget]:
    """All pairs whose mask is not empty and trusted, and whose frame has carriers; a failed mask is no target, and no
    photograph that a camera took before the first timestep or after the last one, at its own time.

    backgrounds: float32 [H, W, 3] or [3] of each training view. camera_times: whether a photograph shows the liquid at
    its camera's own time; by default at the scene's. trusted: bool [T, V], by default all. hidden: given a view's name
    and positions [n, 3], how far the container hides each of them (float [n] in [0, 1]). cut: given the same, the
    share of each pixel in which a near wall lies before the liquid (float32 [H, W]), and which positions lie before it
    (bool [n]); None for none. frozen: of each view, Gaussians of the background that are drawn together with
    the liquid's. silhouette_norm: the silhouette term averages over the "image", as in the paper, whose images are
    crops about the liquid; or over the "window" around all masks of the view, such a crop of images that are none; or
    over the "mask". blocks: windows begin at pixels that this divides, so that smaller ones are parts of smaller
    images; where it is above 1, photographs are read when they are to teach.
    """
    frozen = frozen or {}
    # Smaller photographs stand for these in most of the fit.
    shelf = Shelf(KEPT_BYTES if blocks == 1 else 0)
    targets = []
    for view, name in enumerate(scene.train):
        camera = scene.cameras[name]
        masks = [scene.mask(name, t) for t in range(scene.n_frames)]
        ever = functools.reduce(np.logical_or, masks)
        if not ever.any():
            continue
        x0, y0, x1, y1 = _extent(ever, MASK_MARGIN)
        areas = {"image": float(ever.size), "window": float((x1 - x0) * (y1 - y0))}
        whole = silhouette_norm == "image" or name in frozen
        eye = torch.tensor(camera.center, dtype=torch.float32)
        taken = scene.camera_times[name] if camera_times else scene.times
        for t, mask in enumerate(masks):
            if not mask.any() or (trusted is not None and not trusted[t, view]):
                continue
            if camera_times and _is_beyond(scene.times, float(taken[t])):
                continue
            frame, fraction = locate(scene.times, float(taken[t]))
            fraction = fraction if abs(fraction) > SAME_TIME else 0.0
            positions = track.positions(frame, fraction)
            if len(positions) == 0:
                continue
            box = _extent(mask, MASK_MARGIN)
            x0, y0, x1, y1 = (0, 0, camera.width, camera.height) if whole else _window(camera, box, positions)
            x0, y0 = x0 - x0 % blocks, y0 - y0 % blocks
            part = slice(box[1], box[3]), slice(box[0], box[2])
            at = (box[0] - x0, box[1] - y0)
            photograph = (
                Deferred(functools.partial(_photograph, scene, name, t, part, at))
                if shelf.full
                else shelf.keep(_photograph(scene, name, t, part, at, mask))
            )
            background = torch.from_numpy(backgrounds[name])
            share, in_front = (None if cut is None else cut(name, positions)) or (None, None)
            targets.append(
                TrainingTarget(
                    frame=frame,
                    fraction=fraction,
                    camera=camera.cropped(x0, y0, x1 - x0, y1 - y0),
                    eye=eye,
                    photograph=photograph,
                    background=background if background.ndim == 1 else background[y0:y1, x0:x1],
                    area=areas.get(silhouette_norm, float(mask.sum())),
                    hidden=None if hidden is None else _in_bytes(hidden(name, positions)),
                    frozen=frozen.get(name),
                    modes=_modes(camera, box) if name in frozen else None,
                    wall=None if share is None else torch.from_numpy(share)[y0:y1, x0:x1],
                    in_front=None if in_front is None or not in_front.any() else torch.from_numpy(in_front),
                    corner=(x0, y0),
                )
            )
    return targets

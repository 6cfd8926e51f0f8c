"""The clean plate of a training view: its image without the liquid.

"Clean plate" is the word of film crews for a shot of the empty set; "plate" is short for it throughout.
The paper fits its background to frame 0. Liquid already in that frame would be baked in, or, masked, leave the pixels
under it without evidence. A clean plate is the median over the frames in which a pixel is free of liquid, which uses
more of the recording. Pixels that are never free are marked.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.background.median import masked_median
from splashbench.parallel import each
from splashbench.scene import Camera, TrainingScene
from splashbench.scene.frames import spread_frames

# A median needs no more; reading every frame of a long 4K recording takes memory and minutes.
MAX_FRAMES = 32
# Mask outlines are a few pixels off, and wet edges glisten beyond them: share of the image's longest side.
_MARGIN = 0.006


@dataclass(frozen=True)
class CleanPlate:
    """One view without its liquid.

    Attributes:
        camera: the view, of the plate's size.
        image: uint8 [H, W, 3], sRGB; black where `seen` is False.
        seen: bool [H, W], the pixel was free of liquid in at least one frame.
        beside: bool [H, W], of these the pixels that liquid is beside in every frame; None for none.
    """

    camera: Camera
    image: NDArray[np.uint8]
    seen: NDArray[np.bool_]
    beside: NDArray[np.bool_] | None = None

    def without_beside(self) -> CleanPlate:
        """The plate without the pixels that liquid is always beside: edges of liquid mislead a search for depth."""
        return self if self.beside is None else CleanPlate(self.camera, self.image, self.seen & ~self.beside)

    def floats(self) -> NDArray[np.float32]:
        """The image as float32 [H, W, 3] in [0, 1]."""
        return np.asarray(self.image * np.float32(1 / 255))


def make_clean_plate(
    scene: TrainingScene, name: str, longest_side: int, n_frames: int = MAX_FRAMES, near_still: bool = False
) -> CleanPlate:
    """The plate of training camera `name`, shrunk so that no side exceeds `longest_side`.

    n_frames: it is the median over at most so many frames, evenly spread over the recording; with 1, frame 0 alone.
    Pixels beside liquid are left out, as outlines are a few pixels off. near_still: those that liquid is beside in
    every frame, as a rim is beside a pool, are taken from half as near.
    """
    camera = scene.cameras[name]
    frames = spread_frames(scene.n_frames, n_frames)
    radius = max(2, round(_MARGIN * max(camera.width, camera.height)))
    near_still = near_still and len(frames) > 1  # one frame says nothing of what liquid is always beside
    margins = (radius, radius // 2) if near_still else (radius,)
    discs = [cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * r + 1, 2 * r + 1)) for r in margins]
    small = _shrunk_camera(camera, longest_side)
    images = np.empty((len(frames), small.height, small.width, 3), np.uint8)
    dry, nearly = (np.zeros(images.shape[:3], bool) for _ in range(2))

    def read(i: int) -> None:
        # Shrunk one by one: a 4K recording's frames do not fit into memory together.
        image, mask = scene.image(name, int(frames[i])), scene.mask(name, int(frames[i])).astype(np.uint8)
        plates = [shrunk(CleanPlate(camera, image, cv2.dilate(mask, disc) == 0), longest_side) for disc in discs]
        images[i], dry[i] = plates[0].image, plates[0].seen
        if near_still:
            images[i][~dry[i]], nearly[i] = plates[1].image[~dry[i]], plates[1].seen

    each(read, range(len(frames)))
    beside = None
    if near_still:
        nearly &= ~dry.any(axis=0)
        dry |= nearly
        beside = np.asarray(nearly.any(axis=0))
    return CleanPlate(small, masked_median(images, dry), np.asarray(dry.any(axis=0)), beside)


def make_clean_plates(scene: TrainingScene, n_frames: int = MAX_FRAMES) -> dict[str, CleanPlate]:
    """The plate of every training view of `scene`, in its size, of at most `n_frames` frames."""
    sizes = {name: max(camera.width, camera.height) for name, camera in scene.cameras.items()}
    return {name: make_clean_plate(scene, name, sizes[name], n_frames) for name in scene.train}


def _shrunk_camera(camera: Camera, longest_side: int) -> Camera:
    factor = min(1.0, longest_side / max(camera.width, camera.height))
    return camera if factor == 1.0 else camera.scaled(factor)


def shrunk(plate: CleanPlate, longest_side: int) -> CleanPlate:
    """`plate`, smaller so that no side exceeds `longest_side`."""
    small = _shrunk_camera(plate.camera, longest_side)
    if small is plate.camera:
        return plate
    size = (small.width, small.height)
    # A shrunk pixel counts where most of it was seen, with the mean of what was.
    share = cv2.resize(plate.seen.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    total = cv2.resize((plate.image * plate.seen[..., None]).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    mostly_seen = np.asarray(share > 0.9)
    mean = np.where(mostly_seen[..., None], total / np.maximum(share, 1e-6)[..., None], np.float32(0))
    return CleanPlate(small, np.clip(np.rint(mean), 0, 255).astype(np.uint8), mostly_seen)

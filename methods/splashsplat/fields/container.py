"""What is known of the container: from the scene's mesh, or else from the container masks. Not in the paper.

One answer serves carving, drawing, and what a view may teach. It comes from the best source that there is.
- The scene's mesh, with its gravity.
- The container masks of the training views, where an upright vessel fills them (splashbench/container/mask_vessel.py).
  Its axis tells gravity. Whether liquid is seen through its walls tells whether it hides anything.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from splashbench.container.mask_vessel import MaskedVessel, vessel_from_masks
from splashbench.observe.occlusion import ContainerOcclusion
from splashbench.scene.camera import Camera
from splashbench.scene.frames import spread_frames
from splashbench.scene.scene import TrainingScene

ContainerSource = Literal["mesh", "masks", "none"]

# Of the liquid's pixels within the container masks, the share in front of the outer walls from which a container counts
# as transparent: what spills over an opaque one is less.
_SEEN_THROUGH = 0.15
# Frames that are looked at, spread over the recording.
_FRAMES = 24
# Pixels beside the rim that tell nothing, as a share of the image's longer side.
_RIM_MARGIN = 0.01


@dataclass(frozen=True)
class KnownContainer:
    """occlusion: as carving needs it, or None. gravity: unit vector [3], or None. source: where they are from."""

    occlusion: ContainerOcclusion | None
    gravity: np.ndarray | None
    source: ContainerSource

    def __str__(self) -> str:
        if self.occlusion is None:
            return "not known"
        origin = "mesh of the scene" if self.source == "mesh" else "upright vessel within the container masks"
        return f"{origin}, {'opaque' if self.occlusion.hides else 'transparent'}"


def known_container(scene: TrainingScene, mesh: bool, from_masks: bool) -> KnownContainer:
    """What `scene` states or shows of its container. mesh, from_masks: which sources to look at."""
    stated = ContainerOcclusion.of(scene) if mesh else None
    if stated is not None:
        return KnownContainer(stated, scene.gravity, "mesh")
    if not from_masks:
        return KnownContainer(None, scene.gravity, "none")
    masks = {name: mask for name in scene.train if (mask := scene.container_mask(name)) is not None}
    ups = [] if scene.gravity is None else [-scene.gravity]
    vessel = vessel_from_masks([scene.cameras[name] for name in scene.train], masks, ups)
    if vessel is None or not vessel.trusted:
        return KnownContainer(None, scene.gravity, "none")
    hides = not (scene.container_transparent or shows_liquid_through_walls(scene, vessel, masks))
    gravity = -vessel.up if scene.gravity is None else scene.gravity
    return KnownContainer(ContainerOcclusion(vessel.mesh, gravity, hides), gravity, "masks")


def shows_liquid_through_walls(scene: TrainingScene, vessel: MaskedVessel, masks: dict[str, np.ndarray]) -> bool:
    """Whether masks show liquid where a training view sees the vessel's outer wall, and not through its opening."""
    walls, everywhere = 0, 0
    for name, mask in masks.items():
        camera = scene.cameras[name]
        opening = _opening(camera, vessel.rim)
        if opening is None:
            continue
        for t in spread_frames(scene.n_frames, _FRAMES):
            liquid = scene.mask(name, int(t)) & mask
            everywhere += int(liquid.sum())
            walls += int((liquid & ~opening).sum())
    return walls > _SEEN_THROUGH * max(everywhere, 1)


def _opening(camera: Camera, rim: np.ndarray) -> np.ndarray | None:
    """bool [H, W]: the pixels that look through the opening, and those near the rim; None where it is not in front."""
    pixels, depth = camera.project(rim)
    if (depth <= 0).any():
        return None
    drawn = np.zeros((camera.height, camera.width), np.uint8)
    cv2.fillPoly(drawn, [np.rint(pixels).astype(np.int32)], 1)
    radius = max(1, round(_RIM_MARGIN * max(camera.width, camera.height)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(cv2.dilate(drawn, disc) > 0)

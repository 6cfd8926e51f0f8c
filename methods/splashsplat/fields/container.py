"""What is known of the container: from the scene's mesh, the container masks or the footage. Not in the paper.

One answer serves carving, drawing, and what a view may teach. It comes from the best source that there is.
- The scene's mesh, with its gravity.
- The container masks of the training views, where an upright vessel fills them (splashbench/container/mask_vessel.py).
- Without any, the upright vessel that the clean plates show where the liquid is, on the surface that it stands on
  (splashbench/container/footage_vessel.py). That surface tells gravity where no vessel is found, too.

A vessel's axis tells gravity. Whether liquid is seen through its walls tells whether it hides anything.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from splashbench.container.footage_vessel import Standing
from splashbench.container.mask_vessel import vessel_from_masks
from splashbench.container.vessel_body import Vessel
from splashbench.observe.occlusion import ContainerOcclusion
from splashbench.scene.camera import Camera
from splashbench.scene.frames import spread_frames
from splashbench.scene.scene import TrainingScene

ContainerSource = Literal["mesh", "masks", "footage", "none"]
_ORIGINS = {
    "mesh": "mesh of the scene",
    "masks": "upright vessel within the container masks",
    "footage": "upright vessel that the clean plates show where the liquid is",
}

# Of the liquid's pixels within the container masks, the share in front of the outer walls from which a container counts
# as transparent: what spills over an opaque one is less.
_SEEN_THROUGH = 0.15
# Frames that are looked at, spread over the recording.
_FRAMES = 24
# Of what stands still about the liquid, what has to lie in one level surface for its normal to tell gravity.
_LEVEL = 0.5
# Pixels beside the rim that tell nothing, as a share of the image's longer side.
_RIM_MARGIN = 0.01


@dataclass(frozen=True)
class KnownContainer:
    """occlusion: as carving needs it, or None. gravity: unit vector [3], or None. source: where they are from; of the
    gravity `gravity_from`, in words, where it is not the scene's. doubt: why what was found is not used, in words."""

    occlusion: ContainerOcclusion | None
    gravity: np.ndarray | None
    source: ContainerSource
    gravity_from: str = "along the container's axis"
    doubt: str = ""

    def __str__(self) -> str:
        if self.occlusion is None:
            return f"not known{self.doubt and ': '}{self.doubt}"
        return f"{_ORIGINS[self.source]}, {'opaque' if self.occlusion.hides else 'transparent'}"


def known_container(
    scene: TrainingScene,
    mesh: bool,
    from_masks: bool,
    footage: Callable[[], Standing] | None = None,
) -> KnownContainer:
    """What `scene` states or shows of its container. mesh, from_masks: which sources to look at. footage: finds what
    stands about the liquid (footage_vessel.py); None where the footage is not to be looked at."""
    stated = ContainerOcclusion.of(scene) if mesh else None
    if stated is not None:
        return KnownContainer(stated, scene.gravity, "mesh")
    names = scene.train if from_masks else ()
    masks = {name: mask for name in names if (mask := scene.container_mask(name)) is not None}
    if masks:
        return _in_masks(scene, masks)
    return KnownContainer(None, scene.gravity, "none") if footage is None else _in_footage(scene, footage())


def _in_masks(scene: TrainingScene, masks: dict[str, np.ndarray]) -> KnownContainer:
    """The vessel that fills the container `masks`."""
    ups = [] if scene.gravity is None else [-scene.gravity]
    vessel = vessel_from_masks([scene.cameras[name] for name in scene.train], masks, ups)
    if vessel is None or not vessel.trusted:
        return KnownContainer(None, scene.gravity, "none")
    gravity = -vessel.up if scene.gravity is None else scene.gravity
    return KnownContainer(_occlusion(scene, vessel, masks, gravity), gravity, "masks")


def _in_footage(scene: TrainingScene, found: Standing) -> KnownContainer:
    """The vessel, or the surface at least, that was `found` where the liquid is."""
    gravity, vessel = scene.gravity, found.vessel
    if gravity is None and found.support is not None and found.support.share >= _LEVEL:
        gravity = -found.support.normal
    said = "across the surface that things stand on"
    if vessel is None:
        where = "below the liquid" if found.support is None else "from the surface below the liquid"
        return KnownContainer(None, gravity, "none", said, f"photographs show nothing that rises {where}")
    if vessel.doubt:
        return KnownContainer(None, gravity, "none", said, vessel.doubt)
    silhouettes = vessel.masks([scene.cameras[name] for name in scene.train])
    # Its axis is the surface's normal: one that stands there says that the surface is level.
    upright = -vessel.up if gravity is None else gravity
    occlusion = _occlusion(scene, vessel, silhouettes, upright)
    if vessel.seen_through and occlusion.hides:
        return KnownContainer(None, gravity, "none", said, "no liquid shows through walls of what it rests in")
    return KnownContainer(occlusion, upright, "footage", said)


def _occlusion(
    scene: TrainingScene, vessel: Vessel, masks: dict[str, np.ndarray], gravity: np.ndarray
) -> ContainerOcclusion:
    """What `vessel`, whose silhouettes are `masks`, hides."""
    hides = not (scene.container_transparent or shows_liquid_through_walls(scene, vessel, masks))
    return ContainerOcclusion(vessel.mesh, gravity, hides)


def shows_liquid_through_walls(scene: TrainingScene, vessel: Vessel, masks: dict[str, np.ndarray]) -> bool:
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

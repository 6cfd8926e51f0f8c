"""Placing a scanned container in a finished scene that does not say where it stands, such as the released ones.

The release has container masks beside its whole images, and meshes beside its scenes. The masks of the training views
place the mesh; held-out ones verify. A container stands upright, so its place also tells where gravity pulls. Its mesh
is in metres, so its size tells the metric scale. All three go into scene.json (docs/scene_format.md).
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splashbench.container.entry import LEAST_OVERLAP, masks_of, name_in_scene, require_place, stated_of, write_entry
from splashbench.container.placement import Placement, place_by_silhouettes, up_from_container
from splashbench.container.stance import Axis
from splashbench.container.verification import Projection, verify
from splashbench.errors import SplashbenchError
from splashbench.scene import Scene
from splashbench.scene.container import FORMATS, ContainerMesh
from splashbench.scene.layout import SceneMeta


@dataclass(frozen=True)
class ScenePlacement:
    """Where the container stands in a scene.

    Attributes:
        placement: the mesh's pose, scale and upward direction.
        projections: how each camera that has a mask sees it, held-out ones too.
        gravity: unit vector [3] along which things fall if the container stands upright, scene coordinates.
        metres_per_unit: of the scene, if the mesh's own is right.
    """

    placement: Placement
    projections: dict[str, Projection]
    gravity: tuple[float, float, float]
    metres_per_unit: float


def place_in_scene(
    scene: Scene, mesh: ContainerMesh, masked: Scene | None = None, up: Axis | None = None, metres_per_unit: float = 1.0
) -> ScenePlacement:
    """Where `mesh` stands in `scene`, by its container masks, or by those of `masked`.

    masked: the scene before it was cropped, of the same cameras. up: the mesh's direction that points up, exactly; None
    tries all axes. metres_per_unit: of the mesh.

    Raises SplashbenchError for fewer than two masks of training cameras, other cameras than the scene's, and a mesh
    that does not cover its masks.
    """
    masks, mask_cameras = masks_of(scene, masked)
    source = f"{(masked or scene).directory / 'container_mask'}"
    training = [camera for name, camera in mask_cameras.items() if name in scene.train]
    placement = place_by_silhouettes(
        mesh,
        training,
        {camera.name: masks[camera.name] for camera in training},
        up=up,
        metres_per_unit=None,
        gravity=None,
        source=source,
    )
    projections = verify(mesh, placement.pose, list(mask_cameras.values()), masks)
    overlap = float(np.median([projections[camera.name].iou for camera in training]))
    if overlap < LEAST_OVERLAP:
        raise SplashbenchError(
            f"{source}: the mesh covers {overlap:.2f} of its masks (intersection over union, median of the training"
            f" views), less than {LEAST_OVERLAP}; check that it is this container's, and say what of it is up (--up)"
        )
    x, y, z = up_from_container(placement)
    return ScenePlacement(placement, projections, (-x, -y, -z), metres_per_unit / placement.scale)


def require_container_place(scene: Scene, mesh_file: Path, replace: bool) -> None:
    """Raise SplashbenchError, before long work, unless `mesh_file` may become the scene's container.

    Besides `require_place`, for a file of no format that scenes have, and one whose name in the scene is taken.
    """
    if mesh_file.suffix.lower() not in FORMATS:
        raise SplashbenchError(f"{mesh_file} is none of {', '.join(FORMATS)}; convert it")
    if not mesh_file.is_file():
        raise SplashbenchError(f"{mesh_file} is no file; give the container's mesh")
    require_place(scene, replace)
    path = scene.directory / name_in_scene(mesh_file)
    if not replace and path.exists():
        raise SplashbenchError(f"{path} is there already; move it away, or --replace to replace it")


def write_placement(
    scene: Scene, mesh_file: Path, placed: ScenePlacement, transparent: bool | None = None, replace: bool = False
) -> SceneMeta:
    """Copy the mesh into the scene's folder and state in scene.json where it stands; returns the new scene.json.

    Its other fields stay, gravity and scale among them unless `replace`.
    """
    require_container_place(scene, mesh_file, replace)
    stated = stated_of(scene)
    facts: dict[str, Any] = {}
    facts |= {} if stated.gravity and not replace else {"gravity": placed.gravity}
    facts |= {} if stated.metres_per_unit and not replace else {"metres_per_unit": placed.metres_per_unit}
    facts |= {} if transparent is None else {"container_transparent": transparent}
    name = name_in_scene(mesh_file)
    return write_entry(scene, name, lambda path: shutil.copyfile(mesh_file, path), placed.placement.pose, facts)

"""The scanned container put into a scene that does not say where it stands, as the released ones.

The release has container masks beside its whole images and meshes beside its scenes. The masks of the training views
place the mesh; held-out ones verify. A container stands upright, so that its place also tells where gravity pulls; and
as its mesh is in metres, the metric scale. All three go into scene.json (docs/scene_format.md).
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import files_together, require_folder_place, write_model
from splashbench.prepare.container.check import Projection, overlay, verify
from splashbench.prepare.container.placement import Axis, Placement, place_by_silhouettes, up_from_container
from splashbench.prepare.container.stage import name_in_scene
from splashbench.scene import Scene
from splashbench.scene.container import FORMATS, ContainerMesh
from splashbench.scene.layout import SceneMeta, plain_name

# Below this overlap, on the median of the views that decided, it is another mesh or another container.
LEAST_OVERLAP = 0.8
# Extrinsics of the same camera, with and without a crop, agree to this.
_SAME_POSE = 1e-6


@dataclass(frozen=True)
class ReleasedPlacement:
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

    def doubtful(self) -> list[str]:
        """Cameras in which mesh and mask overlap too little, among them such as did not decide."""
        return [name for name, projection in self.projections.items() if projection.iou < LEAST_OVERLAP]


def place_in_scene(
    scene: Scene, mesh: ContainerMesh, masked: Scene | None = None, up: Axis | None = None, metres_per_unit: float = 1.0
) -> ReleasedPlacement:
    """Where `mesh` stands in `scene`, by its container masks, or by those of `masked`.

    masked: the scene before it was cropped, of the same cameras. up: the mesh's direction that points up, exactly; None
    tries all axes. metres_per_unit: of the mesh.

    Raises SplashbenchError for fewer than two masks of training cameras, other cameras than the scene's, and a mesh
    that does not cover its masks.
    """
    masked = masked or scene
    masks = _masks(scene, masked)
    cameras = [masked.cameras[name] for name in masks]
    source = f"{masked.directory / 'container_mask'}"
    training = [camera for camera in cameras if camera.name in scene.train]
    if len(training) < 2:
        raise SplashbenchError(
            f"{source}: {len(training)} of the training cameras {', '.join(scene.train)} has a container mask, two are"
            " needed; name the scene before it was cropped by --masks, or draw <camera>.png"
        )
    placement = place_by_silhouettes(
        mesh,
        training,
        {camera.name: masks[camera.name] for camera in training},
        up=up,
        metres_per_unit=None,
        gravity=None,
        source=source,
    )
    projections = verify(mesh, placement.pose, cameras, masks)
    overlap = float(np.median([projections[camera.name].iou for camera in training]))
    if overlap < LEAST_OVERLAP:
        raise SplashbenchError(
            f"{source}: the mesh covers {overlap:.2f} of its masks (intersection over union, median of the training"
            f" views), less than {LEAST_OVERLAP}; check that it is this container's, and say what of it is up (--up)"
        )
    x, y, z = up_from_container(placement)
    return ReleasedPlacement(placement, projections, (-x, -y, -z), metres_per_unit / placement.scale)


def _masks(scene: Scene, masked: Scene) -> dict[str, NDArray[np.bool_]]:
    found = {}
    for name in scene.cameras:
        mask = masked.container_mask(name) if name in masked.cameras else None
        if mask is None:
            continue
        poses = scene.cameras[name].w2c, masked.cameras[name].w2c
        if not np.allclose(*poses, atol=_SAME_POSE * max(1.0, float(np.abs(poses[0]).max()))):
            raise SplashbenchError(
                f"{masked.directory}: camera {name} stands elsewhere than in {scene.directory}; give the same scene's"
                " folder before it was cropped"
            )
        found[name] = mask
    return found


def require_container_place(scene: Scene, mesh_file: Path, replace: bool) -> None:
    """Raise SplashbenchError, before long work, unless `mesh_file` may become the scene's container.

    For a file of no format that scenes have, for a scene whose folder may
    not be written, and where a container is there already, unless it is to be replaced.
    """
    if mesh_file.suffix.lower() not in FORMATS:
        raise SplashbenchError(f"{mesh_file} is none of {', '.join(FORMATS)}; convert it")
    if not mesh_file.is_file():
        raise SplashbenchError(f"{mesh_file} is no file; give the container's mesh")
    require_folder_place(scene.directory)
    if not replace and scene.meta is not None and scene.meta.container_mesh is not None:
        raise SplashbenchError(f"{scene.directory / 'scene.json'} has a container already; --replace places it anew")
    path = scene.directory / name_in_scene(mesh_file)
    if not replace and path.exists():
        raise SplashbenchError(f"{path} is there already; move it away, or --replace to replace it")


def write_placement(
    scene: Scene, mesh_file: Path, found: ReleasedPlacement, transparent: bool | None = None, replace: bool = False
) -> SceneMeta:
    """Copy the mesh into the scene's folder and say in scene.json where it stands; returns what stands there.

    Other fields there stay. Gravity and scale that it stated stay, too, unless `replace`.
    """
    require_container_place(scene, mesh_file, replace)
    name = name_in_scene(mesh_file)
    known = scene.meta or SceneMeta(name=plain_name(scene.name))
    said = {"container_mesh": name, "container_pose": found.placement.pose.tolist()}
    said |= {} if known.gravity and not replace else {"gravity": found.gravity}
    said |= {} if known.metres_per_unit and not replace else {"metres_per_unit": found.metres_per_unit}
    said |= {} if transparent is None else {"container_transparent": transparent}
    meta = SceneMeta.model_validate(known.model_dump() | said)
    with files_together(scene.directory) as staging:
        shutil.copyfile(mesh_file, staging / name)
        write_model(staging / "scene.json", meta)
    return meta


def picture(scene: Scene, mesh: ContainerMesh, found: ReleasedPlacement, width: int = 640) -> NDArray[np.uint8]:
    """The mesh's outline on the first image of every camera, RGB uint8 [H, W, 3], two cameras a row."""
    shown = []
    for name, camera in scene.cameras.items():
        wide = min(width, camera.width)
        shown.append(overlay(mesh, found.placement.pose, camera, image=scene.image(name, 0), width=wide))
    height, wide = max(image.shape[0] for image in shown), max(image.shape[1] for image in shown)
    padded = [np.pad(image, ((0, height - image.shape[0]), (0, wide - image.shape[1]), (0, 0))) for image in shown]
    if len(padded) % 2:
        padded.append(np.zeros_like(padded[0]))
    return np.concatenate([np.concatenate(padded[i : i + 2], axis=1) for i in range(0, len(padded), 2)])

"""A container's entry in a scene: the masks that show it, its file, what scene.json says, a picture of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError

from splashbench.container.verification import Projection, overlay
from splashbench.errors import SplashbenchError, one_line
from splashbench.files import files_together, require_folder_place, write_model
from splashbench.scene import Camera, Scene
from splashbench.scene.container import ContainerMesh
from splashbench.scene.container_masks import require_same_pose
from splashbench.scene.layout import SceneMeta, plain_name

#: Below this overlap of mesh and mask a camera is worth a look; below it on the median, a scan is of another container.
LEAST_OVERLAP = 0.8


def masks_of(scene: Scene, masked: Scene | None = None) -> tuple[dict[str, NDArray[np.bool_]], dict[str, Camera]]:
    """Container masks [H, W] by camera, those of test cameras included, and the cameras that they are of.

    masked: the scene before it was cropped, of the same cameras; None for `scene` itself.

    Raises SplashbenchError for other cameras than the scene's, for a mask without or with nothing but container, and
    where fewer than two training cameras have a mask.
    """
    masked = masked or scene
    masks = {}
    for name in scene.cameras:
        mask = masked.container_mask(name) if name in masked.cameras else None
        if mask is None:
            continue
        if mask.all() or not mask.any():
            path = masked.directory / "container_mask" / f"{name}.png"
            raise SplashbenchError(
                f"{path}: the mask is {'full' if mask.all() else 'empty'}; draw the container, or leave the file out"
            )
        require_same_pose(scene, masked, name)
        masks[name] = mask
    training = sum(name in scene.train for name in masks)
    if training < 2:
        raise SplashbenchError(
            f"{masked.directory / 'container_mask'}: {training} of the training cameras {', '.join(scene.train)} has a"
            " container mask, two are needed; name the scene before it was cropped by --masks, or draw <camera>.png"
        )
    return masks, {name: masked.cameras[name] for name in masks}


def doubtful(projections: Mapping[str, Projection]) -> list[str]:
    """Cameras in which mesh and mask overlap too little."""
    return [name for name, projection in projections.items() if projection.iou < LEAST_OVERLAP]


def require_place(scene: Scene, replace: bool) -> None:
    """Raise SplashbenchError, before long work, unless the scene may get a container.

    For a scene whose folder may not be written, and where a container is there already, unless it is to be replaced.
    """
    require_folder_place(scene.directory)
    if not replace and scene.meta is not None and scene.meta.container_mesh is not None:
        raise SplashbenchError(f"{scene.directory / 'scene.json'} has a container already; --replace replaces it")


def stated_of(scene: Scene) -> SceneMeta:
    """What scene.json says, or an empty one."""
    return scene.meta or SceneMeta(name=plain_name(scene.name))


def write_entry(
    scene: Scene, name: str, put: Callable[[Path], Any], pose: ArrayLike, facts: Mapping[str, Any]
) -> SceneMeta:
    """Have `put` write the mesh's file, called `name`, and say in scene.json where it stands, and the other `facts`.

    Returns what stands there; other fields stay. Both are written before either takes its place.
    """
    entry = {"container_mesh": name, "container_pose": np.asarray(pose, np.float64).tolist()}
    try:
        meta = SceneMeta.model_validate({**stated_of(scene).model_dump(), **entry, **facts})
    except ValidationError as error:
        first = error.errors()[0]
        place = " ".join(map(str, first["loc"]))
        raise SplashbenchError(
            f"{scene.directory / 'scene.json'} cannot say where the container stands ({place}: "
            f"{one_line(first['msg'])}); check the unit of the mesh (--metres-per-unit)"
        ) from None
    with files_together(scene.directory) as staging:
        put(staging / name)
        write_model(staging / "scene.json", meta)
    return meta


def name_in_scene(mesh: Path) -> str:
    """What the mesh's file is called in a scene's folder."""
    return f"container{mesh.suffix.lower()}"


def picture(scene: Scene, mesh: ContainerMesh, pose: ArrayLike, width: int = 640) -> NDArray[np.uint8]:
    """The mesh's outline on the first image of every camera, RGB uint8 [H, W, 3], two cameras a row."""
    outlined = []
    for name, camera in scene.cameras.items():
        wide = min(width, camera.width)
        outlined.append(overlay(mesh, pose, camera, image=scene.image(name, 0), width=wide))
    return in_pairs(outlined)


def in_pairs(pictures: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Pictures RGB uint8 [H, W, 3] as one, two a row, with black where they are smaller than the largest."""
    height, wide = max(image.shape[0] for image in pictures), max(image.shape[1] for image in pictures)
    padded = [np.pad(image, ((0, height - image.shape[0]), (0, wide - image.shape[1]), (0, 0))) for image in pictures]
    if len(padded) % 2:
        padded.append(np.zeros_like(padded[0]))
    return np.concatenate([np.concatenate(padded[i : i + 2], axis=1) for i in range(0, len(padded), 2)])

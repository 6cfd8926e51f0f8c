"""The container stage: the session's mesh placed by the training cameras' masks or by clicked points.

Held-out cameras decide nothing about a scene; their masks tell how well the mesh lies where nobody fitted it.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splashbench.container.clicked_points import ClickedPoint, place_by_points
from splashbench.container.entry import name_in_scene
from splashbench.container.placement import Placement, place_by_silhouettes, up_from_container
from splashbench.container.verification import Projection, verify
from splashbench.errors import SplashbenchError
from splashbench.prepare.calibration.undistort import Undistorter
from splashbench.prepare.masks.provider import Mask, read_raw_mask
from splashbench.prepare.poses.metric import GRAVITY
from splashbench.prepare.poses.scale import Upright
from splashbench.prepare.session import DESCRIPTION, Session
from splashbench.prepare.stage_cache import StageStore, facts_of
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh


@dataclass(frozen=True)
class PlacedContainer:
    """The placement, and how each camera that has a mask sees it, held-out ones too."""

    placement: Placement
    projections: dict[str, Projection]


def container_masks(folder: Path | None, undistorters: Mapping[str, Undistorter]) -> dict[str, Mask]:
    """Undistorted, uncropped container masks from FOLDER/<camera>.png in raw geometry; cameras without one are left
    out."""
    masks: dict[str, Mask] = {}
    if folder is None:
        return masks
    for camera, undistorter in undistorters.items():
        path = folder / f"{camera}.png"
        if path.is_file():
            masks[camera] = undistorter.mask(read_raw_mask(path, undistorter.lens.width, undistorter.lens.height))
    return masks


def check_masks(session: Session, sizes: Mapping[str, tuple[int, int]]) -> None:
    """Raise SplashbenchError for a container mask of another size than the recording's (width, height), for clicks
    outside the frames, and where a mesh has no clicks and fewer than two training cameras have masks to place it by."""
    table, folder = session.container, session.container_folder
    masked = []
    for camera in session.cameras if folder is not None else ():
        path = Path(folder or "") / f"{camera}.png"
        if path.is_file() and read_raw_mask(path, *sizes[camera]).any():
            masked.append(camera)
    if table is None:
        return
    for number, click in enumerate(table.points, 1):
        for camera, (u, v) in click.pixels.items():
            width, height = sizes[camera]
            if not (0 <= u <= width and 0 <= v <= height):
                raise SplashbenchError(
                    f"{session.directory / DESCRIPTION}: [container] point {number} lies at ({u:g}, {v:g}) in camera"
                    f" {camera}, whose frames are {width}x{height}; give pixels of the raw frame"
                )
    training = sum(camera in session.train for camera in masked)
    if not table.points and training < 2:
        raise SplashbenchError(
            f"{folder}: {training} training camera{' has' if training == 1 else 's have'} a container mask "
            "(<camera>.png) that is not empty, two are needed; draw more, or give points under [container]"
        )


def container_stage(
    store: StageStore,
    session: Session,
    mesh: ContainerMesh | None,
    cameras: Mapping[str, Camera],
    masks: Mapping[str, Mask],
    undistorters: Mapping[str, Undistorter],
) -> PlacedContainer | None:
    """The container's mesh in the scene, placed as `place_container` does; None where the session has none."""
    if mesh is None:
        return None
    inputs = {
        "files": facts_of(container_files(session)),
        "described": session.container,
        "train": session.train,
        "cameras": {name: [camera.K, camera.w2c] for name, camera in cameras.items()},
        "lenses": {name: undistorter.lens for name, undistorter in undistorters.items()},
    }
    return store.result(
        "container",
        PlacedContainer,
        inputs,
        lambda: place_container(session, mesh, list(cameras.values()), masks, undistorters),
    )


def place_container(
    session: Session,
    mesh: ContainerMesh,
    cameras: Sequence[Camera],
    masks: Mapping[str, Mask],
    undistorters: Mapping[str, Undistorter],
) -> PlacedContainer:
    """Place the `mesh` of the session's [container]; `cameras` and `masks` [H, W] are undistorted and uncropped.

    Raises SplashbenchError where masks or points do not determine a place.
    """
    assert session.container is not None
    placement = _place(session, mesh, cameras, masks, undistorters, GRAVITY, session.container.scale)
    return PlacedContainer(placement, verify(mesh, placement.pose, cameras, masks))


def _place(
    session: Session,
    mesh: ContainerMesh,
    cameras: Sequence[Camera],
    masks: Mapping[str, Mask],
    undistorters: Mapping[str, Undistorter],
    gravity: tuple[float, float, float] | None,
    metres_per_unit: float | None,
) -> Placement:
    table = session.container
    assert table is not None
    training = [camera for camera in cameras if camera.name in session.train]
    training_masks = {camera.name: masks[camera.name] for camera in training if camera.name in masks}
    placement: Placement | None = None
    if table.up is None and gravity is None and len(training_masks) < 2:
        raise SplashbenchError(
            f"{session.directory / DESCRIPTION}: neither a board nor a marker says what is up, and clicked points do "
            "not tell which side of the container's mesh is; give up under [container]"
        )
    if table.points:
        placement = place_by_points(
            mesh,
            training,
            [ClickedPoint(click.point, _pinhole_pixels(click.pixels, undistorters)) for click in table.points],
            up=table.up,
            gravity=gravity,
            metres_per_unit=metres_per_unit,
            masks=training_masks,
            source=f"{session.directory / DESCRIPTION}: [container] points",
        )
    if len(training_masks) >= 2:
        placement = place_by_silhouettes(
            mesh,
            training,
            training_masks,
            up=table.up,
            metres_per_unit=metres_per_unit,
            gravity=gravity,
            initial=None if placement is None else placement.pose,
            source=str(session.container_folder),
        )
    assert placement is not None  # `check_masks` found points, or masks of two cameras
    return placement


def upright_container(
    session: Session,
    mesh: ContainerMesh,
    cameras: Sequence[Camera],
    masks: Mapping[str, Mask],
    undistorters: Mapping[str, Undistorter],
) -> Upright:
    """Which way is up, and the metres, from the container in a reconstruction without either: for a session that has
    neither a flat board nor a marker. `cameras` in structure from motion's own frame."""
    table = session.container
    assert table is not None
    placement = _place(session, mesh, cameras, masks, undistorters, gravity=None, metres_per_unit=None)
    # The placement tells structure from motion's units per unit of the mesh; the mesh's metres may be unknown.
    metres_per_unit = None if table.scale is None else table.scale / placement.scale
    return Upright(np.asarray(up_from_container(placement)), placement.pose[:3, 3], metres_per_unit)


def _pinhole_pixels(
    pixels: Mapping[str, tuple[float, float]], undistorters: Mapping[str, Undistorter]
) -> dict[str, tuple[float, float]]:
    """Pixels clicked in raw frames, in the undistorted ones."""
    undistorted = {}
    for camera, pixel in pixels.items():
        lens = undistorters[camera].lens
        ray = np.append(lens.normalise(np.array([pixel], np.float64))[0], 1.0)
        u, v, _ = lens.K @ ray
        undistorted[camera] = (float(u), float(v))
    return undistorted


def put_into_scene(session: Session, directory: Path) -> None:
    """Copy the mesh's file into a scene's folder."""
    path = session.container_mesh
    assert path is not None
    shutil.copyfile(path, directory / name_in_scene(path))


def container_files(session: Session) -> list[Path]:
    """The files that a placement is made from."""
    files = [] if session.container_mesh is None else [session.container_mesh]
    folder = session.container_folder
    return [*files, *(sorted(folder.glob("*.png")) if folder is not None else [])]

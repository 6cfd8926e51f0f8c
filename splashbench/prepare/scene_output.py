"""The scene stage: cropped images and masks, scene.json, and the pictures that the report shows of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from splashbench.container.entry import name_in_scene
from splashbench.container.verification import overlay
from splashbench.files import sha256_file
from splashbench.prepare.calibration.undistort import Undistorter
from splashbench.prepare.container import PlacedContainer, put_into_scene
from splashbench.prepare.crop import PixelBox
from splashbench.prepare.masks.provider import Mask
from splashbench.prepare.masks.session_masks import MaskRecord, MaskStore
from splashbench.prepare.masks.sheet import SheetCell, sheet_times, small_cell
from splashbench.prepare.poses import metric
from splashbench.prepare.poses.structure_from_motion import Poses
from splashbench.prepare.session import DESCRIPTION, Session
from splashbench.prepare.video.pour import PourRecordings
from splashbench.prepare.video.sampling import Sampling
from splashbench.scene.camera import Camera
from splashbench.scene.container import ContainerMesh
from splashbench.scene.layout import SceneMeta
from splashbench.scene.writer import write_scene

SHEET_COLUMNS = 6  # timesteps on the report's contact sheet
OVERLAY_WIDTH = 480  # pixels of a frame with the container drawn on it

ImageFormat = Literal["png", "jpg"]
Image = NDArray[np.uint8]


@dataclass
class ReportPictures:
    """Pictures for the report, gathered while the scene is written: camera -> cells of the sheet, container drawn."""

    sheet: dict[str, list[SheetCell]] = field(default_factory=dict)
    overlays: dict[str, Image] = field(default_factory=dict)


@dataclass(frozen=True)
class SceneOutput:
    """What a scene is written from.

    Attributes:
        cameras: of undistorted, uncropped frames.
        poses: structure from motion in the scene's frame.
        windows: camera -> the part of the undistorted frame that is written.
        cropped: whether the windows are the paper's crop.
        mesh, container, container_masks: None and empty where the session has no container.
    """

    session: Session
    pour: PourRecordings
    cameras: dict[str, Camera]
    poses: Poses
    undistorters: Mapping[str, Undistorter]
    sampled: Sampling
    record: MaskRecord
    masks: MaskStore
    windows: dict[str, PixelBox]
    cropped: bool
    mesh: ContainerMesh | None
    container: PlacedContainer | None
    container_masks: Mapping[str, Mask]

    def write(self, directory: Path, image_format: ImageFormat) -> ReportPictures:
        """Write the scene into the empty folder `directory`."""
        pictures = ReportPictures()
        write_scene(
            directory,
            cameras={name: self._cropped_camera(name) for name in self.cameras},
            train=self.session.train,
            test=self.session.test,
            n_frames=len(self.sampled.times),
            frames=self._frames(pictures),
            meta=self._meta(),
            initial_points=metric.initial_points(self.poses),
            container_masks={name: self.windows[name].cut(mask) for name, mask in self.container_masks.items()},
            image_format=image_format,
        )
        if self.container is not None:
            put_into_scene(self.session, directory)
        return pictures

    def _cropped_camera(self, name: str) -> Camera:
        window = self.windows[name]
        return self.cameras[name].cropped(window.x0, window.y0, window.width, window.height)

    def _meta(self) -> SceneMeta:
        mesh, container = self.session.container_mesh, self.container
        return SceneMeta(
            name=self.session.name,
            times=self.sampled.times.tolist(),
            camera_times={camera: times.tolist() for camera, times in self.sampled.camera_times.items()},
            metres_per_unit=1.0,
            gravity=metric.GRAVITY,
            container_mesh=None if mesh is None else name_in_scene(mesh),
            container_pose=None if container is None else container.placement.pose.tolist(),
            container_transparent=None if self.session.container is None else self.session.container.transparent,
            provenance={
                "made_by": "splashbench prepare",
                "session_sha256": sha256_file(self.session.directory / DESCRIPTION),
                "masks": self.record.provider,
                "cropped": self.cropped,
                "windows": {camera: [box.x0, box.y0, box.x1, box.y1] for camera, box in self.windows.items()},
                "source_frames": {camera: frames.tolist() for camera, frames in self.sampled.indices.items()},
            },
        )

    def _frames(self, pictures: ReportPictures) -> Iterator[tuple[str, int, Image, Mask]]:
        """The scene's images and masks, camera by camera; a few go into `pictures` in passing."""
        sheet_columns = set(sheet_times(len(self.sampled.times), self.record.faults, SHEET_COLUMNS))
        for camera, recording in self.pour.recordings.items():
            window = self.windows[camera]
            cells = pictures.sheet.setdefault(camera, [])
            for t, (_, raw) in enumerate(recording.frames(self.sampled.indices[camera].tolist())):
                undistorted = self.undistorters[camera].image(raw)
                if t == 0 and self.mesh is not None and self.container is not None:
                    pictures.overlays[camera] = self._overlay(self.mesh, self.container, camera, undistorted)
                image, mask = window.cut(undistorted), window.cut(self.masks.read(camera, t))
                if t in sheet_columns:
                    cells.append(small_cell(image, mask, self.record.faults[camera].get(t, "")))
                yield camera, t, image, mask

    def _overlay(self, mesh: ContainerMesh, container: PlacedContainer, name: str, image: Image) -> Image:
        """An undistorted, uncropped image with the placed container drawn on it."""
        camera = self.cameras[name]
        width = min(OVERLAY_WIDTH, camera.width)
        return overlay(mesh, container.placement.pose, camera, self.container_masks.get(name), image, width)

"""Masks of a session: the provider asked for, undistortion, and the boxes that the crop follows from.

Masks are made before the crop is known, and the crop before the scene is written. In between masks wait on disk: at 4K
those of one scene are gigabytes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.files import read_gray, write_png
from splashbench.prepare.audio.sync import ClockFit
from splashbench.prepare.calibration.undistort import Undistorter
from splashbench.prepare.crop import PixelBox, bounding_box, crop_window
from splashbench.prepare.masks.background import BackgroundMasks
from splashbench.prepare.masks.provider import FolderMasks, Mask, MaskHealth, MaskProvider, mask_health
from splashbench.prepare.masks.sheet import Faults, mask_faults
from splashbench.prepare.session import DESCRIPTION, Session
from splashbench.prepare.video.recording import Recording

QUIET_FRAMES = 31  # before the motion, whose median is the background
QUIET_SECONDS = 3.0  # taken from at most this long before the motion, as the light may change
QUIET_MARGIN_S = 0.1


def choose_provider(
    session: Session,
    asked: str | None,
    pour: Mapping[str, Recording],
    clocks: Mapping[str, ClockFit],
    motion_start: float,
) -> MaskProvider:
    """Where masks come from: as `asked` ("background" or a folder), else as the session says.

    Raises SplashbenchError where the folder or the checkpoint is not there, or clicks lie outside the recording.
    """
    folder = session.mask_folder if asked is None else None if asked == "background" else Path(asked)
    if asked is None and session.masks.provider == "sam3":
        return sam3_provider(session, pour)
    if folder is not None:
        if not folder.is_dir():
            raise SplashbenchError(f"{folder} is not a folder of masks; give one, or --masks background")
        infos = {camera: recording.info for camera, recording in pour.items()}
        return FolderMasks(folder, {camera: (info.width, info.height) for camera, info in infos.items()})
    quiet = {
        camera: quiet_frames(recording, float(clocks[camera].to_local(motion_start)))
        for camera, recording in pour.items()
    }
    sources = {camera: str(recording.paths[0]) for camera, recording in pour.items()}
    return BackgroundMasks(lambda camera, indices: pour[camera].frames(indices), quiet, sources)


def sam3_provider(session: Session, pour: Mapping[str, Recording]) -> MaskProvider:
    """Masks by SAM3 as the session describes them. Raises SplashbenchError where the checkpoint or a click is none."""
    from splashbench.prepare.masks.sam3 import Sam3Masks

    table = session.masks
    assert table.checkpoint is not None
    for camera, clicks in table.points.items():
        count = len(pour[camera].frame_times)
        latest = max(click.frame for click in clicks)
        if latest >= count:
            raise SplashbenchError(
                f"{session.directory / DESCRIPTION}: [masks.points] has a click in frame {latest} of camera {camera},"
                f" whose pour has {count}; frames count from 0"
            )
    return Sam3Masks(
        lambda camera, indices: pour[camera].frames(indices),
        session.directory / table.checkpoint,
        {camera: str(recording.paths[0]) for camera, recording in pour.items()},
        text=table.text,
        points=table.points,
        confidence=table.confidence,
    )


def quiet_frames(recording: Recording, motion_start: float) -> list[int]:
    """Source frames shortly before the motion begins (local seconds), spread evenly."""
    until = motion_start - QUIET_MARGIN_S
    local = recording.frame_times
    before = np.flatnonzero((local < until) & (local >= until - QUIET_SECONDS))
    return before[np.linspace(0, len(before) - 1, min(len(before), QUIET_FRAMES)).astype(int)].tolist()


@dataclass(frozen=True)
class CameraMasks:
    """One camera's masks, undistorted and uncropped: area in pixels of each, and the union of their boxes."""

    areas: tuple[int, ...]
    box: PixelBox


def make_masks(
    folder: Path,
    provider: MaskProvider,
    camera: str,
    indices: Sequence[int],
    undistorter: Undistorter,
    source: Recording,
) -> CameraMasks:
    """Fill `folder` with the undistorted masks of a camera's source frames `indices`, a PNG each.

    Raises SplashbenchError where all are empty.
    """
    areas = []
    union: PixelBox | None = None
    for t, (_, raw) in enumerate(provider.masks(camera, indices)):
        mask = undistorter.mask(raw)
        areas.append(int(mask.sum()))
        box = bounding_box(mask)
        union = box.union(union) if box else union
        write_png(_file(folder, t), mask.astype(np.uint8) * 255)
    if union is None:
        raise SplashbenchError(
            f"{source.paths[0]}: all {len(areas)} masks of camera {camera} are empty"
            f" ({provider.name}); give masks in a folder with --masks, or set motion_interval in session.toml"
        )
    return CameraMasks(tuple(areas), union)


@dataclass(frozen=True)
class MaskRecord:
    """The masks as written: areas in pixels of the undistorted, uncropped frames, [T] per camera."""

    provider: str
    areas: dict[str, list[int]]
    health: dict[str, MaskHealth]
    faults: Faults


class MaskStore:
    """The masks of all cameras as `make_masks` left them: camera -> (folder, areas and box)."""

    def __init__(self, per_camera: Mapping[str, tuple[Path, CameraMasks]]) -> None:
        self._per_camera = dict(per_camera)

    def record(self, provider: str, undistorters: Mapping[str, Undistorter]) -> MaskRecord:
        """The masks' areas and health, for the report."""
        areas = {camera: list(masks.areas) for camera, (_, masks) in self._per_camera.items()}
        health = {camera: mask_health(areas[camera], undistorters[camera].n_pixels) for camera in areas}
        pixels = {camera: undistorters[camera].n_pixels for camera in areas}
        return MaskRecord(provider, areas, health, mask_faults(areas, pixels))

    def read(self, camera: str, t: int) -> Mask:
        """One mask [H, W]."""
        return np.asarray(read_gray(_file(self._per_camera[camera][0], t)) > 0)

    def windows(self, undistorters: Mapping[str, Undistorter], crop: bool) -> dict[str, PixelBox]:
        """Camera -> the window to be written: the paper's crop, or the whole frame."""
        windows = {}
        for camera, undistorter in undistorters.items():
            width, height = undistorter.lens.width, undistorter.lens.height
            full = PixelBox(0, 0, width, height)
            windows[camera] = crop_window(self._per_camera[camera][1].box, width, height) if crop else full
        return windows


def _file(folder: Path, t: int) -> Path:
    return folder / f"{t:06d}.png"

"""The calibrated rig of a session: lenses, then poses, then metres (paper Sec. 3, "Capture and calibration")."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.prepare import metric, poses
from splashbench.prepare.board import BoardDetector
from splashbench.prepare.intrinsics import Calibration, calibrate, focal_guess, frames_to_search
from splashbench.prepare.lens import Lens
from splashbench.prepare.session import DESCRIPTION, Session
from splashbench.prepare.video import Recording
from splashbench.progress import track

Image = NDArray[np.uint8]

STATIC_FRAMES = 15  # of a static clip, whose median is the picture
SHARPNESS_WIDTH = 480


@dataclass(frozen=True)
class PosedRig:
    """Poses in structure from motion's own units, and the board as the posed images show it."""

    poses: poses.Poses
    sightings: tuple[metric.Sighting, ...]


class RigRecordings:
    """The recordings that calibrate a session's cameras, opened once.

    Raises SplashbenchError where session.toml lacks one of them, before anything has been computed.
    """

    def __init__(self, session: Session) -> None:
        if session.board is None:
            raise SplashbenchError(
                f"{session.directory / DESCRIPTION}: no [board]; describe the ChArUco board that was filmed"
            )
        self.session = session
        self.detector = BoardDetector(session.board)
        self.boards = {camera: Recording(session.paths("intrinsics", camera)) for camera in session.cameras}
        self.static = {camera: Recording(session.paths("static", camera)) for camera in session.cameras}
        self.sweep = Recording(session.sweep_paths) if session.sweep_paths else None

    def calibrations(self) -> dict[str, Calibration]:
        """Every camera's lens from its board clip."""
        return {camera: self.calibrate(camera) for camera in track(self.session.cameras, "calibrating lenses")}

    def calibrate(self, camera: str) -> Calibration:
        """One camera's lens from its board clip."""
        recording = self.boards[camera]
        indices = frames_to_search(len(recording.frame_times))
        images = (image for _, image in recording.frames(indices))
        return calibrate(images, self.detector, str(recording.paths[0]))

    def static_images(self) -> dict[str, Image]:
        """One picture of the static scene per camera, the median over its clip."""
        images = {}
        for camera, recording in self.static.items():
            count = len(recording.frame_times)
            indices = np.unique(np.linspace(0, count - 1, min(count, STATIC_FRAMES)).astype(int)).tolist()
            images[camera] = poses.static_image([frame for _, frame in recording.frames(indices)])
        return images

    def sweep_images(self) -> list[Image]:
        """The sharpest frames of the sweep, spread over it; none where there is no sweep."""
        if self.sweep is None:
            return []
        sharpness = [poses.sharpness_of(luma) for _, luma in self.sweep.luma(SHARPNESS_WIDTH)]
        chosen = poses.sharpest_per_bin(sharpness, poses.SWEEP_FRAMES)
        return [frame for _, frame in self.sweep.frames(chosen)]

    def pose(self, lenses: Mapping[str, Lens], work: Path) -> PosedRig:
        """Structure from motion of the static scene, and where it shows the board; `work` is an empty folder."""
        static, sweep = self.static_images(), self.sweep_images()
        found = find_poses(static, sweep, lenses, self.detector, work)
        return PosedRig(found, find_sightings(static, sweep, lenses, found, self.detector))

    def check_sizes(self, lenses: Mapping[str, Lens], others: Mapping[str, Recording]) -> None:
        """Raise SplashbenchError where a camera recorded at another size than its lens was calibrated at."""
        for recordings in (self.static, others):
            for camera, recording in recordings.items():
                lens, info = lenses[camera], recording.info
                if (info.width, info.height) != (lens.width, lens.height):
                    raise SplashbenchError(
                        f"{recording.paths[0]} is {info.width}x{info.height}, the board clip of camera {camera} is"
                        f" {lens.width}x{lens.height}; film both in the same mode"
                    )


def find_poses(
    static: Mapping[str, Image],
    sweep: Sequence[Image],
    lenses: Mapping[str, Lens],
    detector: BoardDetector,
    work: Path,
) -> poses.Poses:
    """Structure from motion of the static scene, in its own units; `work` is an empty folder."""
    return poses.estimate_poses(static, lenses, sweep, work, focal_guess(sweep, detector))


def find_sightings(
    static: Mapping[str, Image],
    sweep: Sequence[Image],
    lenses: Mapping[str, Lens],
    found: poses.Poses,
    detector: BoardDetector,
) -> tuple[metric.Sighting, ...]:
    """The board in the static pictures and in the sweep's posed frames."""
    candidates = [(image, lenses[camera], found.w2c[camera]) for camera, image in static.items()]
    candidates += [(sweep[index], found.sweep_lens, w2c) for index, w2c in zip(found.sweep_indices, found.sweep_w2c)]
    views = [(detector.detect_true(image), lens, w2c) for image, lens, w2c in candidates]
    return tuple(metric.Sighting(view, lens, w2c) for view, lens, w2c in views if view is not None)


def find_metres(
    static: Mapping[str, Image],
    sweep: Sequence[Image],
    lenses: Mapping[str, Lens],
    found: poses.Poses,
    detector: BoardDetector,
) -> metric.MetricFrame:
    """The scene frame from the board in the static pictures and in the sweep."""
    return metric.align(find_sightings(static, sweep, lenses, found, detector), detector)

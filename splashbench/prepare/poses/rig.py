"""The calibrated rig of a session: lenses, then poses, then metres (paper Sec. 3, "Capture and calibration")."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.prepare.calibration.board import BoardView, Detector
from splashbench.prepare.calibration.checkerboard import board_detector, like_turns, numbered_alike
from splashbench.prepare.calibration.intrinsics import Calibration, calibrate, focal_guess, frames_to_search
from splashbench.prepare.calibration.lens import Array, Lens
from splashbench.prepare.calibration.marker import MarkerDetector, is_on_board
from splashbench.prepare.poses import metric, scale
from splashbench.prepare.poses import structure_from_motion as poses
from splashbench.prepare.poses.board_rig import board_poses
from splashbench.prepare.poses.board_sightings import shared_sightings
from splashbench.prepare.poses.stored_frames import StoredFrames
from splashbench.prepare.session import DESCRIPTION, Session
from splashbench.prepare.video.recording import Recording
from splashbench.prepare.video.stills import Stills, open_recording
from splashbench.prepare.video.strips import median_of

Image = NDArray[np.uint8]

STATIC_FRAMES = 15  # of a static clip, whose median is the picture
SHARPNESS_WIDTH = 480


@dataclass(frozen=True)
class PosedRig:
    """Poses and the prints of known size as the posed images show them.

    The poses are in units of their own; in metres where a board that several cameras see at once placed them.
    """

    poses: poses.Poses
    board: tuple[metric.Sighting, ...]
    marker: tuple[metric.Sighting, ...] = ()


class RigRecordings:
    """The recordings that calibrate a session's cameras, opened once.

    Raises SplashbenchError where session.toml lacks one of them, before anything has been computed.
    """

    def __init__(self, session: Session) -> None:
        if session.board is None:
            raise SplashbenchError(
                f"{session.directory / DESCRIPTION}: no [board]; describe the calibration board that was filmed"
            )
        self.session = session
        self.detector = board_detector(session.board)
        if session.marker is not None:
            MarkerDetector(session.marker)  # is there such a marker?
            if is_on_board(session.marker, session.board):
                raise SplashbenchError(
                    f"{session.directory / DESCRIPTION}: marker {session.marker.id} of [marker] is also on the board;"
                    " lay another one"
                )
        self.boards = {camera: open_recording(session.paths("intrinsics", camera)) for camera in session.cameras}
        self.static = {camera: open_recording(session.paths("static", camera)) for camera in session.cameras}
        self.sweep = open_recording(session.sweep_paths) if session.sweep_paths else None
        self.extrinsics = {
            camera: open_recording(session.paths("extrinsics", camera))
            for camera in (session.cameras if session.recordings.extrinsics else ())
        }
        if self.extrinsics and len(like_turns(session.board)) > 1:
            raise SplashbenchError(
                f"{session.directory / DESCRIPTION}: the checkerboard looks the same after a half turn, so"
                " [recordings.extrinsics] cannot tell how cameras see it; use one with an odd and an even number of"
                " squares, or a ChArUco board"
            )
        self._static_pictures: dict[str, Image] = {}
        # Of the frames of the sweep that decode, by their numbers, once they have been looked at.
        self._sharpness: dict[int, float] | None = None

    def videos(self) -> list[Recording]:
        """Every recording that is no photographs."""
        opened = [*self.boards.values(), *self.static.values(), *self.extrinsics.values(), self.sweep]
        return [recording for recording in opened if isinstance(recording, Recording)]

    def calibrate(self, camera: str) -> Calibration:
        """One camera's lens from its board clip."""
        recording = self.boards[camera]
        indices = frames_to_search(len(recording.frame_times))
        images = (image for _, image in recording.frames(indices))
        return calibrate(images, self.detector, str(recording.paths[0]))

    def static_images(self) -> dict[str, Image]:
        """One picture of the static scene per camera, the median over its clip."""
        return {camera: self.static_image(camera) for camera in self.static}

    def static_image(self, camera: str) -> Image:
        """One camera's picture of the static scene [H, W, 3], the median over its clip."""
        if camera not in self._static_pictures:
            recording = self.static[camera]
            count = len(recording.frame_times)
            indices = np.unique(np.linspace(0, count - 1, min(count, STATIC_FRAMES)).astype(int)).tolist()
            self._static_pictures[camera] = median_of(
                lambda: (frame for _, frame in recording.frames(indices)), len(indices)
            )
        return self._static_pictures[camera]

    def forget_pictures(self) -> None:
        """Hold no picture of the static scene any more; one that is asked for is made again."""
        self._static_pictures.clear()

    def sweep_images(self, count: int = poses.SWEEP_FRAMES) -> Iterator[Image]:
        """The `count` sharpest frames of the sweep, spread over it; none where there is no sweep."""
        if self.sweep is None:
            return iter(())
        if self._sharpness is None:
            self._sharpness = {index: poses.sharpness_of(luma) for index, luma in self.sweep.luma(SHARPNESS_WIDTH)}
        numbers = list(self._sharpness)
        chosen = poses.sharpest_per_bin(list(self._sharpness.values()), count)
        return (frame for _, frame in self.sweep.frames([numbers[k] for k in chosen]))

    def pose(
        self, lenses: Mapping[str, Lens], work: Path, lens_covariance: Mapping[str, Array] | None = None
    ) -> PosedRig:
        """Poses by the board that several cameras see at once, where session.toml lists recordings of it, else by
        structure from motion of the static scene; and where this shows the board. `work` is an empty folder."""
        static = self.static_images()
        if self.extrinsics:
            sightings = shared_sightings(self.extrinsics, self.detector, self.session.reference)
            posed = board_poses(sightings, lenses, lens_covariance)
            return sight_prints(static, [], lenses, posed, self.session, self.detector)
        posed, sweep = solve_poses(static, self.sweep_images, lenses, self.detector, work, lens_covariance)
        return sight_prints(static, sweep, lenses, posed, self.session, self.detector)

    def check_sizes(self, lenses: Mapping[str, Lens], others: Mapping[str, Recording]) -> None:
        """Raise SplashbenchError where a camera recorded at another size than its lens was calibrated at."""
        checked: list[Mapping[str, Recording | Stills]] = [self.static, self.extrinsics, dict(others)]
        for recordings in checked:
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
    detector: Detector,
    work: Path,
    lens_covariance: Mapping[str, Array] | None = None,
) -> poses.Poses:
    """Structure from motion of the static scene, in its own units; `work` is an empty folder."""
    guess = focal_guess(sweep, detector)
    return poses.estimate_poses(static, lenses, sweep, work, guess, lens_covariance=lens_covariance)


def solve_poses(
    static: Mapping[str, Image],
    sweep_images: Callable[[int], Iterable[Image]],
    lenses: Mapping[str, Lens],
    detector: Detector,
    work: Path,
    lens_covariance: Mapping[str, Array] | None = None,
) -> tuple[poses.Poses, Sequence[Image]]:
    """Structure from motion of the static scene, and the frames of the sweep that it used, which stand in `work`.

    `sweep_images`: the sweep's sharpest frames by their number (`RigRecordings.sweep_images`). Where they do not bridge
    the fixed cameras, twice as many are tried, and `Poses.attempts` begins with that. Raises SplashbenchError naming
    the cameras that could not be posed.
    """
    sweep = StoredFrames(sweep_images(poses.SWEEP_FRAMES), work / "sweep")
    first, second = work / "first", work / "second"
    first.mkdir()
    try:
        return find_poses(static, sweep, lenses, detector, first, lens_covariance), sweep
    except SplashbenchError as error:
        more = StoredFrames(sweep_images(2 * poses.SWEEP_FRAMES), work / "more")
        if len(more) <= len(sweep):
            raise
        second.mkdir()
        solved = find_poses(static, more, lenses, detector, second, lens_covariance)
        failed = f"{len(sweep)} frames of the sweep: {error}"
        return replace(solved, attempts=(failed, *solved.attempts)), more


def sight_prints(
    static: Mapping[str, Image],
    sweep: Sequence[Image],
    lenses: Mapping[str, Lens],
    posed: poses.Poses,
    session: Session,
    detector: Detector,
) -> PosedRig:
    """The board, and the marker where session.toml describes one, in the static pictures and the posed sweep."""
    board = _sightings(static, sweep, lenses, posed, detector.detect_true)
    if board:
        # A checkerboard numbers its corners from either end; for a ChArUco board nothing changes.
        renumbered = numbered_alike([s.view for s in board], [s.lens for s in board], [s.w2c for s in board], detector)
        board = [replace(sighting, view=view) for sighting, view in zip(board, renumbered)]
    marker: list[metric.Sighting] = []
    if session.marker is not None:
        marker_detector = MarkerDetector(session.marker)
        marker = metric.agreeing(_sightings(static, sweep, lenses, posed, marker_detector.detect))
    return PosedRig(posed, tuple(board), tuple(marker))


def prints_are_seen(rig: PosedRig, session: Session, detector: Detector) -> bool:
    """Whether the board or the marker lies where it gives the scene its up."""
    return session.marker is not None or metric.is_seen_twice(rig.board, metric.Print.of_board(detector))


def find_frame(
    rig: PosedRig, session: Session, detector: Detector, container: scale.Upright | None = None
) -> scale.SceneFrame:
    """The scene frame from whatever the session has: board, marker, measured distance, container (precedence: see
    `scale`).

    Raises SplashbenchError where metres or up are missing, where the marker that session.toml describes is not seen,
    and where a print lies face down.
    """
    marker = None
    if session.marker is not None:
        marker = metric.align_print(rig.marker, metric.Print.of_marker(MarkerDetector(session.marker)))
    board = None
    flat = metric.Print.of_board(detector)
    # With a marker, or a container, the board may stand or hang anywhere, or be out of sight.
    if metric.is_seen_twice(rig.board, flat):
        board = metric.align_print(rig.board, flat, upright=marker is None)
    distance = None
    if session.distance is not None:
        first, second = session.distance.cameras
        distance = scale.distance_scale(rig.poses, (first, second), session.distance.metres)
    return scale.choose_frame(board, marker, distance, container, rig.poses.metres_per_unit)


def _sightings(
    static: Mapping[str, Image],
    sweep: Sequence[Image],
    lenses: Mapping[str, Lens],
    posed: poses.Poses,
    detect: Callable[[Image], BoardView | None],
) -> list[metric.Sighting]:
    fixed = ((image, lenses[camera], posed.w2c[camera]) for camera, image in static.items())
    swept = ((sweep[index], posed.sweep_lens, w2c) for index, w2c in zip(posed.sweep_indices, posed.sweep_w2c))
    views = ((detect(image), lens, w2c) for image, lens, w2c in chain(fixed, swept))
    return [metric.Sighting(view, lens, w2c) for view, lens, w2c in views if view is not None]

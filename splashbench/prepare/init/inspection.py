"""What a recording shows, where its name does not say: the board waved about, a scene at rest, liquid, a sweep.

A few small frames decide. A clip in which a board's markers, or a checkerboard, are seen and travel is for the lens.
Of two such, the one with the larger board is, and the other places the camera. One in which nothing changes is the
static scene. A camera that itself travels is the sweep. Of what is left, the longest is the pour.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.prepare.init.checkerboard_guess import board_corners
from splashbench.prepare.init.discovery import FoundRecording, Subject, with_subject
from splashbench.prepare.video.recording import Recording
from splashbench.prepare.video.stills import Stills, open_recording

FRAMES = 9
WIDTH = 640
# The largest dictionary of each kind holds the smaller ones.
DICTIONARIES = ("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL")
_SETTLING_FRAMES = 3
_MIN_MARKERS = 3  # in an image; fewer are more likely misread than a board
_CLEAR = 5.0  # markers an image, by which their kind is settled
_SEEN_SHARE = 0.3  # of the frames looked at, showing markers: the board is what the clip is about
_TRAVEL = 0.04  # of the image's width, that markers wander in a clip for the lens
_STILL_GREY = 3.0  # mean change of a pixel over a clip of a scene at rest, in grey levels of 255
_SWEEP_SHIFT = 0.02  # of the image's width, that the whole picture shifts from one look to the next


@dataclass(frozen=True)
class Inspection:
    """What a few frames of a recording show.

    Attributes:
        seconds: how long it lasts; 0 for photographs.
        marker_share: of the frames, those that show markers, or a checkerboard.
        marker_travel: how far the markers' middle wanders, image widths.
        board_size: how far the markers reach, or the corners: mean over the frames that show them, image widths.
        change: mean change of a pixel between the first and the others, grey levels of 255.
        shift: of the whole picture from one frame to the next, median, image widths.
    """

    seconds: float
    marker_share: float
    marker_travel: float
    change: float
    shift: float
    board_size: float = 0.0

    @property
    def is_board_carried(self) -> bool:
        """Whether the clip is of a board that travels."""
        return self.marker_share >= _SEEN_SHARE and self.marker_travel > _TRAVEL


def few_frames(recording: Recording | Stills) -> list[NDArray[np.uint8]]:
    """A few grey frames [H, W] of a recording, small and spread evenly."""
    count = len(recording.frame_times)
    indices = np.unique(np.linspace(0, count - 1, FRAMES).astype(int)).tolist()
    return [_small(image) for _, image in recording.frames(indices)]


def inspect_recording(paths: Sequence[Path], finder: MarkerFinder) -> Inspection:
    """Inspection at a recording. Raises SplashbenchError where it cannot be read."""
    recording = open_recording(paths)
    images = few_frames(recording)
    if finder.dictionary is None:
        finder.settle(images)
    settled = finder.dictionary is not None
    looks = [_marker_corners(finder.find(image)) if settled else _checkerboard_corners(image) for image in images]
    seen = [corners for corners in looks if corners is not None]
    middles = [corners.mean(0) for corners in seen]
    travel = float(np.ptp(np.array(middles), axis=0).max()) / WIDTH if len(middles) > 1 else 0.0
    first = images[0].astype(np.float32)
    change = max((float(np.abs(image.astype(np.float32) - first).mean()) for image in images[1:]), default=0.0)
    shifts = [_shift(a, b) for a, b in pairwise(images)]
    return Inspection(
        seconds=recording.info.duration if isinstance(recording, Recording) else 0.0,
        marker_share=len(middles) / len(images),
        marker_travel=travel,
        change=change,
        shift=float(np.median(shifts)) if shifts else 0.0,
        board_size=float(np.mean([np.ptp(corners, axis=0).max() for corners in seen])) / WIDTH if seen else 0.0,
    )


def _small(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    height = max(1, round(grey.shape[0] * WIDTH / grey.shape[1]))
    return np.asarray(cv2.resize(grey, (WIDTH, height), interpolation=cv2.INTER_AREA))


@dataclass(frozen=True)
class Markers:
    """Markers in an image: `ids` [N], `corners` [N, 4, 2] pixels."""

    ids: NDArray[np.int64]
    corners: NDArray[np.float32]


@dataclass
class MarkerFinder:
    """Finds markers, once it has settled which: a session has one board, so what is settled serves all its recordings.

    `dictionary`: one of `DICTIONARIES`, None until settled; `inverted`: light on dark.
    """

    dictionary: str | None = None
    inverted: bool = False

    def settle(self, images: Sequence[NDArray[np.uint8]]) -> None:
        """Settle on the kind of marker that is seen most in a few grey images [H, W], if any is seen."""
        most_markers = 0
        some = [images[k] for k in np.unique(np.linspace(0, len(images) - 1, _SETTLING_FRAMES).astype(int))]
        for name in DICTIONARIES:
            for inverted in (False, True):
                counts = [len(_detect(image, name, inverted).ids) for image in some]
                if max(counts) >= _MIN_MARKERS and sum(counts) > most_markers:
                    most_markers, self.dictionary, self.inverted = sum(counts), name, inverted
                if most_markers > _CLEAR * len(some):
                    return

    def find(self, image: NDArray[np.uint8]) -> Markers:
        """The markers of the settled kind in a grey image [H, W]; none before it is settled."""
        if self.dictionary is None:
            return Markers(np.zeros(0, np.int64), np.zeros((0, 4, 2), np.float32))
        return _detect(image, self.dictionary, self.inverted)


def _detect(image: NDArray[np.uint8], dictionary: str, inverted: bool) -> Markers:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)), parameters)
    corners, ids, _ = detector.detectMarkers(cv2.bitwise_not(image) if inverted else image)
    return Markers(
        np.zeros(0, np.int64) if ids is None else np.ravel(ids).astype(np.int64),
        np.array([np.reshape(marker, (4, 2)) for marker in corners], np.float32).reshape(-1, 4, 2),
    )


def _marker_corners(markers: Markers) -> NDArray[np.float64] | None:
    """The markers' corners, pixels [N, 2]; None where they are too few to be a board."""
    return None if len(markers.ids) < _MIN_MARKERS else markers.corners.reshape(-1, 2).astype(np.float64)


def _checkerboard_corners(image: NDArray[np.uint8]) -> NDArray[np.float64] | None:
    """A checkerboard's corners, pixels [N, 2]; None where there is none."""
    corners = board_corners(image)
    return None if corners is None else corners.reshape(-1, 2).astype(np.float64)


def _shift(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    """How far the whole picture moved, in image widths, by phase correlation."""
    window = cv2.createHanningWindow((a.shape[1], a.shape[0]), cv2.CV_32F)
    (x, y), _ = cv2.phaseCorrelate(a.astype(np.float32), b.astype(np.float32), window)
    return float(np.hypot(x, y)) / a.shape[1]


def assign(
    recordings: Sequence[FoundRecording], inspections: dict[tuple[str, ...], Inspection]
) -> list[FoundRecording]:
    """One camera's recordings with their subjects, as far as these can be told; `inspections` by the recordings' files.

    A subject that a name states stays, but that of the extrinsics: many call the static clip so, and it is no other
    unless a board is carried in it. A subject is given to one recording at most.
    """
    recordings = [_as_seen(recording, recordings, inspections) for recording in recordings]
    taken = {recording.subject for recording in recordings if recording.subject}
    undecided = [recording for recording in recordings if recording.subject is None]
    named = [recording for recording in recordings if recording.subject is not None]

    def take(subject: Subject, candidates: list[FoundRecording]) -> None:
        if subject not in taken and candidates:
            chosen = candidates[0]
            undecided.remove(chosen)
            named.append(with_subject(chosen, subject))
            taken.add(subject)

    def inspection(recording: FoundRecording) -> Inspection:
        return inspections[recording.files]

    if not named and len(undecided) == 1 and inspection(undecided[0]).shift > _SWEEP_SHIFT:
        return [with_subject(undecided[0], "sweep")]
    carried = [f for f in undecided if inspection(f).is_board_carried]
    take("intrinsics", sorted(carried, key=_by_size(inspections)))
    # Blots of liquid pass for a checkerboard now and then: the last clip that could be the pour is no board's.
    if "pour" in taken or any(inspection(f).seconds > 0 for f in undecided if f not in carried):
        take("extrinsics", [f for f in sorted(carried, key=_by_size(inspections)) if f in undecided])
    still = [f for f in undecided if inspection(f).change < _STILL_GREY]
    take("static", sorted(still, key=lambda f: inspection(f).change))
    # Photographs have no clock: they never show the pour.
    take("pour", sorted((f for f in undecided if inspection(f).seconds > 0), key=lambda f: -inspection(f).seconds))
    return [*named, *undecided]


def _by_size(inspections: dict[tuple[str, ...], Inspection]) -> Callable[[FoundRecording], float]:
    """Sorts the clips in which the board is large, often and everywhere first: they tell most of the lens."""

    def key(recording: FoundRecording) -> float:
        found = inspections[recording.files]
        return -found.marker_share * found.marker_travel * found.board_size

    return key


def _as_seen(
    recording: FoundRecording,
    recordings: Sequence[FoundRecording],
    inspections: dict[tuple[str, ...], Inspection],
) -> FoundRecording:
    """What a clip named for the extrinsics is of where no board is carried in it: the static scene, or nothing known
    where another clip is of that."""
    found = inspections.get(recording.files)
    if recording.subject != "extrinsics" or found is None or found.is_board_carried:
        return recording
    has_static = any(other.subject == "static" for other in recordings)
    return replace(recording, subject=None if has_static else "static")

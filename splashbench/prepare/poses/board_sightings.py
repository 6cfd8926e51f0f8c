"""The board as several cameras saw it in the same instants: from photographs, or from videos with sound.

Photographs: the n-th of every camera belong together; the board rests while they are taken. Videos: the cameras' clocks
are found by the sound of these recordings, as those of the pour are. Shutters do not open together, and a board that is
carried moves by millimetres from one frame to the next. So each corner is interpolated between the two frames about the
instant, and instants in which the board moves fast are left out.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.prepare.audio import sync
from splashbench.prepare.audio.clocks import AUDIO_RATE
from splashbench.prepare.calibration.board import BoardView, Detector
from splashbench.prepare.calibration.lens import Array
from splashbench.prepare.video.recording import Recording
from splashbench.prepare.video.stills import Stills
from splashbench.progress import track

INSTANTS = 120  # spread over the recording
MAX_TRAVEL = 0.01  # of the image's width from frame to frame: beyond it the picture blurs and the path bends
MIN_CORNERS = 6

Shared = dict[str, list[BoardView | None]]


def shared_sightings(recordings: Mapping[str, Recording | Stills], detector: Detector, reference: str) -> Shared:
    """Camera -> what it saw of the board in each instant, the same instants for all.

    Raises SplashbenchError where photographs and videos are mixed, their numbers differ, or the sound gives no clocks.
    """
    stills = {camera: r for camera, r in recordings.items() if isinstance(r, Stills)}
    videos = {camera: r for camera, r in recordings.items() if isinstance(r, Recording)}
    if stills and videos:
        raise SplashbenchError(
            f"{next(iter(stills.values())).paths[0]} holds photographs, other cameras have videos under"
            " [recordings.extrinsics]; give all cameras the one or the other"
        )
    return _of_photographs(stills, detector) if stills else _of_videos(videos, detector, reference)


def _of_photographs(stills: Mapping[str, Stills], detector: Detector) -> Shared:
    counts = {camera: recording.info.n_frames for camera, recording in stills.items()}
    first = next(iter(counts))
    for camera, count in counts.items():
        if count != counts[first]:
            raise SplashbenchError(
                f"{stills[camera].paths[0]} holds {count} photographs, that of camera {first} {counts[first]}; under"
                " [recordings.extrinsics] the n-th photographs of all cameras belong together"
            )
    return {
        camera: [detector.detect_true(image) for _, image in recording.frames()]
        for camera, recording in track(stills.items(), "looking for the board")
    }


def _of_videos(videos: Mapping[str, Recording], detector: Detector, reference: str) -> Shared:
    tracks = {camera: recording.audio_track(AUDIO_RATE) for camera, recording in videos.items()}
    audio = {camera: (sound.samples, sound.start_s) for camera, sound in tracks.items()}
    clocks = sync.estimate_sync(audio, AUDIO_RATE, reference)
    sync.require_synced(clocks, {camera: recording.paths[0] for camera, recording in videos.items()})
    for recording in videos.values():
        recording.forget_sound()
    del tracks, audio
    common = {camera: clocks[camera].to_reference(recording.frame_times) for camera, recording in videos.items()}
    start, end = min(times[0] for times in common.values()), max(times[-1] for times in common.values())
    instants = np.linspace(start, end, INSTANTS + 2)[1:-1]
    return {
        camera: _at_instants(recording, common[camera], instants, detector)
        for camera, recording in track(videos.items(), "looking for the board")
    }


def _at_instants(recording: Recording, times: Array, instants: Array, detector: Detector) -> list[BoardView | None]:
    """The board at each of the instants [K] in one camera's frames, shown at `times` [N]."""
    before = np.searchsorted(times, instants, side="right") - 1
    inside = (before >= 0) & (before < len(times) - 1)
    wanted = sorted({int(k) for k in before[inside]} | {int(k) + 1 for k in before[inside]})
    views = {k: detector.detect_true(image) for k, image in recording.frames(wanted)}
    width = recording.info.width
    return [
        _between(views[k], views[k + 1], (time - times[k]) / (times[k + 1] - times[k]), width) if within else None
        for k, time, within in zip(before.tolist(), instants, inside)
    ]


def _between(first: BoardView | None, second: BoardView | None, share: float, width: int) -> BoardView | None:
    """The corners that both frames show, `share` of the way from the first to the second; None where they move fast."""
    if first is None or second is None:
        return None
    ids, a, b = np.intersect1d(first.ids, second.ids, return_indices=True)
    if len(ids) < MIN_CORNERS:
        return None
    travel = second.pixels[b] - first.pixels[a]
    if np.linalg.norm(travel, axis=1).max() > MAX_TRAVEL * width:
        return None
    return BoardView(ids, first.points[a], first.pixels[a] + share * travel)

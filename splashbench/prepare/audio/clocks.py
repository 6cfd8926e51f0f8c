"""The pour as recorded: what the files say about themselves, and the cameras' clocks from their sound."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from splashbench.prepare.audio import sync
from splashbench.prepare.audio.sync import ClockFit, SequenceSync
from splashbench.prepare.audio.waveform import Seam
from splashbench.prepare.video.recording import Recording, VideoInfo
from splashbench.progress import track

AUDIO_RATE = 48000


@dataclass(frozen=True)
class Listening:
    """By camera: `clocks` by arrival of the sound, `seams` where its sound is interrupted, `facts` of its recording."""

    clocks: dict[str, ClockFit]
    seams: dict[str, tuple[Seam, ...]]
    facts: dict[str, VideoInfo]


def listen(pour: Mapping[str, Recording], reference: str) -> Listening:
    """Read the sound of every camera's recording and fit its clock to the reference's.

    Raises SplashbenchError naming the file of the first camera whose sound gives no clock.
    """
    tracks = {name: recording.audio_track(AUDIO_RATE) for name, recording in track(pour.items(), "reading sound")}
    audio = {name: (found.samples, found.start_s) for name, found in tracks.items()}
    clocks = sync.estimate_sync(audio, AUDIO_RATE, reference)
    sync.require_synced(clocks, {name: recording.paths[0] for name, recording in pour.items()})
    return Listening(
        clocks,
        {name: found.seams for name, found in tracks.items()},
        {name: recording.info for name, recording in pour.items()},
    )


def left_over(
    pour: Mapping[str, Recording], clocks: Mapping[str, ClockFit], interval: tuple[float, float], reference: str
) -> SequenceSync:
    """The paper's residual synchronisation error within `interval` (seconds, reference clock)."""
    audio = {name: recording.audio(AUDIO_RATE) for name, recording in pour.items()}
    return sync.sequence_sync_rms(audio, AUDIO_RATE, clocks, interval, reference)


@dataclass(frozen=True)
class SoundPaths:
    """How the sound's travel shifts the clocks: `source` [3] metres in the scene, `given` or taken as its origin.

    `distance_m` and `shift_s` by camera: from source to camera, and what is added to its clock's start. `applied`:
    whether the clocks were corrected by it; without a given source it is only what one at the origin would do.
    """

    source: tuple[float, float, float]
    applied: bool
    distance_m: dict[str, float]
    shift_s: dict[str, float]

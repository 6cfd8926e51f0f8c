"""The sync stage: clocks from the sound of the pour, corrected for the sound's travel, checked on the sequence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from splashbench.prepare.audio import sync
from splashbench.prepare.audio.sync import ClockFit, SequenceSync
from splashbench.prepare.audio.waveform import Seam
from splashbench.prepare.media.container import VideoInfo
from splashbench.prepare.session import Session
from splashbench.prepare.stage_cache import StageStore
from splashbench.prepare.video.pour import PourRecordings
from splashbench.prepare.video.recording import Recording
from splashbench.progress import track
from splashbench.scene.camera import Camera

AUDIO_RATE = 48000


@dataclass(frozen=True)
class SyncResult:
    """By camera: `clocks` by arrival of the sound, `seams` where the sound is interrupted, `videos` by the files."""

    clocks: dict[str, ClockFit]
    seams: dict[str, tuple[Seam, ...]]
    videos: dict[str, VideoInfo]


def sync_stage(store: StageStore, pour: PourRecordings, reference: str) -> SyncResult:
    """Every camera's clock against the reference's.

    Raises SplashbenchError naming the file of the first camera whose sound gives no clock.
    """
    inputs = {"files": pour.all_files, "reference": reference}
    return store.result("sync", SyncResult, inputs, lambda: _find_clocks(pour.recordings, reference))


def _find_clocks(pour: Mapping[str, Recording], reference: str) -> SyncResult:
    tracks = {name: recording.audio_track(AUDIO_RATE) for name, recording in track(pour.items(), "reading sound")}
    audio = {name: (sound.samples, sound.start_s) for name, sound in tracks.items()}
    clocks = sync.estimate_sync(audio, AUDIO_RATE, reference)
    sync.require_synced(clocks, {name: recording.paths[0] for name, recording in pour.items()})
    return SyncResult(
        clocks,
        {name: sound.seams for name, sound in tracks.items()},
        {name: recording.info for name, recording in pour.items()},
    )


def sequence_sync(
    store: StageStore,
    pour: PourRecordings,
    clocks: Mapping[str, ClockFit],
    interval: tuple[float, float],
    reference: str,
) -> SequenceSync:
    """What the clocks leave over within `interval` (seconds, reference clock), and the paper's residual error there."""
    frame_s = 1 / pour.recordings[reference].info.fps

    def measure() -> SequenceSync:
        audio = {name: recording.audio(AUDIO_RATE) for name, recording in pour.recordings.items()}
        return sync.sequence_sync_rms(audio, AUDIO_RATE, clocks, interval, reference, frame_s=frame_s)

    inputs = {"files": pour.all_files, "clocks": clocks, "interval": interval, "frame_s": frame_s}
    return store.result("motion", SequenceSync, inputs, measure, part="sequence_sync")


@dataclass(frozen=True)
class SoundPaths:
    """How the sound's travel shifts the clocks.

    Attributes:
        source: [3], metres in the scene; its origin where session.toml gives none.
        applied: whether the clocks were corrected. Without a given source the figures below are only what one at the
            origin would do.
        distance_m: camera -> metres from the source.
        shift_s: camera -> seconds added to its clock's start.
    """

    source: tuple[float, float, float]
    applied: bool
    distance_m: dict[str, float]
    shift_s: dict[str, float]


def sound_paths(session: Session, cameras: Mapping[str, Camera]) -> SoundPaths:
    """What the sound's travel does to the clocks, once the cameras' places are known."""
    source = session.sound.source if session.sound else (0.0, 0.0, 0.0)
    positions = {name: camera.center for name, camera in cameras.items()}
    distance, shift = sync.sound_paths(positions, source, session.reference)
    return SoundPaths(source, session.sound is not None, distance, shift)

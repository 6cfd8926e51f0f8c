"""The motion stage: when the liquid moves, and the source frames that show each timestep."""

from __future__ import annotations

from collections.abc import Mapping

from splashbench.prepare.audio.sync import ClockFit
from splashbench.prepare.session import Session
from splashbench.prepare.stage_cache import StageStore
from splashbench.prepare.video import motion, sampling
from splashbench.prepare.video.motion import MotionInterval
from splashbench.prepare.video.pour import PourRecordings
from splashbench.prepare.video.sampling import Sampling


def motion_interval(
    store: StageStore,
    session: Session,
    pour: PourRecordings,
    clocks: Mapping[str, ClockFit],
    override: tuple[float, float] | None,
) -> MotionInterval:
    """The motion interval as the training cameras see it; `override` or session.toml's where one is given."""
    # Held-out views decide nothing about a scene, not even when it begins.
    cameras = session.train
    override = override or session.motion_interval
    inputs = {"files": {camera: pour.files(camera) for camera in cameras}, "clocks": clocks, "given": override}
    return store.result(
        "motion", MotionInterval, inputs, lambda: motion.find_motion(pour.recordings, clocks, cameras, override)
    )


def sampled_frames(
    store: StageStore,
    pour: PourRecordings,
    clocks: Mapping[str, ClockFit],
    interval: MotionInterval,
    timesteps: int,
    part: str,
) -> Sampling:
    """The source frames of `timesteps` instants spread over the interval; `part` names the result in the store."""
    instants = sampling.sample_times(interval.interval, timesteps)

    def sample() -> Sampling:
        frame_times = {camera: recording.frame_times for camera, recording in pour.recordings.items()}
        return sampling.sample_frames(instants, frame_times, clocks)

    inputs = {"files": pour.all_files, "clocks": clocks, "instants": instants}
    return store.result("motion", Sampling, inputs, sample, part=part)

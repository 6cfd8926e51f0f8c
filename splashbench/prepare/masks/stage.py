"""The masks stage: every camera's liquid masks, made by the provider asked for and kept on disk."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from splashbench.prepare.audio.sync import ClockFit
from splashbench.prepare.calibration.undistort import Undistorter
from splashbench.prepare.masks.session_masks import (
    CameraMasks,
    MaskRecord,
    MaskStore,
    choose_provider,
    make_masks,
)
from splashbench.prepare.session import Session
from splashbench.prepare.stage_cache import StageStore
from splashbench.prepare.video.pour import PourRecordings
from splashbench.prepare.video.sampling import Sampling
from splashbench.progress import track


def masks_of_frames(
    store: StageStore,
    session: Session,
    pour: PourRecordings,
    asked: str | None,
    sampled: Sampling,
    undistorters: Mapping[str, Undistorter],
    clocks: Mapping[str, ClockFit],
    motion_start: float,
) -> tuple[MaskRecord, MaskStore]:
    """The masks of the sampled frames, and what the report tells of them.

    asked: "background" or a folder; None for what session.toml says. motion_start: seconds on the reference's clock.
    """
    provider = choose_provider(session, asked, pour.recordings, clocks, motion_start)
    per_camera = {}
    for camera in track(session.cameras, f"masks ({provider.name})"):
        indices = sampled.indices[camera].tolist()
        inputs = {
            "files": pour.files(camera),
            "indices": indices,
            "lens": undistorters[camera].lens,
            "provider": provider.name,
            "made_from": provider.made_from(camera, indices),
        }
        make = partial(
            make_masks,
            provider=provider,
            camera=camera,
            indices=indices,
            undistorter=undistorters[camera],
            source=pour.recordings[camera],
        )
        per_camera[camera] = store.files("masks", CameraMasks, inputs, make, part=camera)
    masks = MaskStore(per_camera)
    return masks.record(provider.name, undistorters), masks

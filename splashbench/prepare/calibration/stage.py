"""The intrinsics stage: every camera's lens from its board clip."""

from __future__ import annotations

from functools import partial

from splashbench.prepare.calibration.intrinsics import Calibration
from splashbench.prepare.poses.rig import RigRecordings
from splashbench.prepare.stage_cache import StageStore, facts_of
from splashbench.progress import track


def calibrations(store: StageStore, rig: RigRecordings) -> dict[str, Calibration]:
    """Camera -> its calibration."""
    session = rig.session
    return {
        camera: store.result(
            "intrinsics",
            Calibration,
            {"files": facts_of(rig.boards[camera].paths), "board": session.board},
            partial(rig.calibrate, camera),
            part=camera,
        )
        for camera in track(session.cameras, "calibrating lenses")
    }

"""Pass marks: which side passes, what stops a preparation, and what only warns."""

from __future__ import annotations

import json

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.prepare.audio.sync import ClockFit, SequenceSync
from splashbench.prepare.calibration.lens import Lens
from splashbench.prepare.gates import Gate, mask_gates, pixel_limit, pose_gates, require, source_gate, sync_gates
from splashbench.prepare.masks.provider import mask_health
from splashbench.prepare.poses.structure_from_motion import Poses


@pytest.mark.parametrize(
    ("value", "side", "passed"),
    [
        (0.5, "at most", True),
        (0.51, "at most", False),
        (0.5, "at least", True),
        (0.49, "at least", False),
        (float("nan"), "at most", False),
        (float("inf"), "at least", False),
        (None, "at most", False),
        (np.float64(0.25), "at most", True),
    ],
)
def test_a_gate_passes_on_the_right_side_of_its_limit(value, side, passed) -> None:
    gate = Gate("figure", value, 0.5, side, "what it is")
    assert gate.passed is passed
    json.dumps(gate.as_json(), allow_nan=False)


def test_only_essential_gates_stop() -> None:
    soft, hard = (Gate("figure", 2.0, 1.0, "at most", "px, camera 4", essential) for essential in (False, True))
    require([soft], "sessions/monday")
    with pytest.raises(SplashbenchError, match=r"sessions/monday: figure is 2, at most 1 is needed \(px, camera 4\)"):
        require([soft, hard], "sessions/monday")


def test_pixel_limit_scales_with_the_image() -> None:
    assert pixel_limit(480) == 0.5
    assert pixel_limit(3840) == 3.84


def clock(residual: float, status: str = "ok") -> ClockFit:
    return ClockFit(0.1, 1.0, 12.0, residual, 20, status)


def test_sync_gates_name_the_worst_camera_and_those_not_measured() -> None:
    clocks = {"1": clock(0.0), "2": clock(0.002), "3": clock(0.0005)}
    found = {gate.name: gate for gate in sync_gates(clocks, SequenceSync(0.009, {"1": 0.0, "2": 0.0}, ("3",)))}
    assert found["cameras_synchronised"].passed
    assert not found["clock_residual"].passed
    assert "camera 2" in found["clock_residual"].detail
    assert not found["sequence_sync"].passed  # 9 ms are more than half a frame
    assert "3" in found["sequence_sync"].detail
    lost = sync_gates(clocks | {"3": clock(float("nan"), "silent")}, None)
    assert [gate.passed for gate in lost if gate.essential] == [False]


def test_pose_gates_count_cameras_and_sweep() -> None:
    poses = Poses(
        w2c={"1": np.eye(4), "2": np.eye(4)},
        sweep_w2c=np.zeros((4, 4, 4)),
        sweep_indices=(0, 1, 2, 3),
        sweep_lens=Lens(480, 270, np.eye(3), np.zeros(5)),
        n_sweep=10,
        points=np.zeros((100, 3)),
        colours=np.zeros((100, 3)),
        mean_error_px=0.3,
        rms_error_px=0.4,
        n_observations=500,
    )
    found = {gate.name: gate for gate in pose_gates(poses, ["1", "2", "3"], 480)}
    assert not found["cameras_posed"].passed
    assert found["cameras_posed"].essential
    assert found["mean_reprojection"].passed
    assert found["track_length"].value == 5.0
    assert not found["sweep_registered"].passed


def test_mask_gates_report_the_camera_with_most_empty_masks() -> None:
    health = {"1": mask_health([5, 6, 7, 8], 1000), "2": mask_health([0, 0, 0, 8], 1000)}
    failed, empty = mask_gates(health, 4)
    assert failed.passed
    assert not empty.passed
    assert empty.value == 0.75
    assert "camera 2" in empty.detail
    assert not source_gate({"1": 1.0, "2": 0.97}).passed

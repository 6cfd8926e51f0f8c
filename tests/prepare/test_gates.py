"""Gates: which side passes, what stops a preparation, and what only warns."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from splashbench.alignment import Similarity
from splashbench.container.placement import Placement
from splashbench.container.verification import Projection
from splashbench.errors import SplashbenchError
from splashbench.prepare.audio.sync import ClockFit, SequenceSync
from splashbench.prepare.calibration.intrinsics import Calibration
from splashbench.prepare.calibration.lens import Lens
from splashbench.prepare.container import PlacedContainer
from splashbench.prepare.gate import Gate, require, told_with
from splashbench.prepare.gates import (
    container_gates,
    intrinsics_gates,
    mask_gates,
    metric_gates,
    pixel_limit,
    pose_gates,
    sampling_gates,
    source_gate,
    sync_gates,
)
from splashbench.prepare.masks.provider import mask_health
from splashbench.prepare.poses.metric import MetricFrame
from splashbench.prepare.poses.scale import SceneFrame
from splashbench.prepare.poses.structure_from_motion import Poses
from splashbench.prepare.video.sampling import Sampling


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


def test_whoever_films_again_is_told_of_everything_that_failed() -> None:
    first, second = (Gate(f"figure_{k}", 2.0, 1.0, "at most", "px", True, f"film {k} again") for k in "ab")
    warning = Gate("figure_c", None, 1.0, "at least", "px", False, "film c again")
    good = Gate("figure_d", 1.0, 1.0, "at least", "px", True, "film d again")
    with pytest.raises(SplashbenchError) as caught:
        require([warning, first, good, second], "monday")
    told = str(caught.value)
    assert [told.count(f"film {k} again") for k in "abcd"] == [1, 1, 1, 0]
    assert told.index("figure_a") < told.index("figure_b") < told.index("figure_c is unknown")  # what stops comes first
    # A stage that fails for a reason that the gates before it know says so.
    why = r"no pose for camera 4\. Besides: figure_a is 2, .*film a again"
    with pytest.raises(SplashbenchError, match=why), told_with([first, good]):
        raise SplashbenchError("no pose for camera 4")


def test_a_lens_that_was_not_determined_stops() -> None:
    """A board that was never tilted: the focal length's deviation was 125%."""
    gates = intrinsics_gates({"1": calibration(), "2": calibration(focal_sigma=500.0), "3": calibration(21.0)})
    with pytest.raises(SplashbenchError, match=r"lens_is_determined is 1\.25, .*film the board again .* 2, 3: tilt"):
        require(gates, "monday")
    with pytest.raises(SplashbenchError, match=r"lens_fits is 2\.1, .*film the board again with camera 2: flat"):
        require(intrinsics_gates({"1": calibration(), "2": calibration(held_out=2.1)}), "monday")
    require(intrinsics_gates({"1": calibration(focal_sigma=19.0, held_out=1.9)}), "monday")


def test_every_gate_says_what_to_do() -> None:
    frame = metric_frame(3e-2, {"board": 1.0, "distance": 0.8}, 2e-3)
    poses = Poses(
        {"1": np.eye(4)},
        np.zeros((1, 4, 4)),
        (0,),
        calibration().lens,
        9,
        np.zeros((3, 3)),
        np.zeros((3, 3)),
        9.0,
        9.0,
        6,
        {"1": 1.0},
        {"1": 1.0},
    )
    gates = [
        *intrinsics_gates({"1": calibration(50.0, 0.1, 9.0)}),
        *sync_gates({"1": clock(1.0)}, SequenceSync(1.0, {}, ("1",))),
        *sampling_gates(Sampling(np.zeros(1), np.zeros(1), {}, {}, {"1": np.ones(1, bool)})),
        *pose_gates(poses, {"1": 480, "2": 480}),
        *metric_gates(frame),
        *mask_gates({"1": mask_health([0, 0], 1000)}, 2),
        *container_gates(placed(GOOD | {"1": 0.1, "2": 0.1}), ["1", "2", "3"], dict.fromkeys("12367", 1920)),
        source_gate({"1": 0.5}),
    ]
    assert len(gates) > 25
    assert [gate.name for gate in gates if gate.remedy == "film it again"] == []


def test_pixel_limit_scales_with_the_image() -> None:
    assert pixel_limit(480) == 0.5
    assert pixel_limit(3840) == 3.84


def clock(residual: float, status: str = "ok") -> ClockFit:
    return ClockFit(0.1, 1.0, 12.0, residual, 20, status)


def test_sync_gates_name_the_worst_camera_and_those_not_measured() -> None:
    clocks = {"1": clock(0.0), "2": clock(0.002), "3": clock(0.0005)}
    found = {gate.name: gate for gate in sync_gates(clocks, SequenceSync(0.009, {"1": 0.0, "2": 0.0}, ("3",), 0.0123))}
    assert found["cameras_synchronised"].passed
    assert not found["clock_residual"].passed
    assert "camera 2" in found["clock_residual"].detail
    assert not found["sequence_sync"].passed  # 9 ms are more than half a frame
    assert found["sequence_sync"].value == 0.009
    detail = found["sequence_sync"].detail
    assert detail.startswith("s RMS about the fitted clocks")
    assert "12.3 ms after whole-frame shifts, the paper's Sync RMS" in detail
    assert "3" in detail
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
    found = {gate.name: gate for gate in pose_gates(poses, dict.fromkeys("123", 480))}
    assert not found["cameras_posed"].passed
    assert found["cameras_posed"].essential
    assert found["mean_reprojection"].passed
    assert found["track_length"].value == 5.0
    assert not found["sweep_registered"].passed  # 4 of 10 frames, half is needed


def test_mask_gates_report_the_camera_with_most_empty_masks() -> None:
    health = {"1": mask_health([5, 6, 7, 8], 1000), "2": mask_health([0, 0, 0, 8], 1000)}
    failed, empty = mask_gates(health, 4)
    assert failed.passed
    assert not empty.passed
    assert empty.value == 0.75
    assert "camera 2" in empty.detail
    assert not source_gate({"1": 1.0, "2": 0.97}).passed


def calibration(focal_sigma: float = 0.4, coverage: float = 0.9, held_out: float = 0.3) -> Calibration:
    lens = Lens(480, 270, np.diag([400.0, 400.0, 1.0]), np.zeros(5))
    return Calibration(lens, 0.2, held_out, focal_sigma, coverage, 150, 100, 0, 0, 50, np.zeros((0, 2)))


@pytest.mark.parametrize(
    ("worse", "gate"),
    [
        ({"focal_sigma": 2.4}, "focal_sigma"),  # 0.6% of the focal length
        ({"coverage": 0.5}, "board_coverage"),
        ({"held_out": 0.6}, "held_out_reprojection"),
    ],
)
def test_intrinsics_gates_judge_the_worst_camera(worse: dict[str, float], gate: str) -> None:
    gates = intrinsics_gates({"1": calibration(), "2": calibration(**worse), "3": calibration()})
    assert [failed.name for failed in gates if not failed.passed] == [gate]
    assert all(found.detail.endswith("camera 2") for found in gates if found.name == gate)
    assert all(found.passed for found in intrinsics_gates({"1": calibration()}))


def metric_frame(rms: float, scales: dict[str, float], scale_sigma: float = 5e-4) -> SceneFrame:
    similarity = Similarity(1.0, np.eye(3), np.zeros(3))
    board = MetricFrame(similarity, rms, 28, 9, 0.3, np.zeros((28, 3)), scale_sigma)
    return SceneFrame(similarity, "board", "board", scales, {"board": scale_sigma}, board)


@pytest.mark.parametrize(
    ("frame", "failed", "stops"),
    [
        (metric_frame(1e-3, {"board": 1.0}), [], False),
        (metric_frame(3e-3, {"board": 1.0}), ["board_residual"], False),
        (metric_frame(3e-2, {"board": 1.0}), ["board_residual", "board_is_a_board"], True),
        (metric_frame(1e-3, {"board": 1.0}, 2e-3), ["scale_sigma"], False),
        (metric_frame(1e-3, {"board": 1.0, "distance": 0.97}), ["scale_agreement"], False),
        (metric_frame(1e-3, {"board": 1.0, "distance": 0.8}), ["scale_agreement", "scale_is_one"], True),
    ],
)
def test_metric_gates_warn_of_doubts_and_stop_at_nonsense(frame: SceneFrame, failed: list[str], stops: bool) -> None:
    gates = metric_gates(frame)
    assert [gate.name for gate in gates if not gate.passed] == failed
    assert any(gate.essential and not gate.passed for gate in gates) is stops


def test_sampling_gate_counts_frames_of_all_cameras() -> None:
    flags = {"1": np.array([True, False]), "2": np.array([True, True])}
    (gate,) = sampling_gates(Sampling(np.arange(2.0), np.arange(2.0), {}, {}, flags))
    assert (gate.value, gate.passed) == (3, False)


def placed(ious: dict[str, float], median_px: float | None = 0.5, **changes) -> PlacedContainer:
    placement = Placement(
        pose=np.eye(4),
        scale=1.0,
        up_axis="y",
        up=np.array([0.0, 1.0, 0.0]),
        up_is_ambiguous=False,
        turn="free",
        equivalent_turns=0,
        cameras=("1", "2", "3"),
        projections={},
        position_sigma=1e-3,
    )
    return PlacedContainer(
        replace(placement, **changes), {name: Projection(iou, median_px, median_px) for name, iou in ious.items()}
    )


GOOD = {"1": 0.98, "2": 0.97, "3": 0.99, "6": 0.96, "7": 0.95}


@pytest.mark.parametrize(
    ("container", "failed"),
    [
        (placed(GOOD), []),
        (placed(GOOD | {"1": 0.2}), []),  # a hand before one training camera
        (placed(GOOD | {"1": 0.94, "2": 0.9}), ["container_iou"]),
        (placed(GOOD | {"1": 0.6, "2": 0.7}), ["container_iou", "container_is_the_container"]),
        (placed(GOOD | {"6": 0.85}), ["container_held_out"]),
        (placed(GOOD, 4.0), ["container_outline"]),
        (placed(GOOD, None), ["container_outline"]),
        (placed(GOOD, position_sigma=3e-3), ["container_sigma"]),
        (placed(GOOD, point_rms_px={"1": 2.0, "2": 6.0}), ["container_clicks"]),
        (placed({"6": 0.95}, point_rms_px={"1": 60.0}), ["container_clicks", "container_clicks_fit"]),
        (placed(GOOD, up=np.array([0.1, 1.0, 0.0])), ["container_upright"]),
    ],
)
def test_container_gates(container: PlacedContainer, failed: list[str]) -> None:
    gates = container_gates(container, ["1", "2", "3"], dict.fromkeys("12367", 1920))
    assert [gate.name for gate in gates if not gate.passed] == failed


def test_only_another_container_or_senseless_clicks_stop() -> None:
    other = container_gates(placed(dict.fromkeys(GOOD, 0.5)), ["1", "2", "3"], dict.fromkeys("12367", 1920))
    assert [gate.name for gate in other if gate.essential and not gate.passed] == ["container_is_the_container"]
    senseless = container_gates(placed({}, point_rms_px={"1": 60.0}), ["1"], dict.fromkeys("12367", 1920))
    assert [gate.name for gate in senseless if gate.essential and not gate.passed] == ["container_clicks_fit"]

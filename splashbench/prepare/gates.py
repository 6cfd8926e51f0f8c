"""Gates of a preparation: figures that tell a sound scene from one that merely was computed.

An essential gate that fails stops `prepare`; any other is a warning in the report. Limits follow from what the figure
does to a scene, or from what the paper's captures reach. They stand beside the value in the report.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.prepare.audio.sync import ClockFit, SequenceSync
from splashbench.prepare.calibration.intrinsics import Calibration
from splashbench.prepare.container import PlacedContainer
from splashbench.prepare.masks.provider import MaskHealth
from splashbench.prepare.poses.scale import SceneFrame
from splashbench.prepare.poses.structure_from_motion import Poses
from splashbench.prepare.video.sampling import Sampling

# Half a frame at 60 fps: the paper's mark for a well synchronised sequence (Sec. S1.1).
HALF_FRAME_S = 0.5 / 60


@dataclass(frozen=True)
class Gate:
    """One figure and its limit. `value` is None where the figure could not be had, which fails."""

    name: str
    value: float | None
    limit: float
    side: Literal["at most", "at least"]
    detail: str
    essential: bool = False
    remedy: str = "film it again"

    @property
    def passed(self) -> bool:
        """Whether the value is on the right side of the limit."""
        if self.value is None or not np.isfinite(self.value):
            return False
        return bool(self.value <= self.limit if self.side == "at most" else self.value >= self.limit)

    def as_json(self) -> dict[str, Any]:
        """The gate as it stands in prepare_report.json."""
        value = float(self.value) if self.value is not None and np.isfinite(self.value) else None
        return {
            "name": self.name,
            "value": value,
            "limit": self.limit,
            "side": self.side,
            "passed": self.passed,
            "essential": self.essential,
            "detail": self.detail,
        }


def pixel_limit(width: int) -> float:
    """Reprojection error to accept, in pixels of an image `width` wide: 1 px per 1000, never below half a pixel.

    The paper's 0.9 px at 3840 is 0.23 px per 1000; features of small images are not found to better than a fraction
    of a pixel whatever the camera.
    """
    return max(0.5, width / 1000)


def intrinsics_gates(calibrations: Mapping[str, Calibration]) -> list[Gate]:
    """Focal length's uncertainty, coverage and error on unseen views: the worst camera counts."""
    sigma = {camera: c.focal_sigma_px / c.lens.focal for camera, c in calibrations.items()}
    held_out = {camera: c.held_out_rms_px / pixel_limit(c.lens.width) for camera, c in calibrations.items()}
    covered = {camera: c.coverage for camera, c in calibrations.items()}
    worst_sigma, worst_error = max(sigma, key=sigma.__getitem__), max(held_out, key=held_out.__getitem__)
    least = min(covered, key=covered.__getitem__)
    limit = pixel_limit(calibrations[worst_error].lens.width)
    return [
        Gate("focal_sigma", sigma[worst_sigma], 0.005, "at most", f"share of the focal length, camera {worst_sigma}"),
        Gate("board_coverage", covered[least], 0.6, "at least", f"share of the image's 8 x 6 cells, camera {least}"),
        Gate(
            "held_out_reprojection",
            calibrations[worst_error].held_out_rms_px,
            limit,
            "at most",
            f"px RMS of {calibrations[worst_error].lens.width} px wide frames the fit never saw, camera {worst_error}",
        ),
    ]


def sync_gates(clocks: Mapping[str, ClockFit], sequence: SequenceSync | None) -> list[Gate]:
    """Every clock found, their scatter, and what the clocks leave over in the sequence.

    The paper's own figure stands in the detail: it shifts by whole frames, which is not how frames are chosen here.
    """
    n_found = sum(fit.status == "ok" for fit in clocks.values())
    scatter = {camera: fit.residual_rms_s for camera, fit in clocks.items()}
    worst = max(scatter, key=scatter.__getitem__)
    gates = [
        Gate("cameras_synchronised", n_found, len(clocks), "at least", f"of {len(clocks)} cameras", essential=True),
        Gate(
            "clock_residual", scatter[worst], 1e-3, "at most", f"s RMS of the windows about the clock, camera {worst}"
        ),
    ]
    if sequence is not None and sequence.clock_rms_s is not None:
        missing = f"; not measurable: {', '.join(sequence.unmeasured)}" if sequence.unmeasured else ""
        whole = sequence.whole_frame_rms_s
        paper = "" if whole is None else f"; {whole * 1e3:.1f} ms after whole-frame shifts, the paper's Sync RMS"
        detail = f"s RMS about the fitted clocks, by the sequence's own sound{paper}{missing}"
        gates.append(Gate("sequence_sync", sequence.clock_rms_s, HALF_FRAME_S, "at most", detail))
    return gates


def pose_gates(poses: Poses, cameras: Iterable[str], width: int) -> list[Gate]:
    """All fixed cameras posed, the reprojection error, and how much of the sweep helped."""
    names = list(cameras)
    posed = sum(camera in poses.w2c for camera in names)
    gates = [
        Gate("cameras_posed", posed, len(names), "at least", f"of {len(names)} cameras", essential=True),
        Gate(
            "mean_reprojection",
            poses.mean_error_px,
            pixel_limit(width),
            "at most",
            f"px, mean over {poses.n_observations} observations in frames {width} px wide",
        ),
        Gate("track_length", poses.mean_track_length, 3.0, "at least", "images per point, mean"),
    ]
    if poses.centre_sigma:
        worst = max(poses.centre_sigma, key=poses.centre_sigma.__getitem__)
        detail = f"m, by the noise of the features alone, camera {worst}"
        gates.append(Gate("centre_sigma", poses.centre_sigma[worst], 1e-3, "at most", detail))
        turned = max(poses.rotation_sigma_deg, key=poses.rotation_sigma_deg.__getitem__)
        detail = f"degrees, likewise, camera {turned}"
        gates.append(Gate("rotation_sigma", poses.rotation_sigma_deg[turned], 0.05, "at most", detail))
    if poses.n_sweep:
        share = len(poses.sweep_w2c) / poses.n_sweep
        gates.append(Gate("sweep_registered", share, 0.5, "at least", f"share of {poses.n_sweep} frames"))
    return gates


def metric_gates(frame: SceneFrame) -> list[Gate]:
    """How well each triangulated print has the shape of the printed one, and how well sources of scale agree."""
    gates = []
    for name, seen in frame.prints.items():
        relative = seen.rms_m / seen.board_diagonal_m
        detail = f"RMS over the {name}'s diagonal, {seen.n_corners} corners in {seen.n_views} images"
        gates += [
            Gate(f"{name}_residual", relative, 0.005, "at most", detail),
            Gate(
                f"{name}_is_a_{name}", relative, 0.05, "at most", "as above; beyond this the scale is meaningless", True
            ),
        ]
    sigma = frame.scale_sigma.get(frame.scale_source)
    if sigma is not None:
        gates.append(Gate("scale_sigma", sigma, 1e-3, "at most", f"share of the scale, by the {frame.scale_source}"))
    if frame.scale_disagreement is not None:
        detail = f"share, largest difference between {', '.join(frame.scales)}"
        gates.append(Gate("scale_agreement", frame.scale_disagreement, 0.01, "at most", detail))
        remedy = "measure them again, and correct or leave out the wrong one in session.toml"
        gates.append(Gate("scale_is_one", frame.scale_disagreement, 0.1, "at most", detail, True, remedy))
    return gates


def sampling_gates(sampling: Sampling) -> list[Gate]:
    """Frames that miss their instant by more than half a source frame."""
    missed = int(sum(flags.sum() for flags in sampling.flagged.values()))
    return [Gate("frames_off_their_instant", missed, 0, "at most", "images more than half a source frame off")]


def mask_gates(health: Mapping[str, MaskHealth], n_frames: int) -> list[Gate]:
    """Masks that cannot be right, and masks without liquid."""
    failed = sum(len(h.failed) for h in health.values())
    empty = max(len(h.empty) for h in health.values()) / n_frames
    emptiest = max(health, key=lambda camera: len(health[camera].empty))
    return [
        Gate("masks_failed", failed, 0, "at most", "flooded or flickering masks over all cameras"),
        Gate("masks_empty", empty, 0.2, "at most", f"share of empty masks, camera {emptiest}"),
    ]


def container_gates(placed: PlacedContainer, train: Iterable[str], width: int) -> list[Gate]:
    """How well the placed mesh covers its masks, of the cameras that placed it and of those that did not."""
    seen, placement = placed.projections, placed.placement
    fitted = [camera for camera in train if camera in seen]
    held_out = [camera for camera in seen if camera not in fitted]
    gates = []
    if fitted:
        # The median: a hand may hide the container from one camera.
        overlap = float(np.median([seen[camera].iou for camera in fitted]))
        gates.append(
            Gate("container_iou", overlap, 0.95, "at least", "projected mesh and mask, median of training views")
        )
        detail_of_limit, remedy = "as above; below it, it is another mesh", "check mesh, masks and metres_per_unit"
        gates.append(Gate("container_is_the_container", overlap, 0.8, "at least", detail_of_limit, True, remedy))
        medians_px = {camera: seen[camera].contour_median_px for camera in fitted}
        medians = {camera: np.inf if median is None else median for camera, median in medians_px.items()}
        worst = max(fitted, key=medians.__getitem__)
        detail = f"px between projected and masked outline, median, camera {worst}"
        gates.append(Gate("container_outline", medians[worst], max(1.5, width / 1000), "at most", detail))
    if held_out:
        worst = min(held_out, key=lambda camera: seen[camera].iou)
        detail = f"projected mesh and mask, held-out camera {worst}"
        gates.append(Gate("container_held_out", seen[worst].iou, 0.9, "at least", detail))
    if placement.position_sigma is not None:
        gates.append(
            Gate("container_sigma", placement.position_sigma, 2e-3, "at most", "m, its centre, by leaving out cameras")
        )
    clicked = {name: error for name, error in (placement.point_rms_px or {}).items() if np.isfinite(error)}
    if clicked:
        worst = max(clicked, key=clicked.__getitem__)
        detail = f"px RMS between clicked and projected points, camera {worst}"
        gates.append(Gate("container_clicks", clicked[worst], max(5.0, width / 400), "at most", detail))
        if not fitted:  # nothing else tells whether the clicks make sense
            remedy = "check the points under [container]"
            gates.append(Gate("container_clicks_fit", clicked[worst], width / 40, "at most", detail, True, remedy))
    up = np.asarray(placement.up)
    tilt = float(np.degrees(np.arccos(np.clip(up[1] / np.linalg.norm(up), -1, 1))))
    gates.append(Gate("container_upright", tilt, 2.0, "at most", "degrees between its axis and the scene's up"))
    return gates


def source_gate(share: Mapping[str, float]) -> Gate:
    """Whether pixels of the written images lie outside the raw frame (pincushion distortion)."""
    least = min(share, key=share.__getitem__)
    return Gate("pixels_with_source", share[least], 0.999, "at least", f"share of the written image, camera {least}")


def require(gates: Iterable[Gate], source: str) -> None:
    """Raise SplashbenchError for the first essential gate that failed."""
    for gate in gates:
        if gate.essential and not gate.passed:
            value = "unknown" if gate.value is None else f"{gate.value:.4g}"
            raise SplashbenchError(
                f"{source}: {gate.name} is {value}, {gate.side} {gate.limit:.4g} is needed ({gate.detail});"
                f" {gate.remedy}"
            )

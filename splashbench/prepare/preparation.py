"""The outcome of preparing one session, as prepare_report.json tells it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from splashbench.prepare.audio.clocks import SoundPaths, SyncResult
from splashbench.prepare.audio.sync import ClockFit, SequenceSync
from splashbench.prepare.calibration.intrinsics import Calibration
from splashbench.prepare.container import PlacedContainer
from splashbench.prepare.crop import PixelBox
from splashbench.prepare.gate import Gate
from splashbench.prepare.masks.session_masks import MaskRecord
from splashbench.prepare.media.container import VideoInfo
from splashbench.prepare.poses.scale import SceneFrame
from splashbench.prepare.poses.stillness import Stillness
from splashbench.prepare.poses.structure_from_motion import Poses
from splashbench.prepare.scene_output import ReportPictures
from splashbench.prepare.session import Session
from splashbench.prepare.stage_cache import Stage, StageRecord
from splashbench.prepare.video.motion import MotionInterval
from splashbench.prepare.video.sampling import Sampling
from splashbench.version import __version__

SCHEMA_VERSION = 1


@dataclass(frozen=True)
class Preparation:
    """The outcome of every stage.

    Attributes:
        poses: in the scene's frame.
        clocks: `synced.clocks`, corrected for the sound's travel where its source is given.
        stages: how long each took. No part of the reports: those tell of the scene alone, and are the same however
            often a preparation was interrupted.
    """

    session: Session
    synced: SyncResult
    calibrations: dict[str, Calibration]
    clocks: dict[str, ClockFit]
    sound_paths: SoundPaths
    sequence: SequenceSync
    poses: Poses
    metric: SceneFrame
    stillness: dict[str, Stillness]
    motion: MotionInterval
    sampling: Sampling
    masks: MaskRecord
    container: PlacedContainer | None
    windows: dict[str, PixelBox]
    cropped: bool
    gates: list[Gate]
    stages: dict[Stage, StageRecord]
    pictures: ReportPictures = field(default_factory=ReportPictures, repr=False)

    @property
    def warnings(self) -> list[Gate]:
        """Gates that did not pass."""
        return [gate for gate in self.gates if not gate.passed]

    def as_json(self) -> dict[str, Any]:
        """The content of prepare_report.json. Times in seconds on the reference camera's clock, lengths in metres."""
        return {
            "schema_version": SCHEMA_VERSION,
            "splashbench": __version__,
            "session": self.session.name,
            "reference": self.session.reference,
            "sync": {camera: self._sync(camera) for camera in self.clocks},
            "recordings": {camera: _recording(video) for camera, video in self.synced.videos.items()},
            "sound_paths": {
                "source": list(self.sound_paths.source),
                "applied": self.sound_paths.applied,
                "distance_m": self.sound_paths.distance_m,
                "shift_s": self.sound_paths.shift_s,
            },
            "intrinsics": {camera: _intrinsics(c) for camera, c in self.calibrations.items()},
            "poses": {
                camera: {
                    "w2c": matrix.tolist(),
                    "centre_sigma_m": self.poses.centre_sigma.get(camera),
                    "rotation_sigma_deg": self.poses.rotation_sigma_deg.get(camera),
                    "centre_sigma_of_features_m": self.poses.feature_centre_sigma.get(camera),
                    "rotation_sigma_of_features_deg": self.poses.feature_rotation_sigma_deg.get(camera),
                }
                for camera, matrix in self.poses.w2c.items()
            },
            "structure_from_motion": {
                "mean_reprojection_px": self.poses.mean_error_px,
                "rms_reprojection_px": self.poses.rms_error_px,
                "definition": "over all observations of all registered images, pixels of the raw frames",
                "image_width": next(iter(self.calibrations.values())).lens.width,
                "points": len(self.poses.points),
                "observations": self.poses.n_observations,
                "sweep_frames": self.poses.n_sweep,
                "sweep_frames_registered": len(self.poses.sweep_w2c),
                "attempts": list(self.poses.attempts),
                "sweep_K": self.poses.sweep_lens.K.tolist(),
            },
            "metric": {
                "up_from": self.metric.up_source,
                "metres_from": self.metric.scale_source,
                "metres_per_unit": self.metric.scales,
                "scale_sigma": self.metric.scale_sigma,
                "prints": {
                    name: {"rms_m": seen.rms_m, "corners": seen.n_corners, "images": seen.n_views}
                    for name, seen in self.metric.prints.items()
                },
                "frame": "metres, +y up; origin at the middle of the print, +x along it",
            },
            "stillness": {
                camera: {
                    instant: {"shift_px": shift.px, "features": shift.agreeing, "matched": shift.matched}
                    for instant, shift in seen.items()
                }
                for camera, seen in self.stillness.items()
            },
            "motion": {
                "start_s": self.motion.start,
                "end_s": self.motion.end,
                "reasons": list(self.motion.reasons),
            },
            "sequence_sync": {
                "clock_rms_s": self.sequence.clock_rms_s,
                "whole_frame_rms_s": self.sequence.whole_frame_rms_s,
                "definition": "RMS over cameras of the offsets in the motion interval: along the fitted clocks, and as"
                " the paper's Sync RMS after one shift by whole frames per camera",
                "unmeasured": list(self.sequence.unmeasured),
            },
            "sampling": {
                "times": self.sampling.times.tolist(),
                "nominal": self.sampling.nominal.tolist(),
                "camera_times": {camera: times.tolist() for camera, times in self.sampling.camera_times.items()},
                "source_frames": {camera: frames.tolist() for camera, frames in self.sampling.indices.items()},
                "largest_spread_s": float(self.sampling.spread_s.max()),
            },
            "masks": {
                "provider": self.masks.provider,
                "areas_px": self.masks.areas,
                "empty": {camera: health.empty for camera, health in self.masks.health.items()},
                "faults": {camera: {str(t): why for t, why in f.items()} for camera, f in self.masks.faults.items()},
                "failed": {camera: health.failed for camera, health in self.masks.health.items()},
            },
            "container": None if self.container is None else _container(self.container),
            "crop": {
                "applied": self.cropped,
                "windows": {camera: [box.x0, box.y0, box.x1, box.y1] for camera, box in self.windows.items()},
            },
            "gates": [gate.as_json() for gate in self.gates],
        }

    def _sync(self, camera: str) -> dict[str, Any]:
        fit = self.clocks[camera]
        return {
            "start_s": fit.start_s,
            "clock_rate": fit.clock_rate,
            # The reference agrees with itself without bound, which JSON cannot say.
            "confidence": _finite(fit.confidence),
            "residual_rms_s": fit.residual_rms_s,
            "windows": fit.n_windows,
            "agreement": fit.agreement,
            "drift_interval": _finite(fit.drift_interval),
            "interval_s": _finite(fit.interval_s),
            "earlier_sound_s": fit.echo_s,
            "status": fit.status,
            "seams": [{"time_s": seam.time_s, "gap_s": seam.gap_s} for seam in self.synced.seams[camera]],
            "sequence_offset_s": self.sequence.offsets_s.get(camera),
        }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _recording(video: VideoInfo) -> dict[str, Any]:
    return {
        "width": video.width,
        "height": video.height,
        "fps": video.fps,
        "frames": video.n_frames,
        "seconds": video.duration,
        "codec": video.codec,
        "timecode": video.timecode,
        "created": video.created,
        "audio_minus_video_s": video.audio_minus_video_s,
    }


def _container(placed: PlacedContainer) -> dict[str, Any]:
    placement = placed.placement
    return {
        "pose": placement.pose.tolist(),
        "metres_per_unit": placement.scale,
        "up_axis": placement.up_axis,
        "up_is_ambiguous": placement.up_is_ambiguous,
        "turn": placement.turn,
        "equivalent_turns": placement.equivalent_turns,
        "decided_by": list(placement.cameras),
        "position_sigma_m": placement.position_sigma,
        "tilt_sigma_degrees": placement.tilt_sigma_degrees,
        "points_rms_px": placement.point_rms_px or None,
        "projections": {
            camera: {
                "iou": seen.iou,
                "outline_rms_px": seen.contour_rms_px,
                "outline_median_px": seen.contour_median_px,
            }
            for camera, seen in placed.projections.items()
        },
    }


def _intrinsics(calibration: Calibration) -> dict[str, Any]:
    lens = calibration.lens
    return {
        "K": lens.K.tolist(),
        "distortion": lens.distortion.tolist(),
        "width": lens.width,
        "height": lens.height,
        "rms_px": calibration.rms_px,
        "held_out_rms_px": calibration.held_out_rms_px,
        "focal_sigma_px": calibration.focal_sigma_px,
        "coverage": calibration.coverage,
        "frames_searched": calibration.n_searched,
        "boards_detected": calibration.n_detected,
        "false_detections": calibration.n_false,
        "outlier_views": calibration.n_outliers,
        "views_used": calibration.n_views,
    }

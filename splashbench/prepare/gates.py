"""Gates of a preparation: figures that tell a sound scene from one that merely was computed.

Limits follow from what the figure does to a scene, or from what the paper's captures reach. They stand beside the value
in the report.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from splashbench.prepare.audio.sync import ClockFit, SequenceSync
from splashbench.prepare.calibration.intrinsics import Calibration
from splashbench.prepare.container import PlacedContainer
from splashbench.prepare.gate import Gate
from splashbench.prepare.masks.provider import MaskHealth
from splashbench.prepare.poses.scale import SceneFrame
from splashbench.prepare.poses.stillness import MIN_AGREEING, Stillness
from splashbench.prepare.poses.structure_from_motion import Poses
from splashbench.prepare.video.sampling import Sampling

# Half a frame at 60 fps: the paper's mark for a well synchronised sequence (Sec. S1.1).
HALF_FRAME_S = 0.5 / 60
CLOCK_INTERVAL_S = 2e-3  # a quarter of that: liquid at 1 m/s moves by 2 mm
CLOCK_AGREEMENT = 0.15  # of the windows; chance alone makes one in fifty agree
FOCAL_SIGMA = 0.005  # of the focal length: a point at the rig's distance then errs by half a percent in depth
CENTRE_SIGMA = 5e-3  # metres: what the focal length's limit amounts to a metre away from the scene
COVERAGE = 0.6  # of the image's cells
SWEEP_AGAIN = "film the sweep again, slowly and closer, with light enough for sharp frames"


def pixel_limit(width: int) -> float:
    """Reprojection error to accept, in pixels of an image `width` wide: 1 px per 1000, never below half a pixel.

    The paper's 0.9 px at 3840 is 0.23 px per 1000; features of small images are not found to better than a fraction
    of a pixel whatever the camera.
    """
    return max(0.5, width / 1000)


def intrinsics_gates(calibrations: Mapping[str, Calibration]) -> list[Gate]:
    """Focal length's uncertainty, coverage and error on unseen views: the worst camera counts.

    Beyond ten times the limit a focal length is no measurement, and beyond four times its limit an error on unseen
    views is no lens: either stops, as every later figure rests on it.
    """
    sigma = {camera: c.focal_sigma_px / c.lens.focal for camera, c in calibrations.items()}
    held_out = {camera: c.held_out_rms_px / pixel_limit(c.lens.width) for camera, c in calibrations.items()}
    covered = {camera: c.coverage for camera, c in calibrations.items()}
    worst_sigma, worst_error = max(sigma, key=sigma.__getitem__), max(held_out, key=held_out.__getitem__)
    least = min(covered, key=covered.__getitem__)
    limit, error = pixel_limit(calibrations[worst_error].lens.width), calibrations[worst_error].held_out_rms_px
    focal_detail = f"share of the focal length, camera {worst_sigma}"
    error_detail = (
        f"px RMS of {calibrations[worst_error].lens.width} px wide frames the fit never saw, camera {worst_error}"
    )

    def cameras(figures: Mapping[str, float], limit: float, worst: str) -> str:
        return ", ".join(camera for camera, value in figures.items() if not value <= limit) or worst

    def tilted(limit: float) -> str:
        return (
            f"film the board again with camera {cameras(sigma, limit, worst_sigma)}: tilt it 30 to 45 degrees to every"
            " side, near and far, and hold it still"
        )

    def sharp(limit: float) -> str:
        return (
            f"film the board again with camera {cameras(held_out, limit, worst_error)}: flat, well lit, without blur,"
            " stabilisation off, at the focus and zoom of the pour"
        )

    uncovered = ", ".join(camera for camera, share in covered.items() if share < COVERAGE) or least
    to_the_edges = f"film the board again with camera {uncovered}: carry it into every corner of the picture"
    return [
        Gate("focal_sigma", sigma[worst_sigma], FOCAL_SIGMA, "at most", focal_detail, False, tilted(FOCAL_SIGMA)),
        Gate(
            "lens_is_determined",
            sigma[worst_sigma],
            10 * FOCAL_SIGMA,
            "at most",
            f"{focal_detail}; beyond this no lens was measured",
            True,
            tilted(10 * FOCAL_SIGMA),
        ),
        Gate(
            "board_coverage",
            covered[least],
            COVERAGE,
            "at least",
            f"share of the image's 8 x 6 cells, camera {least}",
            False,
            to_the_edges,
        ),
        Gate("held_out_reprojection", error, limit, "at most", error_detail, False, sharp(1.0)),
        Gate(
            "lens_fits",
            error,
            4 * limit,
            "at most",
            f"{error_detail}; beyond this it is another lens",
            True,
            sharp(4.0),
        ),
    ]


def shown_widths(widths: Iterable[int]) -> str:
    """The widths of a rig's images, such as "3840" or "1920 to 3840"."""
    among = sorted(set(widths))
    return str(among[0]) if len(among) == 1 else f"{among[0]} to {among[-1]}"


def stillness_limit(width: int) -> float:
    """Shift of a camera's picture to accept, in pixels of an image `width` wide: 1 px per 2000, never below half one.

    Cameras at rest stay below a tenth of it (docs/session_format.md has the figures).
    """
    return max(0.5, width / 2000)


def stillness_gates(stillness: Mapping[str, Stillness], widths: Mapping[str, int]) -> list[Gate]:
    """Whether the pour shows the place that the static clip shows, and whether every camera stayed where it was.

    widths: of the cameras' images, in pixels.
    """
    # By the clearest instant: a hand may hide the background at another.
    least = {camera: max(shift.agreeing for shift in seen.values()) for camera, seen in stillness.items()}
    fewest = min(least, key=least.__getitem__)
    elsewhere = [camera for camera, count in least.items() if count < MIN_AGREEING]
    gates = [
        Gate(
            "same_place",
            least[fewest],
            MIN_AGREEING,
            "at least",
            f"features that the static clip and the pour have in one place, camera {fewest}",
            True,
            f"the pour of camera {', '.join(elsewhere) or fewest} shows another place than its static clip, or too"
            " little of it; film the static scene where the pour was filmed, with the same background in view",
        )
    ]
    hidden = [
        f"camera {camera} at the {instant}"
        for camera, seen in stillness.items()
        for instant, shift in seen.items()
        if shift.px is None and camera not in elsewhere
    ]
    if hidden:
        detail = f"instants at which the background is hidden and a move would go unnoticed: {', '.join(hidden)}"
        remedy = "keep people and hands out of these pictures, or check by eye that the camera did not move"
        gates.append(Gate("shift_unmeasured", len(hidden), 0, "at most", detail, False, remedy))
    worst_px = {
        camera: max(shift.px for shift in seen.values() if shift.px is not None)
        for camera, seen in stillness.items()
        if any(shift.px is not None for shift in seen.values())
    }
    if worst_px:
        limits = {camera: stillness_limit(widths[camera]) for camera in worst_px}
        worst = max(worst_px, key=lambda camera: worst_px[camera] / limits[camera])
        moved = [camera for camera, px in worst_px.items() if px > limits[camera]]
        course = ", ".join(
            f"{instant} {'unknown' if shift.px is None else f'{shift.px:.2f}'}"
            for instant, shift in stillness[worst].items()
        )
        gates.append(
            Gate(
                "camera_shift",
                worst_px[worst],
                limits[worst],
                "at most",
                f"px that the background moved from the static clip to the pour, camera {worst}: {course}",
                True,
                " ".join(_moved(camera, stillness[camera], limits[camera]) for camera in moved or [worst]),
            )
        )
    return gates


def _moved(camera: str, seen: Stillness, limit: float) -> str:
    """What to do about a camera that moved: it depends on when."""
    shifts = [shift.px for shift in seen.values()]
    if shifts[0] is not None and shifts[0] <= limit:
        return f"camera {camera} moved during the pour: fasten it, switch stabilisation off and film the pour again."
    return (
        f"camera {camera} moved between its static clip and the pour: film the static scene again with it where it"
        " stands, or the pour."
    )


def sync_gates(clocks: Mapping[str, ClockFit], sequence: SequenceSync | None) -> list[Gate]:
    """Every clock found, their scatter, and what the clocks leave over in the sequence.

    The paper's own figure stands in the detail: it shifts by whole frames, which is not how frames are chosen here.
    """
    n_found = sum(fit.status == "ok" for fit in clocks.values())
    scatter = {camera: fit.residual_rms_s for camera, fit in clocks.items()}
    worst = max(scatter, key=scatter.__getitem__)
    widest = max(clocks, key=lambda camera: clocks[camera].interval_s)
    fewest = min(clocks, key=lambda camera: clocks[camera].agreement)
    echoing = max(clocks, key=lambda camera: abs(clocks[camera].echo_s))
    whose = "the reference's sound" if clocks[echoing].echo_s < 0 else "its sound"
    throughout = "record again, with irregular claps from the beginning to the end of the recording"
    gates = [
        Gate("cameras_synchronised", n_found, len(clocks), "at least", f"of {len(clocks)} cameras", True, throughout),
        Gate(
            "clock_residual",
            scatter[worst],
            1e-3,
            "at most",
            f"s RMS of the clear windows of sound about the clock, camera {worst}",
            remedy=f"check the sound of camera {worst} for gaps; in the report its windows lie off the line there",
        ),
        Gate(
            "clock_interval",
            clocks[widest].interval_s,
            CLOCK_INTERVAL_S,
            "at most",
            f"s either way hold the clock with 95 % while both cameras record, camera {widest}",
            remedy=throughout,
        ),
        Gate(
            "clock_agreement",
            clocks[fewest].agreement,
            CLOCK_AGREEMENT,
            "at least",
            f"share of the windows of sound that agree with the clock, camera {fewest}",
            remedy=throughout,
        ),
        Gate(
            "direct_sound",
            abs(clocks[echoing].echo_s),
            1e-3,
            "at most",
            f"s by which a weaker copy of {whose} precedes the one that the clock follows, camera {echoing}",
            remedy="record again with nothing between the sound and the microphones; the clock may follow a reflection",
        ),
    ]
    if sequence is not None and sequence.clock_rms_s is not None:
        missing = f"; not measurable: {', '.join(sequence.unmeasured)}" if sequence.unmeasured else ""
        whole = sequence.whole_frame_rms_s
        paper = "" if whole is None else f"; {whole * 1e3:.1f} ms after whole-frame shifts, the paper's Sync RMS"
        detail = f"s RMS about the fitted clocks, by the sequence's own sound{paper}{missing}"
        gates.append(Gate("sequence_sync", sequence.clock_rms_s, HALF_FRAME_S, "at most", detail, False, throughout))
    return gates


def pose_gates(poses: Poses, widths: Mapping[str, int]) -> list[Gate]:
    """All fixed cameras posed, the reprojection error, and how much of the sweep helped.

    widths: of the images of all fixed cameras, in pixels.
    """
    names = list(widths)
    missing = [camera for camera in names if camera not in poses.w2c]
    error, limit = poses.mean_error_px, float(np.mean([pixel_limit(width) for width in widths.values()]))
    detail = f"px, mean over {poses.n_observations} observations in frames {shown_widths(widths.values())} px wide"
    by_board = poses.metres_per_unit is not None
    again = "film the static scene and the sweep again in one go, with nothing in view that moves"
    more, past = SWEEP_AGAIN, "past"
    if by_board:
        again = "film [recordings.extrinsics] again, with a stiff board that is held still"
        more = "film [recordings.extrinsics] again, with the board at more places that several cameras see"
        past = "before"
    gates = [
        Gate(
            "cameras_posed",
            len(names) - len(missing),
            len(names),
            "at least",
            f"of {len(names)} cameras",
            True,
            f"film the static scene again with camera {', '.join(missing)}, with more texture in its view",
        ),
        Gate("mean_reprojection", error, limit, "at most", detail, False, again),
        Gate("poses_fit", error, 4 * limit, "at most", f"{detail}; beyond this no pose is right", True, again),
    ]
    if not by_board:  # a board's corner needs no third camera to be known: its neighbours on the board fix it
        detail, length = "images per point, mean", poses.mean_track_length
        gates.append(Gate("track_length", length, 3.0, "at least", detail, False, more))
    if poses.centre_sigma:
        worst = max(poses.centre_sigma, key=poses.centre_sigma.__getitem__)
        detail = f"m, by the features' noise and the lenses' deviations, camera {worst}"
        board = "film the board again, tilted and into every corner of the picture, with the cameras of the largest ± f"
        gates.append(Gate("centre_sigma", poses.centre_sigma[worst], CENTRE_SIGMA, "at most", detail, False, board))
    else:
        gates.append(Gate("centre_sigma", None, CENTRE_SIGMA, "at most", "m, not determined", False, more))
    if poses.feature_centre_sigma:
        worst = max(poses.feature_centre_sigma, key=poses.feature_centre_sigma.__getitem__)
        detail = f"m, by the noise of the features alone, camera {worst}"
        remedy = f"{more}, {past} camera {worst} above all"
        by_features = poses.feature_centre_sigma[worst]
        gates.append(Gate("centre_sigma_of_features", by_features, 1e-3, "at most", detail, False, remedy))
        turned = max(poses.feature_rotation_sigma_deg, key=poses.feature_rotation_sigma_deg.__getitem__)
        detail = f"degrees, likewise, camera {turned}"
        remedy = f"{more}, {past} camera {turned} above all"
        by_features = poses.feature_rotation_sigma_deg[turned]
        gates.append(Gate("rotation_sigma_of_features", by_features, 0.05, "at most", detail, False, remedy))
    if poses.n_sweep:
        share = len(poses.sweep_w2c) / poses.n_sweep
        detail = f"share of {poses.n_sweep} frames"
        gates.append(Gate("sweep_registered", share, 0.5, "at least", detail, False, SWEEP_AGAIN))
    return gates


def metric_gates(frame: SceneFrame) -> list[Gate]:
    """How well each triangulated print has the shape of the printed one, and how well sources of scale agree."""
    gates = []
    for name, seen in frame.prints.items():
        relative = seen.rms_m / seen.board_diagonal_m
        detail = f"RMS over the {name}'s diagonal, {seen.n_corners} corners in {seen.n_views} images"
        meaningless = "as above; beyond this the scale is meaningless"
        remedy = (
            f"check the {name}'s size in session.toml; film the static scene again with the {name} flat and stiff,"
            " where several cameras see it from nearby"
        )
        gates += [
            Gate(f"{name}_residual", relative, 0.005, "at most", detail, False, remedy),
            Gate(f"{name}_is_a_{name}", relative, 0.05, "at most", meaningless, True, remedy),
        ]
    sigma = frame.scale_sigma.get(frame.scale_source)
    if sigma is not None:
        detail = f"share of the scale, by the {frame.scale_source}"
        remedy = f"film the static scene again with a larger {frame.scale_source}, or with it nearer to the cameras"
        gates.append(Gate("scale_sigma", sigma, 1e-3, "at most", detail, False, remedy))
    if frame.scale_disagreement is not None:
        detail = f"share, largest difference between {', '.join(frame.scales)}"
        remedy = "measure them again, and correct or leave out the wrong one in session.toml"
        gates.append(Gate("scale_agreement", frame.scale_disagreement, 0.01, "at most", detail, False, remedy))
        gates.append(Gate("scale_is_one", frame.scale_disagreement, 0.1, "at most", detail, True, remedy))
    return gates


def sampling_gates(sampling: Sampling) -> list[Gate]:
    """Frames that miss their instant by more than half a source frame."""
    missed = int(sum(flags.sum() for flags in sampling.flagged.values()))
    remedy = "copy the pour from the cameras again, or film it with a faster card: frames were dropped"
    detail = "images more than half a source frame off"
    return [Gate("frames_off_their_instant", missed, 0, "at most", detail, False, remedy)]


def mask_gates(health: Mapping[str, MaskHealth], n_frames: int) -> list[Gate]:
    """Masks that cannot be right, and masks without liquid."""
    failed = sum(len(h.failed) for h in health.values())
    empty = max(len(h.empty) for h in health.values()) / n_frames
    emptiest = max(health, key=lambda camera: len(health[camera].empty))
    other_masks = "give masks in a folder (--masks), or film the pour again in steady light with nobody in view"
    when = "set motion_interval in session.toml, or point this camera at the liquid and film the pour again"
    failed_detail = "flooded or flickering masks over all cameras"
    return [
        Gate("masks_failed", failed, 0, "at most", failed_detail, False, other_masks),
        Gate("masks_empty", empty, 0.2, "at most", f"share of empty masks, camera {emptiest}", False, when),
    ]


def container_gates(placed: PlacedContainer, train: Iterable[str], widths: Mapping[str, int]) -> list[Gate]:
    """How well the placed mesh covers its masks, of the cameras that placed it and of those that did not.

    widths: of the cameras' images, in pixels.
    """
    seen, placement = placed.projections, placed.placement
    fitted = [camera for camera in train if camera in seen]
    held_out = [camera for camera in seen if camera not in fitted]
    gates = []
    if fitted:
        # The median: a hand may hide the container from one camera.
        overlap = float(np.median([seen[camera].iou for camera in fitted]))
        detail_of_limit, remedy = "as above; below it, it is another mesh", "check mesh, masks and metres_per_unit"
        detail = "projected mesh and mask, median of training views"
        gates.append(Gate("container_iou", overlap, 0.95, "at least", detail, False, remedy))
        gates.append(Gate("container_is_the_container", overlap, 0.8, "at least", detail_of_limit, True, remedy))
        medians_px = {camera: seen[camera].contour_median_px for camera in fitted}
        medians = {camera: np.inf if median is None else median for camera, median in medians_px.items()}
        limits = {camera: max(1.5, widths[camera] / 1000) for camera in fitted}
        worst = max(fitted, key=lambda camera: medians[camera] / limits[camera])
        detail = f"px between projected and masked outline, median, camera {worst}"
        gates.append(Gate("container_outline", medians[worst], limits[worst], "at most", detail, False, remedy))
    if held_out:
        worst = min(held_out, key=lambda camera: seen[camera].iou)
        detail = f"projected mesh and mask, held-out camera {worst}"
        remedy = f"check the container mask of camera {worst}, and whether the container was moved"
        gates.append(Gate("container_held_out", seen[worst].iou, 0.9, "at least", detail, False, remedy))
    if placement.position_sigma is not None:
        detail, remedy = "m, its centre, by leaving out cameras", "check the container masks, one camera's is off"
        gates.append(Gate("container_sigma", placement.position_sigma, 2e-3, "at most", detail, False, remedy))
    clicked = {name: error for name, error in (placement.point_rms_px or {}).items() if np.isfinite(error)}
    if clicked:
        worst = max(clicked, key=lambda camera: clicked[camera] / widths[camera])
        detail, width = f"px RMS between clicked and projected points, camera {worst}", widths[worst]
        remedy = "check the points under [container]"
        gates.append(Gate("container_clicks", clicked[worst], max(5.0, width / 400), "at most", detail, False, remedy))
        if not fitted:  # nothing else tells whether the clicks make sense
            gates.append(Gate("container_clicks_fit", clicked[worst], width / 40, "at most", detail, True, remedy))
    up = np.asarray(placement.up)
    tilt = float(np.degrees(np.arccos(np.clip(up[1] / np.linalg.norm(up), -1, 1))))
    detail, remedy = "degrees between its axis and the scene's up", "lay the board or marker level and film it again"
    gates.append(Gate("container_upright", tilt, 2.0, "at most", detail, False, remedy))
    return gates


def source_gate(share: Mapping[str, float]) -> Gate:
    """Whether pixels of the written images lie outside the raw frame (pincushion distortion)."""
    least = min(share, key=share.__getitem__)
    detail = f"share of the written image, camera {least}"
    remedy = "leave out --no-crop, or film the liquid nearer to the middle of the picture"
    return Gate("pixels_with_source", share[least], 0.999, "at least", detail, False, remedy)

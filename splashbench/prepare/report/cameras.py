"""Cameras and lenses in the report: where the rig stands, whether it stayed there, how sure poses and lenses are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splashbench.pages.blocks import Block, Bullets, Note, Table
from splashbench.prepare.calibration.intrinsics import COVERAGE_CELLS
from splashbench.prepare.gates import shown_widths, stillness_limit
from splashbench.prepare.poses.stillness import INSTANTS
from splashbench.prepare.preparation import Preparation
from splashbench.prepare.report.pictures import SWEEP_COLOUR, TEST_COLOUR, TRAIN_COLOUR, chart


def cameras_section(preparation: Preparation) -> list[Block]:
    """The rig from above and from the front with every camera's viewing direction, and a table of the poses."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.4), layout="constrained")
    centres = {camera: camera_centre(w2c) for camera, w2c in preparation.poses.w2c.items()}
    sweep = np.array([camera_centre(w2c) for w2c in preparation.poses.sweep_w2c]).reshape(-1, 3)
    reach = 1.25 * max(float(np.abs(centre).max()) for centre in centres.values())
    points = preparation.poses.points[np.abs(preparation.poses.points).max(axis=1) < reach]
    prints = preparation.metric.prints
    for index, (title, a, b, label_b) in enumerate((("from above", 0, 2, "z"), ("from the front", 0, 1, "y"))):
        axes = figure.add_subplot(1, 2, index + 1)
        axes.scatter(points[:, a], points[:, b], s=0.3, color="#cccccc")
        for name, print_ in prints.items():
            axes.scatter(print_.corners[:, a], print_.corners[:, b], s=3, color="black", label=name)
        if len(sweep):
            axes.plot(sweep[:, a], sweep[:, b], ".", color=SWEEP_COLOUR, markersize=4, label="sweep")
        for camera, centre in centres.items():
            colour = TEST_COLOUR if camera in preparation.session.test else TRAIN_COLOUR
            forward = preparation.poses.w2c[camera][2, :3] * 0.2 * reach
            axes.plot(*([centre[k], centre[k] + forward[k]] for k in (a, b)), color=colour, linewidth=1)
            axes.plot(centre[a], centre[b], "o", color=colour, markersize=5)
            axes.annotate(camera, (centre[a], centre[b]), textcoords="offset points", xytext=(5, 5), fontsize=9)
        axes.set(title=title, xlabel="x [m]", ylabel=f"{label_b} [m]", aspect="equal")
        if label_b == "z":
            axes.invert_yaxis()  # the cameras at the bottom, as if standing among them
            axes.legend(fontsize=8)
    poses = preparation.poses
    width = shown_widths(calibration.lens.width for calibration in preparation.calibrations.values())
    sweep_text = f"{len(poses.sweep_w2c)} of {poses.n_sweep} sweep frames registered." if poses.n_sweep else "No sweep."
    if poses.metres_per_unit is not None:
        sweep_text = "The cameras were placed by the board that several of them saw at once."
    text = (
        f"Mean reprojection error {poses.mean_error_px:.3f} px (RMS {poses.rms_error_px:.3f}) over"
        f" {poses.n_observations} observations of {len(poses.points)} points, in frames {width} px wide;"
        f" {sweep_text}"
        + "".join(
            f" {name.capitalize()}: {print_.rms_m * 1000:.2f} mm RMS over {print_.n_corners} corners."
            for name, print_ in prints.items()
        )
        + f" Metres by the {preparation.metric.scale_source}, up by the {preparation.metric.up_source}."
        " Blue: training views; orange: held-out views."
    )
    rows = [
        [
            camera,
            *(f"{value:.4f}" for value in centres[camera]),
            *(
                f"{sigma[camera] * factor:.{digits}f}" if camera in sigma else "unknown"
                for sigma, factor, digits in (
                    (poses.centre_sigma, 1e3, 2),
                    (poses.feature_centre_sigma, 1e3, 2),
                    (poses.rotation_sigma_deg, 1.0, 3),
                    (poses.feature_rotation_sigma_deg, 1.0, 3),
                )
            ),
        ]
        for camera in centres
    ]
    header = ["camera", "x [m]", "y [m]", "z [m]", "± centre [mm]", "of that features [mm]", "± rotation [deg]"]
    header.append("of that features [deg]")
    note = (
        "±: standard deviation relative to the other fixed cameras, by the noise of the features and by the deviations"
        " of the lenses. Of that features: by the noise of the features alone, as if the lenses were exact."
    )
    attempts = [f"Structure from motion tried more than once: {line}" for line in poses.attempts[:-1]]
    return [
        chart(figure, "the rig from above and from the front"),
        Note(text),
        Table(header, rows),
        Note(note),
        *([Bullets(attempts)] if attempts else []),
    ]


def stillness_section(preparation: Preparation) -> list[Block]:
    """A table of how far each camera's picture of the background moved from its static clip to the pour."""
    limits = {name: stillness_limit(calibration.lens.width) for name, calibration in preparation.calibrations.items()}
    rows = []
    for camera, seen in preparation.stillness.items():
        shifts = ["unknown" if seen[instant].px is None else f"{seen[instant].px:.2f}" for instant in INSTANTS]
        fewest = str(min(shift.agreeing for shift in seen.values()))
        rows.append([camera, *shifts, f"{limits[camera]:.2f}", fewest])
    header = ["camera", *(f"at the {instant} [px]" for instant in INSTANTS), "at most [px]", "features, at least"]
    note = (
        "RMS shift of the static background, from the static clip to the pour, at three instants of the motion."
        " Pixels of the raw frames. Above what is allowed at most the camera has moved, and no scene is made."
    )
    return [Table(header, rows), Note(note)]


def lenses_section(preparation: Preparation) -> list[Block]:
    """A table of the lenses, and where in the image their boards were seen."""
    from matplotlib.figure import Figure

    rows = []
    for camera, calibration in preparation.calibrations.items():
        K, distortion = calibration.lens.K, calibration.lens.distortion
        rows.append(
            [
                camera,
                f"{K[0, 0]:.2f}",
                f"{K[1, 1]:.2f}",
                f"{calibration.focal_sigma_px:.2f}",
                f"{K[0, 2]:.1f}",
                f"{K[1, 2]:.1f}",
            ]
            + ["none" if value == 0 else f"{value:.4f}" for value in distortion]
            + [f"{calibration.rms_px:.3f}", f"{calibration.held_out_rms_px:.3f}", f"{100 * calibration.coverage:.0f}"]
            + [f"{calibration.n_views}/{calibration.n_detected}/{calibration.n_searched}"]
        )
    header = ["camera", "fx [px]", "fy [px]", "± f [px]", "cx [px]", "cy [px]", "k1", "k2", "p1", "p2", "k3"]
    header += ["RMS [px]", "held out [px]", "coverage [%]", "views"]
    count = len(preparation.calibrations)
    figure = Figure(figsize=(9, 1.6 * ((count + 3) // 4)), layout="constrained")
    for index, (camera, calibration) in enumerate(preparation.calibrations.items()):
        axes = figure.add_subplot((count + 3) // 4, 4, index + 1)
        axes.scatter(calibration.view_points[:, 0], calibration.view_points[:, 1], s=0.5)
        axes.set(
            xlim=(0, calibration.lens.width),
            ylim=(calibration.lens.height, 0),
            aspect="equal",
            title=f"camera {camera}",
        )
        axes.set_xticks(np.linspace(0, calibration.lens.width, COVERAGE_CELLS[0] + 1), labels=[])
        axes.set_yticks(np.linspace(0, calibration.lens.height, COVERAGE_CELLS[1] + 1), labels=[])
        axes.grid(linewidth=0.3)
    note = (
        "Distortion has no unit; none: held at zero, as the board did not determine it. Errors are RMS over corners."
        " Views: used / with a board / searched. Below: all corners used, on the cells that coverage counts."
    )
    return [Table(header, rows), Note(note), chart(figure, "where the boards' corners were seen")]


def camera_centre(w2c: NDArray[np.float64]) -> NDArray[np.float64]:
    """The centre [3] of a camera given world to camera [4, 4]."""
    return np.asarray(-w2c[:3, :3].T @ w2c[:3, 3])

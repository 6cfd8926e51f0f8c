"""prepare_report.html: what a preparation found, on one page that needs nothing else.

Figures are drawn with matplotlib and embedded. What needs a person's eye comes first: the pass marks, then masks on
the frames, then cameras, lenses and clocks. The page tells of the scene alone, not of the run that made it, so that the
same recordings always give the same bytes.
"""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from splashbench.files import jpeg_bytes
from splashbench.prepare.calibration.intrinsics import COVERAGE_CELLS
from splashbench.prepare.masks.sheet import fault_note, mask_sheet, sheet_times

if TYPE_CHECKING:
    from splashbench.prepare.container import PlacedContainer
    from splashbench.prepare.preparation import Preparation

TRAIN_COLOUR, TEST_COLOUR, SWEEP_COLOUR = "#1f5fa8", "#c2571a", "#9a9a9a"

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1080px; padding: 0 1rem; color: #1c1c1c; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; border-bottom: 1px solid #ddd; }
table { border-collapse: collapse; } td, th { padding: .2rem .7rem; text-align: right; }
tr { border-bottom: 1px solid #eee; }
td:first-child, th:first-child, td.text, th.text { text-align: left; }
.passed { background: #dff2df; } .failed { background: #f7d6d2; }
img { max-width: 100%; } p.note { color: #555; }
.sheet { display: grid; grid-template-columns: repeat(3, 1fr); gap: 4px; }
figure { margin: 0; } figcaption { font-size: .8rem; color: #555; }
"""


def html_report(preparation: Preparation) -> str:
    """The whole page as text."""
    session = preparation.session
    warnings = len(preparation.warnings)
    verdict = "All gates passed." if not warnings else f"{warnings} of {len(preparation.gates)} gates failed."
    body = [
        f"<h1>Preparation of {html.escape(session.name)}</h1>",
        f"<p>{len(session.cameras)} cameras, {len(preparation.sampling.times)} timesteps from"
        f" {preparation.motion.start:.3f} to {preparation.motion.end:.3f} s on the clock of camera"
        f" {html.escape(session.reference)}. {verdict}</p>",
        *_section("Gates", _gates(preparation)),
        *_section(f"Masks ({preparation.masks.provider})", _masks(preparation)),
        *_section("Cameras", _layout(preparation)),
        *(_section("Container", _container(preparation.container, preparation)) if preparation.container else []),
        *_section("Lenses", _lenses(preparation)),
        *_section("Clocks", _clocks(preparation)),
        *_section("Motion interval", _list(preparation.motion.reasons)),
        *_section("Recordings", _recordings(preparation)),
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>Preparation of {html.escape(session.name)}</title><style>{_STYLE}</style></head>\n<body>\n"
        + "\n".join(body)
        + "\n</body></html>\n"
    )


def _section(title: str, content: Iterable[str]) -> list[str]:
    return [f"<h2>{html.escape(title)}</h2>", *content]


def _table(header: Sequence[str], rows: Iterable[Sequence[str]], classes: Iterable[str] | None = None) -> str:
    """An HTML table; cells are text, and the last column is prose."""
    marks = iter(classes) if classes is not None else None
    lines = ["<table><tr>" + "".join(f"<th>{html.escape(cell)}</th>" for cell in header) + "</tr>"]
    for row in rows:
        mark = f' class="{next(marks)}"' if marks is not None else ""
        lines.append(f"<tr{mark}>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>")
    return "\n".join([*lines, "</table>"])


def _list(lines: Iterable[str]) -> list[str]:
    return ["<ul>", *(f"<li>{html.escape(line)}</li>" for line in lines), "</ul>"]


def _gates(preparation: Preparation) -> list[str]:
    rows = [
        [
            gate.name.replace("_", " "),
            "unknown" if gate.value is None else f"{gate.value:.4g}",
            f"{gate.side} {gate.limit:.4g}",
            "passed" if gate.passed else "failed",
            gate.detail,
        ]
        for gate in preparation.gates
    ]
    classes = ["passed" if gate.passed else "failed" for gate in preparation.gates]
    return [_table(["gate", "value", "limit", "outcome", "what it is"], rows, classes)]


def _masks(preparation: Preparation) -> list[str]:
    from matplotlib.figure import Figure

    times = preparation.sampling.times
    figure = Figure(figsize=(9, 2.8), layout="constrained")
    axes = figure.add_subplot()
    for camera, areas in preparation.masks.areas.items():
        style = "--" if camera in preparation.session.test else "-"
        axes.plot(times, areas, style, label=camera, linewidth=1.2)
    axes.set(xlabel="time [s]", ylabel="mask area [px]", ylim=(0, None))
    axes.legend(title="camera", fontsize=8, ncols=2)
    shown = sheet_times(len(times), preparation.masks.faults, len(next(iter(preparation.sheet.values()))))
    sheet = mask_sheet(
        f"{preparation.session.name}: masks ({preparation.masks.provider})",
        [f"{t}: {times[t]:.3f} s" for t in shown],
        preparation.sheet,
        {camera: fault_note(found, len(times)) for camera, found in preparation.masks.faults.items()},
    )
    picture = f'<p><img alt="contact sheet of the masks" src="{_image_uri(sheet)}"></p>'
    rows = [
        [
            camera,
            _frames(health.empty),
            _frames(health.failed),
            f"{window.width}x{window.height}",
            f"({window.x0}, {window.y0})",
        ]
        for camera, health, window in (
            (camera, preparation.masks.health[camera], preparation.windows[camera])
            for camera in preparation.session.cameras
        )
    ]
    header = ["camera", "empty frames", "failed frames", "image written", "its corner in the frame"]
    return [_figure(figure), _table(header, rows), picture]


def _frames(positions: Sequence[int]) -> str:
    if not positions:
        return "none"
    shown = ", ".join(map(str, positions[:8]))
    return shown if len(positions) <= 8 else f"{shown} and {len(positions) - 8} more"


def _layout(preparation: Preparation) -> list[str]:
    """The rig from above and from the front, with every camera's viewing direction."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.4), layout="constrained")
    centres = {camera: _centre(w2c) for camera, w2c in preparation.poses.w2c.items()}
    sweep = np.array([_centre(w2c) for w2c in preparation.poses.sweep_w2c]).reshape(-1, 3)
    reach = 1.25 * max(float(np.abs(centre).max()) for centre in centres.values())
    points = preparation.poses.points[np.abs(preparation.poses.points).max(axis=1) < reach]
    prints = preparation.metric.prints
    for index, (title, a, b, label_b) in enumerate((("from above", 0, 2, "z"), ("from the front", 0, 1, "y"))):
        axes = figure.add_subplot(1, 2, index + 1)
        axes.scatter(points[:, a], points[:, b], s=0.3, color="#cccccc")
        for name, seen in prints.items():
            axes.scatter(seen.corners[:, a], seen.corners[:, b], s=3, color="black", label=name)
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
    width = next(iter(preparation.calibrations.values())).lens.width
    text = (
        f"Mean reprojection error {poses.mean_error_px:.3f} px (RMS {poses.rms_error_px:.3f}) over"
        f" {poses.n_observations} observations of {len(poses.points)} points, in frames {width} px wide;"
        f" {len(poses.sweep_w2c)} of {poses.n_sweep} sweep frames registered."
        + "".join(
            f" {name.capitalize()}: {seen.rms_m * 1000:.2f} mm RMS over {seen.n_corners} corners."
            for name, seen in prints.items()
        )
        + f" Metres by the {preparation.metric.scale_source}, up by the {preparation.metric.up_source}."
        " Blue: training views; orange: held-out views."
    )
    rows = [
        [
            camera,
            *(f"{value:.4f}" for value in centres[camera]),
            f"{poses.centre_sigma[camera] * 1e3:.3f}" if camera in poses.centre_sigma else "unknown",
            f"{poses.rotation_sigma_deg[camera]:.4f}" if camera in poses.rotation_sigma_deg else "unknown",
        ]
        for camera in centres
    ]
    header = ["camera", "x [m]", "y [m]", "z [m]", "± centre [mm]", "± rotation [deg]"]
    note = "±: standard deviations among the fixed cameras by the noise of the features alone."
    attempts = [f"Structure from motion tried more than once: {line}" for line in poses.attempts[:-1]]
    return [
        _figure(figure),
        f'<p class="note">{html.escape(text)}</p>',
        _table(header, rows),
        f'<p class="note">{note}</p>',
        *(_list(attempts) if attempts else []),
    ]


def _container(placed: PlacedContainer, preparation: Preparation) -> list[str]:
    """Where the mesh lies: its projected outline (blue) on the mask's (amber), and how well they agree."""
    placement = placed.placement
    turns = {
        "determined": "Its turn about the vertical axis is determined.",
        "repeats": f"{placement.equivalent_turns} turns about the vertical axis look the same; the nearest was taken.",
        "free": "It looks the same however turned about the vertical axis; it is turned as the mesh came.",
    }
    rows = [
        [
            camera,
            "held out" if camera in preparation.session.test else "training",
            f"{seen.iou:.4f}",
            "unknown" if seen.contour_rms_px is None else f"{seen.contour_rms_px:.2f}",
            "unknown" if seen.contour_median_px is None else f"{seen.contour_median_px:.2f}",
        ]
        for camera, seen in placed.projections.items()
    ]
    sheet = [
        f'<figure><img alt="camera {html.escape(camera)}" src="{_image_uri(image)}">'
        f"<figcaption>camera {html.escape(camera)}</figcaption></figure>"
        for camera, image in preparation.overlays.items()
    ]
    ambiguous = " Another of its axes could be up as well; give up in [container]." if placement.up_is_ambiguous else ""
    header = ["camera", "view", "IoU", "outline RMS [px]", "outline median [px]"]
    return [
        f'<p class="note">{turns[placement.turn]}{ambiguous} Only training views placed it. Blue: the mesh projected;'
        " amber: the mask.</p>",
        _table(header, rows),
        '<div class="sheet">',
        *sheet,
        "</div>",
    ]


def _lenses(preparation: Preparation) -> list[str]:
    from matplotlib.figure import Figure

    rows = []
    for camera, found in preparation.calibrations.items():
        K, distortion = found.lens.K, found.lens.distortion
        rows.append(
            [
                camera,
                f"{K[0, 0]:.2f}",
                f"{K[1, 1]:.2f}",
                f"{found.focal_sigma_px:.2f}",
                f"{K[0, 2]:.1f}",
                f"{K[1, 2]:.1f}",
            ]
            + [f"{value:.4f}" for value in distortion]
            + [f"{found.rms_px:.3f}", f"{found.held_out_rms_px:.3f}", f"{found.coverage:.0%}"]
            + [f"{found.n_views}/{found.n_detected}/{found.n_searched}"]
        )
    header = ["camera", "fx", "fy", "± f", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "RMS", "held out", "coverage"]
    count = len(preparation.calibrations)
    figure = Figure(figsize=(9, 1.6 * ((count + 3) // 4)), layout="constrained")
    for index, (camera, found) in enumerate(preparation.calibrations.items()):
        axes = figure.add_subplot((count + 3) // 4, 4, index + 1)
        axes.scatter(found.view_points[:, 0], found.view_points[:, 1], s=0.5)
        axes.set(xlim=(0, found.lens.width), ylim=(found.lens.height, 0), aspect="equal", title=f"camera {camera}")
        axes.set_xticks(np.linspace(0, found.lens.width, COVERAGE_CELLS[0] + 1), labels=[])
        axes.set_yticks(np.linspace(0, found.lens.height, COVERAGE_CELLS[1] + 1), labels=[])
        axes.grid(linewidth=0.3)
    note = (
        "Pixels; errors are RMS over corners; views: used, with a board, searched. Below: all corners used, over the"
        " cells that coverage counts."
    )
    return [_table([*header, "views"], rows), f'<p class="note">{note}</p>', _figure(figure)]


def _clocks(preparation: Preparation) -> list[str]:
    offsets = preparation.sequence.offsets_s
    rows = [
        [
            camera,
            f"{fit.start_s:.6f}",
            f"{(fit.clock_rate - 1) * 1e6:+.1f}",
            "reference" if camera == preparation.session.reference else f"{fit.confidence:.1f}",
            f"{fit.residual_rms_s * 1e6:.0f}",
            str(fit.n_windows),
            f"{offsets[camera] * 1e3:+.2f}" if camera in offsets else "unknown",
        ]
        for camera, fit in preparation.clocks.items()
    ]
    header = ["camera", "start [s]", "drift [us/s]", "confidence", "residual [us]", "windows", "left over [ms]"]
    note = (
        "Reference time = start + (1 + drift) x local time. Left over: offset found anew within the sequence, centred."
        " Below: every window of sound by which a clock was found, and its delay beyond the clock's line. The scatter"
        " is how well single windows agree; a bend would be a clock whose rate changed."
    )
    return [
        _table(header, rows),
        f'<p class="note">{note}</p>',
        *_windows(preparation),
        *_sound_paths(preparation),
    ]


def _windows(preparation: Preparation) -> list[str]:
    """Where the windows' delays lie about every camera's clock."""
    from matplotlib.figure import Figure

    fitted = {camera: fit for camera, fit in preparation.clocks.items() if fit.windows}
    if not fitted:
        return []
    columns = min(3, len(fitted))
    rows = -(-len(fitted) // columns)
    figure = Figure(figsize=(9, 1.9 * rows), layout="constrained")
    for index, (camera, fit) in enumerate(fitted.items()):
        axes = figure.add_subplot(rows, columns, index + 1)
        times, residuals = np.array(fit.windows).T
        axes.axhline(0, color=SWEEP_COLOUR, linewidth=0.8)
        axes.plot(times, residuals * 1e6, ".", color=TRAIN_COLOUR, markersize=3)
        axes.set_title(f"camera {camera}", fontsize=9)
        axes.set(xlabel="local time [s]", ylabel="delay [us]")
        axes.tick_params(labelsize=8)
    return [_figure(figure)]


def _sound_paths(preparation: Preparation) -> list[str]:
    paths = preparation.sound_paths
    rows = [
        [camera, f"{paths.distance_m[camera]:.2f}", f"{paths.shift_s[camera] * 1e3:+.2f}"]
        for camera in paths.distance_m
    ]
    place = "({:.2f}, {:.2f}, {:.2f}) m".format(*paths.source)
    if paths.applied:
        note = f"The sound came from {place}, and its travel is taken out of the clocks above."
    else:
        note = (
            "The clocks above go by the sound's arrival. Had it come from the scene's origin, its travel would shift"
            " them as below; give [sound] source in session.toml to have it taken out."
        )
    header = ["camera", "way of the sound [m]", "shift of the clock [ms]"]
    return [f'<p class="note">{note}</p>', _table(header, rows)]


def _recordings(preparation: Preparation) -> list[str]:
    rows = []
    for camera, facts in preparation.heard.facts.items():
        longer = facts.audio_minus_video_s
        seams = preparation.heard.seams[camera]
        rows.append(
            [
                camera,
                f"{facts.width}x{facts.height}",
                f"{facts.fps:.3f}",
                str(facts.n_frames),
                f"{facts.duration:.2f}",
                facts.codec,
                facts.timecode or "none",
                "unknown" if longer is None else f"{longer * 1e3:+.2f}",
                ", ".join(f"{seam.gap_s * 1e3:+.1f} ms at {seam.time_s:.1f} s" for seam in seams) or "none",
            ]
        )
    header = [
        "camera",
        "size",
        "fps",
        "frames",
        "seconds",
        "codec",
        "timecode",
        "sound - video [ms]",
        "gaps in the sound",
    ]
    return [_table(header, rows)]


def _centre(w2c: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(-w2c[:3, :3].T @ w2c[:3, 3])


def _figure(figure: Any) -> str:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return f'<p><img alt="" src="data:image/png;base64,{base64.b64encode(stream.getvalue()).decode()}"></p>'


def _image_uri(image: NDArray[np.uint8]) -> str:
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg_bytes(image, quality=88)).decode()}"

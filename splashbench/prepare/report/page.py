"""prepare_report.html: the outcome of a preparation, on one page that needs nothing else.

What needs a person's eye comes first: the gates, then masks on the frames, then cameras, lenses and clocks. The page
tells of the scene alone, not of the run that made it, so that the same recordings always give the same bytes. Its date
is therefore that of the recordings.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from splashbench.pages import render
from splashbench.pages.blocks import Block, Bullets, Note, Sheet, Table
from splashbench.prepare.container import PlacedContainer
from splashbench.prepare.masks.sheet import fault_note, mask_sheet, sheet_times
from splashbench.prepare.preparation import Preparation
from splashbench.prepare.report.cameras import cameras_section, lenses_section, stillness_section
from splashbench.prepare.report.clocks import clocks_section, recordings_section
from splashbench.prepare.report.gates import gates_section
from splashbench.prepare.report.pictures import chart, photograph
from splashbench.version import __version__


def html_report(preparation: Preparation) -> str:
    """The whole page as text."""
    session = preparation.session
    warnings = len(preparation.warnings)
    verdict = "All gates passed." if not warnings else f"{warnings} of {len(preparation.gates)} gates failed."
    summary = (
        f"{len(session.cameras)} cameras, {len(preparation.sampling.times)} timesteps from"
        f" {preparation.motion.start:.3f} to {preparation.motion.end:.3f} s on the clock of camera"
        f" {session.reference}. {verdict}"
    )
    sections = [
        ("Gates", gates_section(preparation)),
        (f"Masks ({preparation.masks.provider})", _masks(preparation)),
        ("Cameras", cameras_section(preparation)),
        ("Cameras at rest", stillness_section(preparation)),
        ("Container", _container(preparation.container, preparation) if preparation.container else []),
        ("Lenses", lenses_section(preparation)),
        ("Clocks", clocks_section(preparation)),
        ("Motion interval", [Bullets(preparation.motion.reasons)]),
        ("Recordings", recordings_section(preparation)),
    ]
    folder = Path(__file__).parent
    origin = f"Recorded {recorded_on(preparation)}. Prepared by splashbench {__version__}."
    return render(folder, "preparation.html.j2", name=session.name, summary=summary, origin=origin, sections=sections)


def recorded_on(preparation: Preparation) -> str:
    """The day of the pour by the reference camera's clock, or that it is unknown."""
    created = preparation.synced.videos[preparation.session.reference].created
    return created[:10] if created else "on a day that its files do not tell"


def _masks(preparation: Preparation) -> list[Block]:
    from matplotlib.figure import Figure

    times = preparation.sampling.times
    figure = Figure(figsize=(9, 2.8), layout="constrained")
    axes = figure.add_subplot()
    for camera, areas in preparation.masks.areas.items():
        style = "--" if camera in preparation.session.test else "-"
        axes.plot(times, areas, style, label=camera, linewidth=1.2)
    axes.set(xlabel="time [s]", ylabel="mask area [px]", ylim=(0, None))
    axes.legend(title="camera", fontsize=8, ncols=2)
    sheet_frames = sheet_times(
        len(times), preparation.masks.faults, len(next(iter(preparation.pictures.sheet.values())))
    )
    sheet = mask_sheet(
        f"{preparation.session.name}: masks ({preparation.masks.provider})",
        [f"{t}: {times[t]:.3f} s" for t in sheet_frames],
        preparation.pictures.sheet,
        {camera: fault_note(faults, len(times)) for camera, faults in preparation.masks.faults.items()},
    )
    picture = photograph(sheet, "contact sheet of the masks")
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
    header = ["camera", "empty frames", "failed frames", "image written [px]", "its top left in the frame [px]"]
    return [chart(figure, "area of the masks over time, a line per camera"), Table(header, rows), picture]


def _frames(positions: Sequence[int]) -> str:
    if not positions:
        return "none"
    listed = ", ".join(map(str, positions[:8]))
    return listed if len(positions) <= 8 else f"{listed} and {len(positions) - 8} more"


def _container(placed: PlacedContainer, preparation: Preparation) -> list[Block]:
    """Where the mesh lies: its projected outline (blue) on the mask's (amber), and how well they agree."""
    placement = placed.placement
    turns = {
        "determined": "The masks determine its turn about the vertical axis.",
        "repeats": f"{placement.equivalent_turns} turns about the vertical axis look the same; the nearest was taken.",
        "free": "It looks the same at any turn about the vertical axis; its turn is that of the mesh file.",
    }
    rows = [
        [
            camera,
            "held out" if camera in preparation.session.test else "training",
            f"{projection.iou:.4f}",
            "unknown" if projection.contour_rms_px is None else f"{projection.contour_rms_px:.2f}",
            "unknown" if projection.contour_median_px is None else f"{projection.contour_median_px:.2f}",
        ]
        for camera, projection in placed.projections.items()
    ]
    overlays = [
        photograph(image, f"camera {camera}: the mesh projected onto its mask", f"camera {camera}")
        for camera, image in preparation.pictures.overlays.items()
    ]
    ambiguous = " Another of its axes could be up as well; give up in [container]." if placement.up_is_ambiguous else ""
    header = ["camera", "view", "IoU", "outline RMS [px]", "outline median [px]"]
    note = (
        f"{turns[placement.turn]}{ambiguous} Only training views placed it. Blue: the mesh projected; amber: the mask."
    )
    return [Note(note), Table(header, rows), Sheet(overlays)]

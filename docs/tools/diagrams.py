"""Diagrams of the formats and the protocol: `python docs/tools/diagrams.py` draws them into docs/images/.

Schematic but for the rig, whose cameras stand where those of `splashbench synth session` do.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from splashbench.synth.imaging.geometry import ARC_ORDER

OUT = Path(__file__).parents[1] / "images"
BLUE, VERMILION, GREY = "#0072B2", "#D55E00", "#666666"


def metric_regions() -> Figure:
    """What the image metrics look at: the mask, the opacity that is rendered, and what lies outside the mask."""
    figure = Figure(figsize=(7.6, 3.0), layout="constrained")
    place = figure.subplots()
    place.set(xlim=(0, 13.2), ylim=(0, 5), aspect="equal")
    place.set_axis_off()
    place.add_patch(Rectangle((0.1, 0.1), 7.0, 4.8, fill=False, color=GREY, lw=0.8))
    angle = np.linspace(0, 2 * np.pi, 400)
    for x, y, wobble, color, style in (
        (3.6, 2.5, 0.12, BLUE, "-"),
        (4.6, 2.6, -0.12, VERMILION, "--"),
    ):
        radius = 1.75 * (1 + wobble * np.sin(3 * angle))
        place.fill(x + radius * np.cos(angle), y + radius * np.sin(angle), color=color, alpha=0.18, lw=0)
        place.plot(x + radius * np.cos(angle), y + radius * np.sin(angle), style, color=color)
    notes = (
        ("mask M of the liquid: colours here\npsnr, ssim, lpips, jitter_error", (2.6, 3.2), 4.45, BLUE),
        ("overlap of M and what is opaque\nmiou", (4.1, 2.3), 3.25, GREY),
        ("opaque, but not liquid\nspill", (6.0, 1.9), 2.05, VERMILION),
        ("outside M: difference to the image\nwithout liquid\nspill_rgb", (6.4, 0.5), 0.85, GREY),
    )
    for text, (x, y), height, color in notes:
        place.annotate(
            text, (x, y), (7.6, height), color=color, va="center", arrowprops={"arrowstyle": "-", "color": color}
        )
    return figure


def pixels_and_axes() -> Figure:
    """Pixel centres at +0.5, and a camera's axes."""
    figure = Figure(figsize=(7.2, 2.6), layout="constrained")
    grid, axes = figure.subplots(1, 2)
    for row in range(3):
        for column in range(4):
            grid.add_patch(Rectangle((column, row), 1, 1, fill=False, color=GREY, lw=0.8))
            grid.plot(column + 0.5, row + 0.5, ".", color=GREY, ms=4)
    grid.add_patch(Rectangle((2, 1), 1, 1, color=BLUE, alpha=0.25))
    grid.plot(2.5, 1.5, "o", color=BLUE, ms=5)
    grid.annotate(
        "row 1, column 2:\ncentre (u, v) = (2.5, 1.5)", (2.5, 1.5), (4.3, 0.8), arrowprops={"arrowstyle": "-"}
    )
    grid.set(xlim=(-0.1, 7.6), ylim=(3.1, -0.1), aspect="equal", xticks=range(5), yticks=range(4), xlabel="u, pixels")
    grid.set_ylabel("v, pixels")
    for side in ("top", "right"):
        grid.spines[side].set_visible(False)
    axes.set(xlim=(-0.6, 2.8), ylim=(1.4, -0.6), aspect="equal")
    axes.set_axis_off()
    for tip, name in (((1, 0), "x, right"), ((0, 1), "y, down"), ((0.75, -0.35), "z, forward: depth")):
        axes.annotate("", tip, (0, 0), arrowprops={"arrowstyle": "->", "color": BLUE, "lw": 1.6})
        axes.text(tip[0] + 0.06, tip[1] + (0.12 if tip[1] > 0 else -0.02), name)
    axes.plot(0, 0, "o", color=BLUE)
    return figure


def rig() -> Figure:
    """The seven cameras of a synthetic session from above: an arc of 77 degrees."""
    figure = Figure(figsize=(7.2, 2.7), layout="constrained")
    place: Axes = figure.subplots()
    for name, slot in zip("1234567", ARC_ORDER):
        angle = np.radians(-90 - 77 / 2 + 77 * slot / 6)
        x, y = 0.95 * np.cos(angle), 0.95 * np.sin(angle)
        test = name in ("6", "7")
        place.plot([0, x], [0, y], color=GREY, lw=0.5, ls=":")
        place.plot(x, y, "s", ms=9, color=VERMILION if test else BLUE, mfc="white" if test else BLUE)
        place.text(1.09 * x, 1.09 * y, name, ha="center", va="center")
    place.add_patch(Circle((0, 0), 0.1, fill=False, color=GREY))
    place.text(0.14, 0.0, "container", va="center", color=GREY)
    place.plot([], [], "s", color=BLUE, label="training view")
    place.plot([], [], "s", color=VERMILION, mfc="white", label="test view")
    place.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    place.set(xlim=(-0.8, 0.8), ylim=(-1.1, 0.18), aspect="equal")
    place.set_axis_off()
    return figure


DIAGRAMS: dict[str, Callable[[], Figure]] = {
    "metric_regions": metric_regions,
    "pixels_and_axes": pixels_and_axes,
    "rig": rig,
}


def main() -> None:
    OUT.mkdir(exist_ok=True)
    with rc_context({"font.family": "DejaVu Sans", "font.size": 8.5}):
        for name, draw in DIAGRAMS.items():
            draw().savefig(OUT / f"{name}.png", dpi=100, metadata={"Software": None}, facecolor="white")


if __name__ == "__main__":
    main()

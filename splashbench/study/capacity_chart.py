"""The chart of a capacity study: quality over size, time and primitives, of test and training views, with its knees.

PNG and SVG; the bytes depend on the results alone.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from splashbench.score.metrics import METRICS
from splashbench.score.notation import in_shown_unit, label
from splashbench.study.capacity import MEAN
from splashbench.study.chart import STYLE, save_figure
from splashbench.study.knee import Knee

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito, safe for colour-blind readers; shapes differ as well. The mean is black.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_SHAPES = ("o", "s", "^", "D", "v", "P")
_GREY, _RED, _BLACK = "#666666", "#A00000", "#000000"
_AXES = {
    "storage_bytes": "size of the model, MB",
    "fit_seconds": "fit time, s",
    "primitives_per_frame": "primitives in a frame",
}


def draw_capacity(
    title: str,
    frame: pd.DataFrame,
    curves: Mapping[str, pd.DataFrame],
    knees: Mapping[str, Knee],
    failures: Sequence[str],
    out: Path,
) -> list[Path]:
    """Draw capacity.png and .svg into the folder `out`; returns their paths.

    A row of panels for PSNR and one for LPIPS, or mIoU without its weights. Full lines are test views, dashed ones
    training views, faint dots runs where there are several seeds. A ring is a knee by price, an arrow a curve that
    still rises.

    Args:
        frame: a row per run, see `capacity.capacity_frame`. curves, knees: by scene.
        failures: a line for each run that failed; they are written below the panels.
    """
    import matplotlib
    from matplotlib.figure import Figure

    rows = ["psnr", "lpips" if frame["lpips"].notna().any() else "miou"]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10.5, 6.9), layout="constrained")
        axes = figure.subplots(len(rows), len(_AXES), squeeze=False)
        for metric, places in zip(rows, axes):
            for cost, place in zip(_AXES, places):
                _panel(place, frame, curves, knees, cost, metric)
                if cost == next(iter(_AXES)):
                    better = {"higher": "higher is better →", "lower": "← lower is better"}[str(METRICS[metric].better)]
                    place.set_ylabel(f"{label(METRICS[metric], arrow=False)}, {better}")
        figure.suptitle(textwrap.fill(title, 110), x=0.01, ha="left", fontsize=11, fontweight="bold")
        shown = [textwrap.shorten(f"✕ {line}", 150, placeholder=" …") for line in failures[:4]]
        more = [f"… and {len(failures) - 4} more failed runs"] if len(failures) > 4 else []
        _legend(figure, curves, knees, [*shown, *more])
        return save_figure(figure, out, "capacity")


def _panel(
    axes: Axes,
    frame: pd.DataFrame,
    curves: Mapping[str, pd.DataFrame],
    knees: Mapping[str, Knee],
    cost: str,
    metric: str,
) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator

    drawn = False
    for number, (name, curve) in enumerate(curves.items()):
        colour, shape, width = _look(name, number)
        if name != MEAN:
            runs = frame[(frame["scene"] == name) & frame[metric].notna() & (frame[cost] > 0)]
            if runs["seed"].nunique() > 1:
                places = [in_shown_unit(METRICS[cost], value) for value in runs[cost]]
                axes.scatter(places, runs[metric], s=9, color=colour, alpha=0.35, linewidths=0, zorder=2)
        for column, line, filled in ((metric, "-", True), (f"train_{metric}", (0, (4, 2)), False)):
            points = curve[curve[column].notna() & (curve[cost] > 0)]
            if points.empty:
                continue
            drawn = True
            axes.plot(
                [in_shown_unit(METRICS[cost], value) for value in points[cost]],
                points[column],
                linestyle=line,
                linewidth=width,
                color=colour,
                marker=shape,
                markersize=4.5,
                markerfacecolor=colour if filled else "white",
                zorder=3,
            )
        _mark(axes, curve, knees[name], cost, metric, colour)
    axes.set_xlabel(_AXES[cost])
    axes.grid(True, color="#E6E6E6", linewidth=0.7)
    axes.set_axisbelow(True)
    if not drawn:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.spines[:].set_visible(False)
        axes.text(0.5, 0.5, "no figures", transform=axes.transAxes, ha="center", color=_GREY)
        return
    # Ticks are doublings, which the price counts; within less than two of them, round numbers.
    axes.set_xscale("log", base=2)
    low, high = axes.dataLim.intervalx
    axes.xaxis.set_major_locator(LogLocator(base=2, numticks=8) if high / low >= 4 else MaxNLocator(5))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _plain(value)))
    axes.minorticks_off()
    axes.margins(x=0.1, y=0.12)


def _mark(axes: Axes, curve: pd.DataFrame, knee: Knee, cost: str, metric: str, colour: str) -> None:
    """A ring around the knee, or an arrow where the curve still rises."""
    number = knee.last if knee.rising else knee.rung
    if number is None:
        return
    x, y = curve.loc[number, cost], curve.loc[number, metric]
    if not (x > 0 and pd.notna(y)):
        return
    place = in_shown_unit(METRICS[cost], x), y
    if knee.rising:
        axes.annotate("▸", place, (5, 0), textcoords="offset points", va="center", color=colour, fontsize=12)
    else:
        axes.scatter(*place, s=130, facecolors="none", edgecolors=_BLACK, linewidths=1.4, zorder=5)


def _look(name: str, number: int) -> tuple[str, str, float]:
    """Colour, shape and line width of the curve `name`, the `number`-th one."""
    if name == MEAN:
        return _BLACK, "o", 2.2
    return _COLOURS[number % len(_COLOURS)], _SHAPES[(number + number // len(_COLOURS)) % len(_SHAPES)], 1.5


def _legend(figure: Any, curves: Mapping[str, pd.DataFrame], knees: Mapping[str, Knee], failures: list[str]) -> None:
    from matplotlib.lines import Line2D

    handles = []
    for number, name in enumerate(curves):
        colour, shape, width = _look(name, number)
        handles.append(Line2D([], [], color=colour, marker=shape, markersize=4.5, linewidth=width, label=name))
    handles.append(Line2D([], [], color=_GREY, label="test views"))
    handles.append(Line2D([], [], color=_GREY, linestyle=(0, (4, 2)), label="training views"))
    if any(knee.rung is not None for knee in knees.values()):
        ring: dict[str, Any] = {"marker": "o", "markersize": 11, "markerfacecolor": "none", "markeredgecolor": _BLACK}
        handles.append(Line2D([], [], linestyle="none", label="knee", **ring))
    if any(knee.rising for knee in knees.values()):
        handles.append(Line2D([], [], linestyle="none", marker=">", markersize=5, color=_GREY, label="still rising"))
    legend = figure.legend(handles=handles, loc="outside lower left", ncols=min(len(handles), 7), frameon=False)
    if failures:
        legend.set_title("\n".join(failures), prop={"size": 7.5})
        legend.get_title().set_color(_RED)
        legend.set_alignment("left")


def _plain(value: float) -> str:
    """ "0.0625", "16", "8192" or "16.4k"."""
    return f"{value / 1000:.3g}k" if value >= 10_000 else f"{value:.4g}"

"""The decisions of a fit as a chart: a panel for each, cost across and quality up; bought filled, refused hollow.

ladder.py computes what is drawn. A decision without quality is drawn as bars, one without any figure as text.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Literal

from splashbench.errors import SplashbenchError
from splashbench.files import require_file_place
from splashbench.report.charts import COLOURS, GREY, STYLE, save_figure
from splashbench.report.decision_text import BASES, chosen_rung, gain_text, shortened
from splashbench.report.ladder import Ladder, Scale, ladder, scale
from splashbench.submission import Decision

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Panels in one figure; more could not be read.
MAX_PANELS = 12
_COLUMNS = 3
# Of a panel: rungs that are named each, bars, and lines of text.
_NAMED, _BARS, _LINES = 8, 10, 9
_BOUGHT, _REFUSED = COLOURS[0], COLOURS[1]
_INK = "#222222"
# Around what was chosen.
_RING: dict[str, Any] = {"s": 150, "facecolors": "none", "edgecolors": _INK, "linewidths": 1.4}


def require_chart_place(path: Path) -> None:
    """Raise SplashbenchError where `path` is not named .png or .svg, or cannot be written."""
    if path.suffix.lower() not in (".png", ".svg"):
        raise SplashbenchError(f"{path} is neither .png nor .svg; give a name that ends in one of them")
    require_file_place(path)


def decision_chart(title: str, decisions: Sequence[Decision], path: Path) -> int:
    """Draw the first `MAX_PANELS` of `decisions` to `path`, whole or not at all; returns how many are left out.

    Raises SplashbenchError where `path` is not named .png or .svg, or where there is no decision.
    """
    import matplotlib
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    require_chart_place(path)
    if not decisions:
        raise SplashbenchError(f"there is no decision to draw; {path} was not written")
    drawn = decisions[:MAX_PANELS]
    left_out = len(decisions) - len(drawn)
    columns = min(_COLUMNS, len(drawn))
    rows = ceil(len(drawn) / columns)
    with matplotlib.rc_context(STYLE):
        layout = ConstrainedLayoutEngine(h_pad=0.12, w_pad=0.1)
        figure = Figure(figsize=(max(6.5, 4.7 * columns), 0.9 + 3.4 * rows), layout=layout)
        places = list(figure.subplots(rows, columns, squeeze=False).flat)
        for decision, axes in zip(drawn, places):
            _panel(axes, decision)
        for axes in places[len(drawn) :]:
            axes.set_axis_off()
        more = f" (the first {len(drawn)} of {len(decisions)} decisions; {left_out} left out)" if left_out else ""
        figure.suptitle(shortened(title, 70) + more, x=0.01, ha="left", fontsize=12, fontweight="bold")
        _legend(figure, 5 if columns > 1 else 3)
        save_figure(figure, path)
    return left_out


def _panel(axes: Axes, decision: Decision) -> None:
    points = ladder(decision)
    lengths = None if points else scale(decision)
    if points:
        _draw_ladder(axes, decision, points)
    elif lengths:
        _draw_scale(axes, decision, lengths)
    else:
        _draw_text(axes, decision)
    about = f"{BASES[decision.basis]}: {shortened(decision.because, 300)}".rstrip(": ")
    lines = wrap(shortened(about, 112), 60)[:2]
    # Strangers' texts of any length must not take the room of the panels.
    heading = shortened(f"{decision.name}: {decision.chosen}", 44)
    styles: tuple[tuple[str, int, dict[str, Any]], ...] = (
        (heading, 28, {"fontsize": 9.5, "fontweight": "bold", "color": _INK}),
        ("\n".join(lines), 25, {"fontsize": 7.5, "color": GREY, "va": "top"}),
    )
    for text, height, style in styles:
        axes.annotate(
            text, (0, 1), (0, height), xycoords="axes fraction", textcoords="offset points", in_layout=False, **style
        )
    axes.set_title(" \n \n ", fontsize=9)  # their room


def _draw_ladder(axes: Axes, decision: Decision, points: Ladder) -> None:
    chosen = chosen_rung(decision)
    for i, (rung, held) in enumerate(zip(decision.rungs, points.before)):
        y = points.y[i]
        if y is None:
            continue
        x, colour = points.x[i], _BOUGHT if rung.bought else _REFUSED
        start = None if held is None else points.y[held]
        if held is not None and start is not None:
            style: Any = "-" if rung.bought else (0, (2, 2))
            axes.plot(
                [points.x[held], x], [start, y], color=colour, linewidth=1.0, linestyle=style, alpha=0.6, zorder=2
            )
        if points.errors[i]:
            axes.errorbar([x], [y], [points.errors[i]], color=colour, elinewidth=1.1, capsize=2.5, zorder=3)
        if i == chosen:
            axes.scatter([x], [y], **_RING, zorder=4)
        face = colour if rung.bought else "white"
        axes.scatter([x], [y], s=40, facecolors=face, edgecolors=colour, linewidths=1.5, zorder=5)
    named = range(len(decision.rungs)) if len(decision.rungs) <= _NAMED else _ends(len(decision.rungs), chosen)
    if points.ordered:
        labels = [shortened(points.names[i], 14) for i in named]
        rotation = 25 if sum(map(len, labels)) > 44 else 0
        axes.set_xticks([points.x[i] for i in named], labels, fontsize=7.5, rotation=rotation)
    else:
        _name_points(axes, points, named)
    axes.margins(0.12, 0.2)
    axes.set_xlabel(points.x_label)
    axes.set_ylabel("\n".join(wrap(points.y_label, 32)))
    _plain_numbers(axes, "y", [y for y in points.y if y is not None])
    axes.grid(True, which="major", color="#E6E6E6", linewidth=0.7)
    axes.set_axisbelow(True)


def _plain_numbers(axes: Axes, name: Literal["x", "y"], values: Sequence[float]) -> None:
    """Write the axis' numbers whole: a power of ten of its own would stand in the panel's heading."""
    largest = max(map(abs, values), default=0.0)
    if 1e-3 <= largest < 1e6:
        axes.ticklabel_format(axis=name, useOffset=False)
    else:
        (axes.xaxis if name == "x" else axes.yaxis).set_major_formatter("{x:.3g}")


def _ends(count: int, chosen: int | None) -> list[int]:
    return sorted({0, count - 1} if chosen is None else {0, chosen, count - 1})


def _name_points(axes: Axes, points: Ladder, named: Sequence[int]) -> None:
    """Write the values beside their points, above and below by turns: neighbours may stand close."""
    for turn, i in enumerate(named):
        y = points.y[i]
        if y is not None:
            axes.annotate(
                shortened(points.names[i], 18),
                (points.x[i], y),
                xytext=(0, 11 if turn % 2 else -11),
                textcoords="offset points",
                ha="center",
                va="bottom" if turn % 2 else "top",
                fontsize=7.5,
                color=_INK,
                bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.5},
                zorder=6,
            )


def _draw_scale(axes: Axes, decision: Decision, lengths: Scale) -> None:
    chosen = chosen_rung(decision)
    shown = _few(len(decision.rungs), chosen)
    for row, i in enumerate(shown):
        colour = _BOUGHT if decision.rungs[i].bought else _REFUSED
        face = colour if decision.rungs[i].bought else "white"
        edge, width = (_INK, 2.0) if i == chosen else (colour, 1.5)
        axes.barh(row, lengths.lengths[i], height=0.5, facecolor=face, edgecolor=edge, linewidth=width, zorder=3)
        reason = shortened(decision.rungs[i].reason, 60)
        if reason:
            # Below its bar, from the axis on: there is room whatever the bar's length.
            axes.annotate(
                reason,
                (0, row + 0.27),
                (3, -1),
                textcoords="offset points",
                va="top",
                fontsize=7,
                color=GREY,
                zorder=5,
                in_layout=False,
            )
    axes.set_yticks(range(len(shown)), [shortened(decision.rungs[i].value, 24) for i in shown], fontsize=7.5)
    axes.set_ylim(max(len(shown), 3) - 0.3, -0.6)
    axes.margins(x=0.12)
    _plain_numbers(axes, "x", lengths.lengths)
    axes.set_xlabel(lengths.label + _left_out(len(decision.rungs), len(shown)))
    axes.grid(True, axis="x", color="#E6E6E6", linewidth=0.7)
    axes.set_axisbelow(True)


def _few(count: int, chosen: int | None) -> list[int]:
    """At most `_BARS` of `count` rungs: the first, with the chosen one in the last place where it comes later."""
    if count <= _BARS:
        return list(range(count))
    return [*range(_BARS - 1), chosen if chosen is not None and chosen >= _BARS else _BARS - 1]


def _left_out(count: int, shown: int) -> str:
    return f" ({count - shown} of {count} rungs left out)" if count > shown else ""


def _draw_text(axes: Axes, decision: Decision) -> None:
    """The rungs as lines; a mark's fill says whether one was bought."""
    chosen = chosen_rung(decision)
    shown = decision.rungs[:_LINES]
    for i, rung in enumerate(shown):
        height = 0.93 - 0.1 * i
        colour = _BOUGHT if rung.bought else _REFUSED
        axes.scatter([0.05], [height], s=36, facecolors=colour if rung.bought else "white", edgecolors=colour)
        if i == chosen:
            axes.scatter([0.05], [height], **_RING)
        gain = f" {gain_text(rung.gain, rung.standard_error)}" if rung.gain is not None else ""
        line = f"{rung.value}{gain}{': ' if rung.reason else ''}{rung.reason}"
        axes.text(0.11, height, shortened(line, 54), fontsize=8, va="center", color=_INK, in_layout=False)
    rest = _left_out(len(decision.rungs), len(shown)).strip() if shown else "no rung is recorded"
    axes.text(0.11, 0.93 - 0.1 * len(shown), rest, fontsize=8, va="center", color=GREY)
    axes.set(xlim=(0, 1), ylim=(0, 1), xticks=[], yticks=[])
    for side in ("left", "bottom"):
        axes.spines[side].set_visible(False)


def _legend(figure: Figure, columns: int) -> None:
    from matplotlib.lines import Line2D

    def mark(label: str, size: float, **style: Any) -> Line2D:
        return Line2D([], [], linestyle="none", marker="o", markersize=size, label=label, **style)

    handles = [
        mark("bought", 6, color=_BOUGHT),
        mark("refused", 6, markerfacecolor="white", markeredgecolor=_REFUSED, markeredgewidth=1.5),
        mark("chosen (black outline)", 11, markerfacecolor="none", markeredgecolor=_INK, markeredgewidth=1.4),
        Line2D([], [], marker="|", markersize=11, linestyle="none", color=GREY, label="± standard error of the gain"),
        Line2D([], [], color=GREY, linewidth=1, label="from the rung that was held"),
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=columns, frameon=False, fontsize=8)

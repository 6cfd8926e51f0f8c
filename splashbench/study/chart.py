"""A study's chart: a mark per row with bars over seeds; the paper's figures hollow, in panels of their own.

PNG and SVG; the bytes depend on the results alone.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splashbench.files import atomic_path
from splashbench.score.notation import FILTER_MARK, FILTER_NOTE, in_shown_unit, label
from splashbench.study.spec import metric_of
from splashbench.study.table import Table, TableRow

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito: blue for rows, vermilion for the baseline, grey for controls.
_BLUE, _VERMILION, _GREY = "#0072B2", "#D55E00", "#666666"
_COLUMNS = 3
# More do not fit over a panel in one line.
_TITLE_LETTERS = 42
#: Of the charts of all studies.
STYLE: dict[str, Any] = {
    "svg.hashsalt": "splashbench",
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "text.parse_math": False,  # names come from files; a "$" in one is no formula
    "axes.spines.top": False,
    "axes.spines.right": False,
}
_STYLE = STYLE | {"axes.titlesize": 9, "axes.titlelocation": "left"}


def draw_chart(table: Table, out: Path) -> list[Path]:
    """Draw chart.png and chart.svg into the folder `out`; returns their paths.

    A panel per metric, a line per row: small dots below are seeds, the mark their mean, the bar one standard deviation
    to either side, the dashed line the baseline. What the paper reports follows in panels of its own.
    """
    import matplotlib
    from matplotlib.figure import Figure

    measured = [(name, False) for name in table.plan.spec.metrics]
    reported = [(name, True) for name, _ in measured if any(name in row.paper for row in table.rows)]
    lines = [block[i : i + _COLUMNS] for block in (measured, reported) for i in range(0, len(block), _COLUMNS)]
    height = 0.62 + 0.21 * len(table.rows)
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(10.5, 0.9 + height * len(lines)), layout="constrained")
        axes = figure.subplots(len(lines), _COLUMNS, squeeze=False)
        for line, places in zip(lines, axes):
            for i, place in enumerate(places):
                if i < len(line):
                    _panel(place, table, *line[i], named=i == 0)
                else:
                    place.set_axis_off()
        spec = table.plan.spec
        figure.suptitle(spec.title or f"Study {spec.name}", x=0.01, ha="left", fontsize=11.5, fontweight="bold")
        legend = "Mark: mean over scenes and seeds. Bar: one standard deviation over seeds to either side. Dots: seeds."
        legend += f" Dashed: {spec.baseline}." + (" Hollow: as the paper reports, of other scenes." if reported else "")
        if table.filtered:
            legend += "\n" + textwrap.fill(FILTER_NOTE, 190)
        figure.supxlabel(legend, x=0.01, ha="left", fontsize=7.5, color=_GREY)
        return save_figure(figure, out, "chart")


def save_figure(figure: Figure, out: Path, name: str) -> list[Path]:
    """Write NAME.png and NAME.svg into the folder `out`, without a date, and return their paths."""
    paths = [Path(out, f"{name}.png"), Path(out, f"{name}.svg")]
    for path, metadata in zip(paths, ({"Software": None}, {"Date": None, "Creator": None})):
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format=path.suffix[1:], dpi=150, metadata=metadata, facecolor="white")
    return paths


def _panel(axes: Axes, table: Table, name: str, reported: bool, named: bool) -> None:
    better = {"higher": ", higher is better →", "lower": ", ← lower is better", None: ""}[metric_of(name).better]
    title = f"{label(metric_of(name), arrow=False)}{', as the paper reports' if reported else better}"
    axes.set_title(textwrap.fill(title, _TITLE_LETTERS))
    values = {row.name: _value(row, name, reported) for row in table.rows}
    baseline = values[table.plan.spec.baseline]
    if baseline is not None:
        axes.axvline(baseline, color=_VERMILION, linewidth=0.9, linestyle=(0, (4, 3)), zorder=1)
    low, high = _limits([row for row in table.rows if not row.control], name, reported)
    for y, row in enumerate(table.rows):
        colour = _VERMILION if row.name == table.plan.spec.baseline else _GREY if row.control else _BLUE
        value = values[row.name]
        if value is None:
            reason = "not reported" if reported else _why(row)
            _write_at_edge(axes, reason, y)
            continue
        if row.control and not low <= value <= high:
            _write_at_edge(axes, f"{value:.3g} →" if value > high else f"← {value:.3g}", y, right=value > high)
            continue
        if not reported:
            _draw_seeds(axes, row, name, y, colour)
        axes.scatter(
            [value], [y], s=34, facecolors="none" if reported else colour, edgecolors=colour, linewidths=1.3, zorder=4
        )
        if row.mixed and metric_of(name).filtered and not reported:
            axes.annotate(FILTER_MARK, (value, y), (5, 1), textcoords="offset points", fontsize=8, zorder=5)
    axes.set_ylim(len(table.rows) - 0.5, -0.5)
    axes.set_yticks(range(len(table.rows)), [_name(row, reported) if named else "" for row in table.rows])
    axes.tick_params(axis="y", length=0)
    axes.margins(x=0.08)
    axes.locator_params(axis="x", nbins=5)
    axes.grid(True, axis="x", color="#E6E6E6", linewidth=0.7)
    axes.set_axisbelow(True)
    _no_axis_without_values(axes, values)


def _limits(rows: list[TableRow], name: str, reported: bool) -> tuple[float, float]:
    """The range in which controls are drawn to scale: three times the range of the other rows."""
    values = [value for row in rows if (value := _value(row, name, reported)) is not None]
    if not values:
        return -inf, inf
    reach = (max(values) - min(values)) or abs(values[0]) or 1.0
    return min(values) - reach, max(values) + reach


def _write_at_edge(axes: Axes, text: str, y: int, right: bool = False) -> None:
    """Write why a mark is missing, or the value of a control beyond the panel's edge."""
    axes.annotate(
        text,
        (0.99 if right else 0.01, y),
        xycoords=("axes fraction", "data"),
        ha="right" if right else "left",
        va="center",
        fontsize=7,
        color=_GREY,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
    )


def _name(row: TableRow, reported: bool) -> str:
    """The row's name; with the number of runs that succeeded where some failed, so that no failure vanishes."""
    return row.name if reported or row.complete else f"{row.name} ({row.count('ok')} of {len(row.runs)} runs)"


def _no_axis_without_values(axes: Axes, values: Mapping[str, float | None]) -> None:
    if all(value is None for value in values.values()):
        axes.set_xticks([])


def _value(row: TableRow, name: str, reported: bool) -> float | None:
    value = row.paper.get(name) if reported else row.cells[name].mean
    return None if value is None else in_shown_unit(metric_of(name), value)


def _draw_seeds(axes: Axes, row: TableRow, name: str, y: int, colour: str) -> None:
    cell = row.cells[name]
    seeds = [in_shown_unit(metric_of(name), value) for value in cell.seeds]
    if len(seeds) < 2 or cell.mean is None or cell.std is None:
        return
    axes.scatter(seeds, [y + 0.27] * len(seeds), s=9, color=colour, alpha=0.6, linewidths=0, zorder=2)
    ends = [in_shown_unit(metric_of(name), cell.mean - cell.std), in_shown_unit(metric_of(name), cell.mean + cell.std)]
    axes.plot(ends, [y, y], color=colour, linewidth=1.4, solid_capstyle="butt", zorder=3)


def _why(row: TableRow) -> str:
    """Why a row has no mean."""
    if row.failed:
        return f"✕ failed: {', '.join(sorted({run.status for run in row.failed}))}"
    return "not run yet" if row.count("ok") < len(row.runs) else "no figure"

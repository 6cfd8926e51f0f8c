"""Speed against accuracy: fit time against LPIPS and against PSNR over background (docs/protocol.md).

PNG and SVG; the bytes depend on the results alone. speed_accuracy.py computes what is drawn.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

from splashbench.files import atomic_path
from splashbench.report.results import ResultFile
from splashbench.report.speed_accuracy import ChartedMethod, Machine, Summary, machines, pareto_front, reported_machine
from splashbench.score.metrics import METRICS
from splashbench.score.notation import FILTER_MARK, FILTER_NOTE, label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Okabe and Ito's palette, safe for colour-blind readers, without its black and its pale yellow; shapes differ as well.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_SHAPES = ("o", "s", "^", "D", "v", "P")
GREY = "#666666"
_ORACLE = "oracle"
_GIB = 2.0**30
_MIN_AREA, _MAX_AREA = 30.0, 420.0
#: Rows of panels, methods in each, and kinds of failures written into a panel, at most.
_MAX_ROWS, _MAX_METHODS, _MAX_FAILURES = 8, 24, 12
_TICKS = tuple((n * unit, f"{n} {name}") for unit, name in ((1, "s"), (60, "min"), (3600, "h")) for n in (1, 3, 10, 30))
#: Of every chart of a report, for matplotlib.rc_context.
STYLE: dict[str, Any] = {
    "svg.hashsalt": "splashbench",
    "font.family": "DejaVu Sans",
    "font.size": 9,
    # Names come from strangers' files; a "$" in one is no formula.
    "text.parse_math": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
}


def speed_accuracy_chart(sources: Sequence[ResultFile], out: Path, with_paper: bool = False) -> list[Path]:
    """Draw speed_accuracy.png and .svg into the folder `out`; returns their paths.

    Faint dots are runs, full marks the inter-quartile mean of a method with 95% bootstrap bars, the staircase the
    Pareto front; a mark's area is the peak memory. Without LPIPS weights mIoU takes the panel of LPIPS. A row of
    panels per machine; with `with_paper`, one more with the paper's figures, hollow.
    """
    import matplotlib
    from matplotlib.figure import Figure

    measured = machines(sources)
    rows, note = _drawn(measured)
    rows += [reported_machine()] if with_paper else []
    methods = sorted({entry.label for row in rows for entry in row.entries})
    looks = {
        label: (COLOURS[i % len(COLOURS)], _SHAPES[(i + i // len(COLOURS)) % len(_SHAPES)])
        for i, label in enumerate(methods)
    }
    largest = max((memory for row in rows for e in row.entries if (memory := e.memory_bytes())), default=_GIB)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10.5, 0.9 + 3.7 * len(rows)), layout="constrained")
        axes = figure.subplots(len(rows), 2, squeeze=False)
        for row, (left, right) in zip(rows, axes):
            _panel(left, row, row.perceptual_name(), looks, largest)
            _panel(right, row, row.quality_name(), looks, largest)
            left.set_title(row.title)
        figure.suptitle("Speed against accuracy, test views", x=0.01, ha="left", fontsize=12, fontweight="bold")
        if note:
            figure.supxlabel(note, x=0.01, ha="left", fontsize=8, color=GREY)
        _legend(figure, looks, largest, any(row.reported for row in rows), _filtered(rows))
        paths = [Path(out, "speed_accuracy.png"), Path(out, "speed_accuracy.svg")]
        for path in paths:
            save_figure(figure, path)
    return paths


def _drawn(rows: list[Machine]) -> tuple[list[Machine], str]:
    """The rows with the most runs, of each the methods on most scenes; and what is left out, in words.

    A picture of sixty machines or of three thousand methods shows nothing, and takes minutes to draw.
    """

    def runs(row: Machine) -> int:
        return sum(len(entry.dots) for entry in row.entries) + sum(row.failures.values())

    chosen = {id(row) for row in sorted(rows, key=lambda row: (-runs(row), row.title))[:_MAX_ROWS]}
    kept = [row for row in rows if id(row) in chosen]
    methods = 0
    for n, row in enumerate(kept):
        first = sorted(row.entries, key=lambda entry: (-len(entry.scenes), -len(entry.dots), entry.label))
        methods += max(0, len(first) - _MAX_METHODS)
        names = {entry.label for entry in first[:_MAX_METHODS]}
        failures = Counter(dict(sorted(row.failures.items(), key=lambda item: (-item[1], item[0]))[:_MAX_FAILURES]))
        others = sum(row.failures.values()) - sum(failures.values())
        if others:
            failures["other failed runs"] = others
        entries = [entry for entry in row.entries if entry.label in names]
        kept[n] = replace(row, entries=entries, failures=failures)
    left = [f"{len(rows) - len(kept)} more machines"] if len(rows) > len(kept) else []
    left += [f"{methods} more methods"] if methods else []
    return kept, f"Not drawn, but in the tables: {' and '.join(left)}." if left else ""


def save_figure(figure: Figure, path: Path) -> None:
    """Write `figure` to `path`, .png or .svg, without a date. Call it within the figure's style."""
    kind = path.suffix[1:].lower()
    metadata = {"Software": None} if kind == "png" else {"Date": None, "Creator": None}
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=kind, dpi=150, metadata=metadata, facecolor="white")


def _panel(axes: Axes, row: Machine, name: str, looks: dict[str, tuple[str, str]], largest: float) -> None:
    metric = METRICS[name]
    higher = metric.better == "higher"
    summaries = {entry.label: summary for entry in row.entries if (summary := entry.summary(name))}
    for entry in row.entries:
        if entry.label in summaries:
            mean = summaries[entry.label]
            _draw_entry(axes, entry, mean, name, looks[entry.label], largest, row.reported)
            notes = [f"{len(entry.scenes)} of {row.n_scenes} scenes"] if entry.shared is None else []
            notes += [f"{entry.failed} failed"] if entry.failed else []
            if notes:
                note = ", ".join(notes)
                axes.annotate(
                    note, (mean.seconds.value, mean.value.value), (9, 5), textcoords="offset points", fontsize=7.5
                )
    # Other scenes, or those alone on which it did not fail, may be the easy ones.
    comparing = [summaries[e.label] for e in row.entries if e.compares(name) and e.label in summaries]
    if comparing:
        _draw_front(axes, [(s.seconds.value, s.value.value) for s in comparing], higher)
    axes.set_xscale("log")
    _set_limits(axes, row, name, summaries)
    _draw_controls(axes, row, name)
    _draw_failures(axes, row, higher)
    if not summaries:
        axes.text(
            0.5, 0.5, f"no run has {metric.title} and a fit time", transform=axes.transAxes, ha="center", color=GREY
        )
    axes.set_xlabel("fit time, log scale (← faster)")
    axes.set_ylabel(f"{label(metric, arrow=False)}, {'higher is better →' if higher else '← lower is better'}")
    axes.grid(True, which="major", color="#E6E6E6", linewidth=0.7)
    axes.set_axisbelow(True)


def _draw_entry(
    axes: Axes, entry: ChartedMethod, mean: Summary, name: str, look: tuple[str, str], largest: float, reported: bool
) -> None:
    colour, shape = look
    if len(entry.dots) > 1:
        dots = [(dot.seconds, dot.values[name]) for dot in entry.dots if name in dot.values]
        seconds, values = zip(*dots)
        axes.scatter(seconds, values, s=12, marker=shape, color=colour, alpha=0.3, linewidths=0, zorder=2)
    x, y = mean.seconds.value, mean.value.value
    for interval, bar in ((mean.seconds.interval, "h"), (mean.value.interval, "v")):
        if interval:
            ends = (interval, (y, y)) if bar == "h" else ((x, x), interval)
            axes.plot(*ends, color=colour, linewidth=1.1, zorder=3)
    axes.scatter(
        [x],
        [y],
        s=_area(entry.memory_bytes(), largest),
        marker=shape,
        facecolors="none" if reported else colour,
        edgecolors=colour if reported else "white",
        linewidths=1.6 if reported else 0.8,
        zorder=4,
    )


def _area(memory: float | None, largest: float) -> float:
    return _MIN_AREA if not memory else max(_MIN_AREA, _MAX_AREA * memory / largest)


def _draw_front(axes: Axes, points: list[tuple[float, float]], higher: bool) -> None:
    front = pareto_front(points, higher)
    seconds, values = [point[0] for point in front], [point[1] for point in front]
    # The best value so far holds until a slower method beats it; the last one holds for ever.
    seconds.append(max(point[0] for point in points) * 1e3)
    values.append(values[-1])
    axes.plot(seconds, values, drawstyle="steps-post", color="#AAAAAA", linewidth=1.2, zorder=1, scalex=False)


def _set_limits(axes: Axes, row: Machine, name: str, summaries: dict[str, Summary]) -> None:
    """Room around all runs, and around the controls that are on the runs' scale (the oracle's 100 dB is not)."""
    seconds = [dot.seconds for entry in row.entries for dot in entry.dots if name in dot.values] or [1.0, 1000.0]
    low, high = min(seconds) / 2, max(seconds) * 2
    ticks = [(value, label) for value, label in _TICKS if low <= value <= high]
    axes.set_xlim(low, high)
    axes.set_xticks([value for value, _ in ticks], [label for _, label in ticks])
    axes.minorticks_off()
    values = [dot.values[name] for entry in row.entries for dot in entry.dots if name in dot.values]
    values += [end for s in summaries.values() for end in s.value.interval or ()]
    values += [figures[name] for method, figures in row.controls.items() if name in figures and _on_scale(method, name)]
    bottom, top = (min(values), max(values)) if values else (0.0, 1.0)
    margin = 0.14 * (top - bottom) or 0.1 * max(abs(top), 1e-3)
    axes.set_ylim(bottom - margin, top + margin)


def _on_scale(method: str, name: str) -> bool:
    return method != _ORACLE or name in ("lpips", "miou")


def _draw_controls(axes: Axes, row: Machine, name: str) -> None:
    for method, figures in row.controls.items():
        if name not in figures or not _on_scale(method, name):
            continue
        axes.axhline(figures[name], color=GREY, linewidth=0.9, linestyle=(0, (4, 3)), zorder=1)
        axes.annotate(
            f"control: {method}",
            (1.0, figures[name]),
            xycoords=("axes fraction", "data"),
            xytext=(-3, 2),
            textcoords="offset points",
            ha="right",
            va="bottom",
            fontsize=7.5,
            color=GREY,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5},
        )


def _draw_failures(axes: Axes, row: Machine, higher: bool) -> None:
    """Write failed runs at the worse end of the panel, by name: they have no value and must not vanish."""
    for i, (what, count) in enumerate(sorted(row.failures.items())):
        height = 0.03 + 0.06 * i
        axes.text(
            0.015,
            height if higher else 1 - height,
            f"✕ {what}{f' × {count}' if count > 1 else ''}",
            transform=axes.transAxes,
            va="center",
            fontsize=7.5,
            color="#A00000",
        )


def _filtered(rows: list[Machine]) -> set[str]:
    """Labels of the mixed methods in panels that show mIoU, which rests on the protocol's filter."""
    shown = [row for row in rows if METRICS[row.perceptual_name()].filtered]
    return {entry.label for row in shown for entry in row.entries if entry.mixed}


def _legend(figure: Any, looks: dict[str, tuple[str, str]], largest: float, reported: bool, filtered: set[str]) -> None:
    from matplotlib.lines import Line2D

    def mark(shape: str, area: float, **style: Any) -> Line2D:
        return Line2D([], [], linestyle="none", marker=shape, markersize=area**0.5, **style)

    handles = [
        mark(shape, 60, color=colour, markeredgewidth=0, label=label + (FILTER_MARK if label in filtered else ""))
        for label, (colour, shape) in looks.items()
    ]
    handles.append(mark("o", 12, color=GREY, alpha=0.4, markeredgewidth=0, label="one run"))
    handles.append(Line2D([], [], color="#AAAAAA", linewidth=1.2, drawstyle="steps-post", label="Pareto front"))
    for share in (0.25, 1.0):
        label = f"{largest * share / _GIB:.2g} GiB peak memory (area)"
        area = _area(largest * share, largest)
        handles.append(mark("o", area, markerfacecolor="none", markeredgecolor=GREY, label=label))
    if reported:
        hollow = mark("s", 60, markerfacecolor="none", markeredgecolor=GREY, label="hollow: as reported by the paper")
        handles.append(hollow)
    legend = figure.legend(
        handles=handles, loc="outside lower left", ncols=4, frameon=False, fontsize=8, labelspacing=1.0
    )
    if filtered:
        legend.set_title(fill(FILTER_NOTE.replace("figure", "mIoU"), 150), prop={"size": 7.5})
        legend.set_alignment("left")

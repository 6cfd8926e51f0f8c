"""What a stress study found, as files: stability.md and a chart for people, CSV for programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from splashbench.files import files_together, write_text
from splashbench.markdown import bullets, escaped, one_line
from splashbench.markdown import table as markdown_table
from splashbench.score import Result
from splashbench.score.notation import FILTER_MARK, FILTER_NOTE, NO_FIGURE
from splashbench.statistics import LEAST_RUNS, Estimate
from splashbench.study.chart import save_figure
from splashbench.study.job import Store
from splashbench.study.report import frame_csv
from splashbench.study.spec import metric_of
from splashbench.study.stability import (
    BROKEN,
    Breakdown,
    Stability,
    StressRun,
    breakdown,
    retentions,
    stability,
)
from splashbench.study.stress import METRICS, Harm, StressPlan, higher_is_better, lacks_weights, stress_runs
from splashbench.study.stress_pages import place, write_pages
from splashbench.study.table_markdown import scenes_and_machines

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito, in the order of the methods.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#666666")
_COLUMNS = 5


@dataclass(frozen=True)
class Finding:
    """By one metric: each method's retentions, stability, and breakdown by kind; methods without a run are left out.

    filtered: methods whose figures rest on the protocol's filter of mixed methods.
    """

    metric: str
    filtered: frozenset[str]
    retentions: dict[str, dict[StressRun, float]]
    stability: dict[str, Stability]
    breakdowns: dict[tuple[str, str], Breakdown]

    def marked(self, label: str) -> str:
        """A method's `label`, with the mark where its figures rest on the filter."""
        return label + (FILTER_MARK if label in self.filtered else "")


def find(stress: StressPlan, store: Store, metric: str) -> Finding:
    """What the runs that are there say by `metric`."""
    runs, nothing = stress_runs(stress, store, metric)
    kept = retentions(runs, nothing, higher_is_better(metric))
    by_method = {label: {r: v for r, v in kept.items() if r.method == label} for label in stress.methods}
    by_method = {label: found for label, found in by_method.items() if found}
    points = {}
    for label, found in by_method.items():
        for kind, amounts in _amounts(stress.harms).items():
            asked = [harm.level for harm in stress.harms if harm.kind.named() == kind]
            # Levels in a row, whichever were asked for and made.
            levels = [level for level in asked if any(r.kind == kind and r.level == level for r in found)]
            if not levels:
                continue
            amounts = [amounts[0], *(amounts[1 + asked.index(level)] for level in levels)]
            ranked = {
                StressRun(r.method, r.scene, r.seed, kind, levels.index(r.level) + 1, r.value): value
                for r, value in found.items()
                if r.kind == kind
            }
            points[label, kind] = breakdown(ranked, kind, amounts)
    results = _results(stress, store)
    mixed = {label for label, result in results if result.mixed} if metric_of(metric).filtered else set()
    scores = {label: stability(found) for label, found in by_method.items()}
    return Finding(metric, frozenset(mixed), by_method, scores, points)


def write_stress_report(stress: StressPlan, store: Store, out: Path, command: str) -> list[Path]:
    """Write all files into `out`, all or none; returns their paths."""
    findings = [find(stress, store, metric) for metric in METRICS if _has(stress, store, metric)]
    with files_together(out) as staging:
        write_text(staging / "stability.csv", frame_csv(_stability_frame(findings)))
        write_text(staging / "breakdown.csv", frame_csv(_breakdown_frame(stress, findings)))
        write_text(staging / "retention.csv", frame_csv(_retention_frame(stress, findings)))
        names = ["stability.md", "stability.csv", "breakdown.csv", "retention.csv"]
        if findings and findings[0].breakdowns:
            names += [path.name for path in _draw(stress, findings[0], staging)]
        pages = []
        if findings:
            first = findings[0]
            pages = write_pages(stress, store, first.retentions, first.breakdowns, first.metric, staging)
        text = _markdown(stress, store, findings, command, "retention.png" in names, pages)
        write_text(staging / "stability.md", text)
    return [Path(out, name) for name in [*names, *pages]]


def _has(stress: StressPlan, store: Store, metric: str) -> bool:
    """Whether any run has `metric`: LPIPS needs weights."""
    return any(result.value(metric) is not None for _, result in _results(stress, store))


def _results(stress: StressPlan, store: Store) -> list[tuple[str, Result]]:
    """The results that are there, each with its method's label."""
    entries = ((stress.rows[run.variant.name][0], store.entry(run.digest)) for run in stress.plan.runs)
    found = ((label, store.result(entry)) for label, entry in entries if entry is not None)
    return [(label, result) for label, result in found if result is not None]


def _conditions(stress: StressPlan, store: Store) -> str:
    """What was run, what the scenes told, where."""
    results = _results(stress, store)
    methods = dict.fromkeys(f"{label}: version {r.method_version}, preset {r.preset}" for label, r in results)
    told = dict.fromkeys(", ".join(r.told) or "nothing" for _, r in results if r.told is not None)
    lines = [*methods, *(f"Told besides images, masks and cameras: {text}" for text in told)]
    lines.append(f"Seeds: {', '.join(map(str, stress.plan.spec.seeds))}")
    parts = [bullets(map(one_line, lines)), scenes_and_machines(stress.plan.scenes, [r for _, r in results])]
    return "\n".join(parts)


def _amounts(harms: Sequence[Harm]) -> dict[str, list[float]]:
    """By kind, the amounts of a recording as it is and of each severity."""
    found: dict[str, list[float]] = {}
    for harm in harms:
        found.setdefault(harm.kind.named(), [harm.kind.none]).append(harm.amount)
    return found


def _stability_frame(findings: Sequence[Finding]) -> pd.DataFrame:
    figures = ["S", "S_low", "S_high", "CVaR10", "CVaR10_low", "CVaR10_high", "resampled"]
    columns = ["method", "metric", *figures, "runs", "failed"]
    rows = [
        [label, finding.metric, *_three(found.score), *_three(found.worst), found.resampled, found.runs, found.failed]
        for finding in findings
        for label, found in finding.stability.items()
    ]
    return pd.DataFrame(rows, columns=columns)


def _three(estimate: Estimate) -> tuple[float, float | None, float | None]:
    low, high = estimate.interval or (None, None)
    return estimate.value, low, high


def _breakdown_frame(stress: StressPlan, findings: Sequence[Finding]) -> pd.DataFrame:
    """point, low, high: empty where they lie beyond the last amount."""
    units = {harm.kind.named(): harm.kind.unit for harm in stress.harms}
    rows = [
        [label, finding.metric, kind, units[kind], found.point, *found.interval, amount, mean, fitted]
        for finding in findings
        for (label, kind), found in finding.breakdowns.items()
        for amount, mean, fitted in zip(found.amounts, found.retentions, found.fitted)
    ]
    columns = ["method", "metric", "kind", "unit", "point", "low", "high", "amount", "retention", "fitted"]
    return pd.DataFrame(rows, columns=columns)


def _retention_frame(stress: StressPlan, findings: Sequence[Finding]) -> pd.DataFrame:
    amounts = {(harm.kind.named(), harm.level): harm.amount for harm in stress.harms}
    rows = [
        [
            run.method,
            run.scene,
            run.seed,
            run.kind,
            run.level,
            amounts[run.kind, run.level],
            finding.metric,
            run.value,
            kept,
        ]
        for finding in findings
        for found in finding.retentions.values()
        for run, kept in found.items()
    ]
    columns = ["method", "scene", "seed", "kind", "severity", "amount", "metric", "value", "retention"]
    return pd.DataFrame(rows, columns=columns)


def _markdown(
    stress: StressPlan, store: Store, findings: Sequence[Finding], command: str, with_chart: bool, pages: Sequence[str]
) -> str:
    parts = ["# Stability", f"```\n{command}\n```"]
    if with_chart:
        parts.append("![Retention by kind and severity](retention.png)")
    links = [f"[{page.removeprefix('method_')[:-3]}]({page})" for page in pages if page.endswith(".md")]
    if links:
        parts.append(f"A page for each method, with pictures: {', '.join(links)}.")
    for finding in findings:
        parts += [f"## By {finding.metric}", _scores(finding), _points(stress, finding)]
        parts += [FILTER_NOTE] if finding.filtered else []
        unscored = sum(lacks_weights(result, finding.metric) for _, result in _results(stress, store))
        if unscored:
            parts.append(
                f"**{unscored} runs were scored without weights for {finding.metric}, and are not among these.** The "
                "same command makes them again where there are weights and time."
            )
    failures = [
        escaped(f"{run.scene.name}, {run.variant.name}, seed {run.seed}: {entry.status}: {entry.reason}")
        for run in stress.plan.runs
        if (entry := store.entry(run.digest)) is not None and entry.status != "ok"
    ]
    missing = sum(store.entry(run.digest) is None for run in stress.plan.runs)
    if failures:
        parts += ["## Failed runs", "Each keeps nothing.", bullets(failures)]
    if stress.left_out:
        lines = [f"{h.kind.named()} {h.amount:g} {h.kind.unit}: {escaped(reason)}" for h, reason in stress.left_out]
        parts += ["## Left out", bullets(lines)]
    if missing:
        parts.append(
            f"**{missing} of {len(stress.plan.runs)} runs are not made yet.** Those made under a budget lie near where "
            "methods break: breaking points compare, S and CVaR10 do not."
        )
    parts.append(
        "S is the interquartile mean of retentions, CVaR10 the mean of the worst tenth; retention is the gain over "
        f"`nothing` as a share of the same method's gain on the recording as it is. It breaks where retention falls "
        f"below {BROKEN:g}. Intervals are 95 %, by resampling scenes, then seeds, from {LEAST_RUNS} recordings on. "
        "With fewer, those of S and CVaR10 resample kinds of harm: they say how much these depend on which kinds were "
        "tried, and nothing of other recordings."
    )
    parts += ["## Conditions", _conditions(stress, store)]
    return "\n\n".join(parts) + "\n"


def _scores(finding: Finding) -> str:
    rows = finding.stability
    figures = {
        "S": [_shown(found.score) for found in rows.values()],
        "CVaR10": [_shown(found.worst) for found in rows.values()],
        "runs": [str(found.runs) for found in rows.values()],
        "failed": [str(found.failed) for found in rows.values()],
    }
    return markdown_table({"method": [finding.marked(label) for label in rows], **figures}, right=figures)


def _shown(estimate: Estimate) -> str:
    if estimate.interval is None:
        return f"{estimate.value:.3f}"
    return f"{estimate.value:.3f} ({estimate.interval[0]:.3f} to {estimate.interval[1]:.3f})"


def _points(stress: StressPlan, finding: Finding) -> str:
    units = {harm.kind.named(): harm.kind.unit for harm in stress.harms}
    kinds = [kind for kind in units if any((label, kind) in finding.breakdowns for label in finding.stability)]
    columns = {
        f"{finding.marked(label)} breaks at": [_place(finding, label, kind) for kind in kinds]
        for label in finding.stability
    }
    cells = {"kind": [f"`{kind}`" for kind in kinds], "unit": [units[kind] for kind in kinds]}
    return markdown_table({**cells, **columns}, right=columns)


def _place(finding: Finding, label: str, kind: str) -> str:
    found = finding.breakdowns.get((label, kind))
    return NO_FIGURE if found is None else place(found)


def _draw(stress: StressPlan, finding: Finding, out: Path) -> list[Path]:
    """retention.png and .svg: a panel per kind, a line per method, which never rises; dots are the means."""
    import matplotlib
    from matplotlib.figure import Figure

    kinds = list(dict.fromkeys(kind for _, kind in finding.breakdowns))
    lines = -(-len(kinds) // _COLUMNS)
    style = {"svg.hashsalt": "splashbench", "font.family": "DejaVu Sans", "font.size": 8, "text.parse_math": False}
    with matplotlib.rc_context(style):
        figure = Figure(figsize=(12, 0.9 + 1.9 * lines), layout="constrained")
        axes = figure.subplots(lines, _COLUMNS, squeeze=False)
        for number, place in enumerate(axes.flat):
            if number < len(kinds):
                _panel(place, stress, finding, kinds[number])
            else:
                place.set_axis_off()
        handles, labels = axes.flat[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=len(labels), frameon=False)
        figure.suptitle(
            f"What is left of {finding.metric} where the recording is worse", x=0.01, ha="left", fontsize=11
        )
        return save_figure(figure, out, "retention")


def _panel(axes: Axes, stress: StressPlan, finding: Finding, kind: str) -> None:
    unit = next(harm.kind.unit for harm in stress.harms if harm.kind.named() == kind)
    axes.set_title(kind.replace("_", " "), loc="left", fontsize=8.5)
    axes.axhline(BROKEN, color="#999999", linewidth=0.8, linestyle=(0, (4, 3)))
    ticks: tuple[float, ...] = ()
    for number, label in enumerate(finding.stability):
        found = finding.breakdowns.get((label, kind))
        if found is None:
            continue
        color, ticks = _COLORS[number % len(_COLORS)], found.amounts
        places = np.arange(len(found.amounts))
        axes.plot(places, found.fitted, color=color, linewidth=1.5, label=label)
        axes.scatter(places[1:], found.retentions[1:], color=color, s=12, linewidths=0)
    axes.set_xticks(range(len(ticks)), ["–", *(f"{amount:g}" for amount in ticks[1:])])
    axes.set_xlabel(unit, fontsize=7.5)
    axes.set_ylim(-0.03, 1.05)
    axes.spines[["top", "right"]].set_visible(False)

"""The front page of a public benchmark: what was handed in, its means over the benchmark's scenes, and the paper's.

Figures are those of leaderboard/leaderboard.csv beside it, so that both pages say the same, verified ones included. A
mean is given where an entry has the figure on every scene of the benchmark, as any other would flatter.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from splashbench.benchmark.repository import ENTRIES, Benchmark, Entry
from splashbench.csv_cells import csv_text
from splashbench.errors import one_line
from splashbench.pages import render
from splashbench.paper_figures import paper_rows
from splashbench.score.metrics import METRICS
from splashbench.score.notation import NO_FIGURE, label, shown
from splashbench.score.result import Result
from splashbench.version import __version__

#: Metrics of the front page.
FIGURES = ("psnr", "ssim", "lpips", "miou", "jitter_error", "fit_seconds")
_MAX_FAULTS = 50
_MAX_LINE = 300


@dataclass(frozen=True)
class Line:
    """A method of an entry. scenes: how many of the benchmark's it ran on; figures: means over all, else None."""

    entry: Entry
    method: str
    preset: str
    scenes: int
    failed: int
    verified: str
    figures: dict[str, float | None]


def entry_lines(benchmark: Benchmark, entries: Sequence[Entry], leaderboard_csv: str) -> list[Line]:
    """A line for every method, preset and settings of every entry: complete ones first, by LPIPS, then PSNR."""
    rows: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for row in csv.DictReader(io.StringIO(leaderboard_csv)):
        rows.setdefault((row["method"], row["preset"], row["settings_digest"], row["hardware"]), []).append(row)
    lines = []
    for entry in entries:
        groups: dict[tuple[str, str, str, str], list[Result]] = {}
        for result in entry.results.values():
            key = (result.method, result.preset, result.settings_digest, result.hardware_label)
            groups.setdefault(key, []).append(result)
        for key, results in sorted(groups.items()):
            lines.append(_line(benchmark, entry, results, rows.get(tuple(map(csv_text, key)), [])))
    return sorted(lines, key=_rank)


def _line(benchmark: Benchmark, entry: Entry, results: Sequence[Result], rows: Sequence[dict[str, str]]) -> Line:
    good = {row["scene"]: row for row in rows if row["status"] == "ok"}
    names = [scene.name for scene in benchmark.scenes]
    figures: dict[str, float | None] = {}
    for name in FIGURES:
        values = [_number(good.get(csv_text(scene), {}).get(name, "")) for scene in names]
        known = [value for value in values if value is not None]
        figures[name] = fmean(known) if len(known) == len(names) else None
    verdicts = {row.get("verified", "") for row in rows}
    first = results[0]
    return Line(
        entry=entry,
        method=first.method,
        preset=first.preset,
        scenes=len(set(good) & set(map(csv_text, names))),
        failed=sum(row["status"] != "ok" for row in rows),
        verified=one_line(", ".join(sorted(verdicts - {""})))[:_MAX_LINE] or "reported",
        figures=figures,
    )


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _rank(line: Line) -> tuple[Any, ...]:
    lpips, psnr = line.figures["lpips"], line.figures["psnr"]
    return (
        -line.scenes,
        math.inf if lpips is None else lpips,
        math.inf if psnr is None else -psnr,
        line.entry.name,
        line.method,
        line.preset,
    )


def front_page(benchmark: Benchmark, lines: Sequence[Line], left_out: Sequence[Entry], readable: bool) -> str:
    """index.html; the same bytes for the same entries. readable: whether there is a leaderboard to lead to."""
    count = len(benchmark.scenes)
    return render(
        Path(__file__).parent,
        "site.html.j2",
        title=one_line(benchmark.title),
        about=one_line(benchmark.about),
        header=[label(METRICS[name]) for name in FIGURES],
        lines=[
            {
                "facts": line.entry.facts,
                "name": line.entry.name,
                "method": one_line(line.method)[:_MAX_LINE],
                "preset": one_line(line.preset)[:_MAX_LINE],
                "scenes": f"{line.scenes} of {count}" + (f", {line.failed} failed" if line.failed else ""),
                "verified": line.verified,
                "figures": [_cell(name, line.figures[name]) for name in FIGURES],
            }
            for line in lines
        ],
        reported=[
            {"method": row["method"], "source": row["source"], "figures": [_reported(row, name) for name in FIGURES]}
            for row in paper_rows()
            if benchmark.paper and row["scene_set"] == benchmark.paper and "[" not in str(row["method"])
        ],
        left_out=[
            {"name": entry.name, "fault": one_line(fault)[:_MAX_LINE]}
            for entry in left_out
            for fault in _faults(entry)[:3]
        ][:_MAX_FAULTS],
        scenes=[scene.name for scene in benchmark.scenes],
        readable=readable,
        version=__version__,
    )


def _faults(entry: Entry) -> list[str]:
    """Its faults with places in the repository: where that lies on the machine that makes the page is nobody's."""
    return [fault.replace(str(entry.folder.parent), ENTRIES) for fault in entry.faults]


def _cell(name: str, value: float | None) -> str:
    return NO_FIGURE if value is None else shown(METRICS[name], value)


def _reported(row: dict[str, Any], name: str) -> str:
    value = row.get("train_minutes") if name == "fit_seconds" else row.get(name)
    if not isinstance(value, float):
        return NO_FIGURE
    return shown(METRICS[name], 60 * value if name == "fit_seconds" else value)


def site_facts(benchmark: Benchmark, lines: Sequence[Line], left_out: Sequence[Entry]) -> dict[str, Any]:
    """benchmark_site.json: the front page for programs."""
    return {
        "schema_version": 1,
        "title": benchmark.title,
        "scenes": [scene.name for scene in benchmark.scenes],
        "entries": [
            {
                "entry": line.entry.name,
                "method": line.method,
                "preset": line.preset,
                "scenes": line.scenes,
                "failed": line.failed,
                "verified": line.verified,
                "figures": line.figures,
            }
            for line in lines
        ],
        "left_out": {entry.name: _faults(entry) for entry in left_out},
    }

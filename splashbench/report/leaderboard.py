"""Results to a leaderboard: CSV for programs, Markdown for people.

A row is a method with its settings on one scene: the median over seeds with the spread (largest - smallest) beside it.
A run that failed keeps a row of its own with its status; nothing is dropped.
"""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from splashbench.files import write_text
from splashbench.report.results import Source, hardware_label, settings_digest
from splashbench.score.metrics import METRICS, TRUTH_METRICS, format_value
from splashbench.score.result import Result

_FIGURES = tuple(name for name in METRICS if name not in TRUTH_METRICS)
_SPREAD = tuple(name for name in _FIGURES if METRICS[name].group != "cost" or name == "fit_seconds")
CSV_COLUMNS = (
    *("method", "scene", "seed", "preset", "status", "reason"),
    *_FIGURES,
    *("control", "mixed", "runs"),
    *(f"{name}_spread" for name in _SPREAD),
    *("method_version", "settings_digest", "protocol", "scene_digest", "hardware"),
    *TRUTH_METRICS,
    *(f"{name}_spread" for name in TRUTH_METRICS),
)


@dataclass(frozen=True)
class Row:
    """One row: the runs of a method with its settings on a scene that ended alike."""

    runs: tuple[Result, ...]

    @property
    def first(self) -> Result:
        """Any of the runs: they share everything but seed and values."""
        return self.runs[0]

    @property
    def ok(self) -> bool:
        """Whether the row has a score."""
        return self.first.status == "ok"

    def value(self, name: str) -> float | None:
        """Median over the runs that have the metric."""
        values = self._values(name)
        return median(values) if values else None

    def spread(self, name: str) -> float | None:
        """Largest less smallest, where at least two runs have the metric."""
        values = self._values(name)
        return max(values) - min(values) if len(values) > 1 else None

    def _values(self, name: str) -> list[float]:
        return [value for run in self.runs if (value := run.value(name)) is not None]


def leaderboard_rows(sources: Sequence[Source]) -> list[Row]:
    """The rows, by scene, then protocol, then LPIPS (lower first), then PSNR (higher first); failures last."""
    groups: dict[tuple, list[Result]] = defaultdict(list)
    for source in sources:
        groups[_identity(source.result)].append(source.result)
    rows = [Row(tuple(sorted(runs, key=lambda run: (run.seed, run.digests.submission)))) for runs in groups.values()]
    return sorted(rows, key=_rank)


def table_of(row: Row) -> tuple[str, str, str]:
    """What rows must share to stand in one table: scene, its exact bytes, and protocol."""
    return (row.first.scene, row.first.digests.scene, row.first.protocol_label)


def _identity(result: Result) -> tuple:
    """What runs must share to be one row; failed runs never share one."""
    return (
        (result.scene, result.digests.scene, result.protocol_label),
        (result.method, result.preset, settings_digest(result), hardware_label(result.hardware)),
        "" if result.status == "ok" else result.digests.submission,
    )


def _rank(row: Row) -> tuple:
    lpips, psnr = row.value("lpips"), row.value("psnr")
    return (
        (*table_of(row), not row.ok),
        (lpips is None, lpips or 0.0, psnr is None, -(psnr or 0.0)),
        _identity(row.first),
    )


def to_csv(rows: Sequence[Row]) -> str:
    """The leaderboard as CSV; the bytes depend on nothing but the results."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for row in rows:
        run = row.first
        writer.writerow(
            [
                *(run.method, run.scene, _seeds(row), run.preset, run.status, run.reason),
                *(format_value(name, row.value(name)) for name in _FIGURES),
                *(str(run.control).lower(), str(run.mixed).lower(), len(row.runs)),
                *(format_value(name, row.spread(name)) for name in _SPREAD),
                *(run.method_version, settings_digest(run), run.protocol_label, run.digests.scene),
                hardware_label(run.hardware),
                *(format_value(name, row.value(name)) for name in TRUTH_METRICS),
                *(format_value(name, row.spread(name)) for name in TRUTH_METRICS),
            ]
        )
    return stream.getvalue()


def _seeds(row: Row) -> str:
    return " ".join(str(run.seed) for run in row.runs)


def write_leaderboard(sources: Sequence[Source], out: Path, with_paper: bool = False) -> list[Path]:
    """Write leaderboard.csv and leaderboard.md into the folder `out`; returns their paths.

    with_paper: below a scene's table in the Markdown, what the paper reports for that scene. The CSV never has it.
    """
    from splashbench.report.markdown import to_markdown

    rows = leaderboard_rows(sources)
    paths = [Path(out, "leaderboard.csv"), Path(out, "leaderboard.md")]
    for path, text in zip(paths, (to_csv(rows), to_markdown(rows, sources, with_paper))):
        write_text(path, text)
    return paths

"""A study's table as CSV and JSON, for programs; runs.csv has every run by itself."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

from splashbench.files import files_together, write_json, write_text
from splashbench.study.chart import draw_chart
from splashbench.study.markdown import to_markdown
from splashbench.study.spec import metric_of
from splashbench.study.table import NOT_RUN, Table


def write_report(table: Table, out: Path, command: str) -> list[Path]:
    """Write table.csv, runs.csv, table.json, table.md and the chart into `out`, all or none; returns their paths."""
    with files_together(out) as staging:
        write_text(staging / "table.csv", table_csv(table))
        write_text(staging / "runs.csv", runs_csv(table))
        write_json(staging / "table.json", as_json(table, command))
        write_text(staging / "table.md", to_markdown(table, command))
        made = ["table.md", "table.csv", "runs.csv", "table.json", *(path.name for path in draw_chart(table, staging))]
    return [Path(out, name) for name in made]


def table_csv(table: Table) -> str:
    """A row per variant: mean, standard deviation over seeds, difference to the baseline and its deviation.

    mixed: of a mixed method, whose filtered figures rest on the protocol's filter (docs/protocol.md).
    """
    metrics = table.plan.spec.metrics
    suffixes = ("", "_std", "_difference", "_difference_std")
    figures = [f"{name}{suffix}" for name in metrics for suffix in suffixes]
    lines = [["variant", "runs", "failed", "not_run", *figures, "mixed"]]
    for row in table.rows:
        line = [row.name, str(row.count("ok")), str(len(row.failed)), str(row.count(NOT_RUN))]
        for name in metrics:
            cell = row.cells[name]
            for value in (cell.mean, cell.std, cell.difference, cell.difference_std):
                line.append(_exact(value))
        lines.append([*line, str(row.mixed).lower()])
    return _csv(lines)


def runs_csv(table: Table) -> str:
    """A row per run. reused_seconds: of fit_seconds, what was spent in an earlier run of the study."""
    metrics = table.plan.spec.metrics
    lines = [
        ["scene", "variant", "seed", "status", "reason", *metrics, "reused_seconds", "runs_at_once", "digest", "mixed"]
    ]
    for run in table.runs:
        record = run.entry.record if run.entry else None
        reused = sum(record.reused.values()) if record and record.reused else None
        lines.append(
            [
                *(run.planned.scene.name, run.planned.variant.name, str(run.planned.seed), run.status, run.reason),
                *(_exact(run.values[name]) for name in metrics),
                *(_exact(reused), str(run.entry.at_once) if run.entry else "", run.planned.digest[:16]),
                str(run.result.mixed).lower() if run.result else "",
            ]
        )
    return _csv(lines)


def as_json(table: Table, command: str) -> dict[str, Any]:
    """The whole table. `paper` are figures as reported, of other scenes on another machine."""
    plan = table.plan
    return {
        "schema_version": 1,
        "study": plan.spec.name,
        "command": command,
        "spec": plan.spec.model_dump(mode="json"),
        "method": {"id": plan.method.id, "version": plan.method.version, "preset": plan.preset},
        "scenes": [{"name": named.name, "digest": named.scene.digest} for named in plan.scenes],
        "metrics": {
            name: {
                "title": metric_of(name).title,
                "unit": metric_of(name).unit,
                "better": metric_of(name).better,
                "filtered": metric_of(name).filtered,
                "scenes": list(table.scenes_of[name]),
            }
            for name in plan.spec.metrics
        },
        "rows": [
            {
                "variant": row.name,
                "control": row.control,
                "mixed": row.mixed,
                "ok": row.count("ok"),
                "failed": len(row.failed),
                "not_run": row.count(NOT_RUN),
                "figures": {name: vars(cell) for name, cell in row.cells.items()},
                "paper": dict(row.paper),
            }
            for row in table.rows
        ],
    }


def _exact(value: float | None) -> str:
    return "" if value is None else f"{value:.9g}"


def _csv(lines: list[list[str]]) -> str:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(lines)
    return stream.getvalue()

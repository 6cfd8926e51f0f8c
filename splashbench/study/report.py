"""A study's files: Markdown and a chart for people, CSV and JSON for programs; runs.csv has every run by itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd

from splashbench.csv_cells import csv_text
from splashbench.files import files_together, write_json, write_text
from splashbench.study.chart import draw_chart
from splashbench.study.spec import metric_of
from splashbench.study.table import NOT_RUN, Table
from splashbench.study.table_markdown import to_markdown


def write_report(table: Table, out: Path, command: str) -> list[Path]:
    """Write table.csv, runs.csv, table.json, table.md and the chart into `out`, all or none; returns their paths."""
    with files_together(out) as staging:
        write_text(staging / "table.csv", table_csv(table))
        write_text(staging / "runs.csv", runs_csv(table))
        write_json(staging / "table.json", as_json(table, command))
        write_text(staging / "table.md", to_markdown(table, command))
        names = ["table.md", "table.csv", "runs.csv", "table.json", *(path.name for path in draw_chart(table, staging))]
    return [Path(out, name) for name in names]


def table_csv(table: Table) -> str:
    """A row per variant: mean, standard deviation over seeds, difference to the baseline and its deviation.

    mixed: of a mixed method, whose filtered figures rest on the protocol's filter (docs/protocol.md).
    """
    counts = pd.DataFrame(
        [
            {"variant": row.name, "runs": row.count("ok"), "failed": len(row.failed), "not_run": row.count(NOT_RUN)}
            for row in table.rows
        ]
    )
    mixed = {row.name: str(row.mixed).lower() for row in table.rows}
    return frame_csv(counts.join(table.figures, on="variant").assign(mixed=counts["variant"].map(mixed)))


def runs_csv(table: Table) -> str:
    """A row per run; see `Table.run_frame`."""
    return frame_csv(table.run_frame)


def frame_csv(frame: pd.DataFrame) -> str:
    """`frame` as CSV, nine digits of each number; no text in it is a formula."""
    frame = frame.map(lambda cell: csv_text(cell) if isinstance(cell, str) else cell)
    return str(frame.to_csv(index=False, float_format="%.9g", lineterminator="\n"))


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

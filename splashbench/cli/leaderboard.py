"""`splashbench leaderboard RESULTS OUT`: make a page, tables and charts from a folder of results."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say

if TYPE_CHECKING:
    import pandas as pd

    from splashbench.report.results import ResultFile

#: Of all pictures in the page together; some 400 rows have theirs.
_MAX_SHEETS_BYTES = 32 << 20
_EPILOG = """\
examples:
  splashbench leaderboard results leaderboard
  splashbench leaderboard results leaderboard --with-paper       the paper's figures in panels and tables of their own

OUT gets index.html, a page that needs no network, with leaderboard.csv, leaderboard.md, speed_accuracy.png and
speed_accuracy.svg. Failed runs keep their rows, and runs on different machines never share a chart. The same results
give the same bytes. Where OUT has a leaderboard already, the command says which figures changed. Quality over time
needs runs made with `splashbench run --checkpoints`, and the control `nothing` for what a run shows before its first.
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = add_command(
        subparsers,
        "leaderboard",
        run,
        summary="make a page, tables and charts from results",
        description="Make a leaderboard (HTML, CSV, Markdown) and the speed-accuracy chart (PNG, SVG) from results.",
        epilog=_EPILOG,
    )
    parser.add_argument("results", type=Path, metavar="RESULTS", help="folder with results, from `splashbench score`")
    parser.add_argument("out", type=Path, metavar="OUT", help="folder the leaderboard is written into")
    parser.add_argument("--with-paper", action="store_true", help="add the paper's figures, as reported")


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench leaderboard`."""
    from splashbench.files import files_together, write_text
    from splashbench.report.changes import changes, shortened
    from splashbench.report.charts import speed_accuracy_chart
    from splashbench.report.leaderboard import write_leaderboard
    from splashbench.report.page import PAGE, leaderboard_page
    from splashbench.report.results import load_results
    from splashbench.report.table import leaderboard_table, to_csv

    sources = load_results(arguments.results)
    table = leaderboard_table(sources)
    before = _text(arguments.out / "leaderboard.csv")
    # All files or none: a table without its chart would look complete.
    with files_together(arguments.out) as staging:
        paths = write_leaderboard(table, sources, staging, with_paper=arguments.with_paper)
        paths += speed_accuracy_chart(sources, staging, with_paper=arguments.with_paper)
        page = staging / PAGE
        write_text(page, leaderboard_page(table, sources, arguments.with_paper, _sheets(table, sources, arguments)))
        paths.insert(0, page)
    files = [arguments.out / path.name for path in paths]
    changed = [] if before is None else changes(before, to_csv(table))
    failed = int(table["failed"].sum())
    say(f"{len(sources)} results, {len(table)} rows{f', {failed} of them failed runs' if failed else ''}")
    for file in files:
        say(f"wrote {file}")
    if before is not None:
        say("\n".join(shortened(changed)) if changed else "no figure differs from those of the leaderboard before")
    if arguments.json:
        emit(
            {
                "results": len(sources),
                "rows": len(table),
                "failed_runs": failed,
                "files": [str(file) for file in files],
                "changes": changed,
                "sources": [source.path for source in sources],
            }
        )
    return 0


def _text(path: Path) -> str | None:
    """What the file `path` says; None where there is none that can be read."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return None


def _sheets(table: pd.DataFrame, sources: Sequence[ResultFile], arguments: argparse.Namespace) -> dict[str, str]:
    """The pictures of each row's first run, embedded, by the path of its result's file, as far as there is room."""
    from splashbench.report.result_sheet import embedded_sheet

    root = arguments.results.parent if arguments.results.is_file() else arguments.results
    paths = {id(source.result): source.path for source in sources}
    sheets: dict[str, str] = {}
    room = _MAX_SHEETS_BYTES
    for results in table["results"]:
        path = paths[id(results[0])]
        sheet = embedded_sheet(root / path)
        if sheet is not None and len(sheet) <= room:
            sheets[path] = sheet
            room -= len(sheet)
    return sheets

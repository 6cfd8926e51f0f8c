"""`splashbench leaderboard RESULTS OUT`: make tables and charts from a folder of results."""

from __future__ import annotations

import argparse
from pathlib import Path

from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say

_EPILOG = """\
examples:
  splashbench leaderboard results leaderboard
  splashbench leaderboard results leaderboard --with-paper       the paper's figures in panels and tables of their own

OUT gets leaderboard.csv, leaderboard.md, speed_accuracy.png and speed_accuracy.svg. Failed runs keep their rows, and
runs on different machines never share a chart. The same results give the same bytes.
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = add_command(
        subparsers,
        "leaderboard",
        run,
        summary="make tables and charts from results",
        description="Make a leaderboard (CSV, Markdown) and the speed-accuracy chart (PNG, SVG) from results.",
        epilog=_EPILOG,
    )
    parser.add_argument("results", type=Path, metavar="RESULTS", help="folder with results, from `splashbench score`")
    parser.add_argument("out", type=Path, metavar="OUT", help="folder the leaderboard is written into")
    parser.add_argument("--with-paper", action="store_true", help="add the paper's figures, as reported")


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench leaderboard`."""
    from splashbench.files import files_together
    from splashbench.report.charts import speed_accuracy_chart
    from splashbench.report.leaderboard import write_leaderboard
    from splashbench.report.results import load_results
    from splashbench.report.table import leaderboard_table

    sources = load_results(arguments.results)
    table = leaderboard_table(sources)
    # All four files or none: a table without its chart would look complete.
    with files_together(arguments.out) as staging:
        paths = write_leaderboard(table, sources, staging, with_paper=arguments.with_paper)
        paths += speed_accuracy_chart(sources, staging, with_paper=arguments.with_paper)
    files = [arguments.out / path.name for path in paths]
    failed = int(table["failed"].sum())
    say(f"{len(sources)} results, {len(table)} rows{f', {failed} of them failed runs' if failed else ''}")
    for file in files:
        say(f"wrote {file}")
    if arguments.json:
        emit(
            {
                "results": len(sources),
                "rows": len(table),
                "failed_runs": failed,
                "files": [str(file) for file in files],
                "sources": [source.path for source in sources],
            }
        )
    return 0

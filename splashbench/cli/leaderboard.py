"""`splashbench leaderboard RESULTS OUT`: make a page, tables and charts from a folder of results."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splashbench.cli.arguments import add_lpips_weights
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say

if TYPE_CHECKING:
    import pandas as pd

    from splashbench.report.results import ResultFile
    from splashbench.score import Result
    from splashbench.score.verification import Verification

#: Of all pictures in the page together; some 400 rows have theirs.
_MAX_SHEETS_BYTES = 32 << 20
# Of an earlier leaderboard's table, which is compared with the new one.
_MAX_TABLE_BYTES = 64 << 20
_EPILOG = """\
examples:
  splashbench leaderboard results leaderboard
  splashbench leaderboard results leaderboard --with-paper       the paper's figures in panels and tables of their own
  splashbench leaderboard results leaderboard --verify --submissions submissions --scenes scenes

OUT gets index.html, a page that needs no network, with leaderboard.csv, leaderboard.md, speed_accuracy.png and
speed_accuracy.svg. Failed runs keep their rows, and runs on different machines never share a chart. The same results
give the same bytes. A file that is no result, or that states what no run has, is named and left out; the others stand.
--verify scores every submission again: the tables then have the verified figures, and claimed ones that differ behind
them. Where OUT has a leaderboard already, the command says which figures changed. Quality over time needs runs made
with `splashbench run --checkpoints`, and the control `nothing` for what a run shows before its first.
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
    verify = parser.add_argument_group("scoring again what the results claim")
    verify.add_argument("--verify", action="store_true", help="score the submission of each result again")
    for name, what in (("submissions", "submissions, besides those beside the results"), ("scenes", "scenes")):
        verify.add_argument(
            f"--{name}", type=Path, nargs="+", default=[], metavar="FOLDER", help=f"{what}: one, or a folder of some"
        )
    add_lpips_weights(verify)


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench leaderboard`."""
    from splashbench.files import files_together, require_unsealed_place, write_text
    from splashbench.report.changes import changes, shortened
    from splashbench.report.charts import speed_accuracy_chart
    from splashbench.report.leaderboard import write_leaderboard
    from splashbench.report.page import PAGE, leaderboard_page
    from splashbench.report.results import read_results
    from splashbench.report.table import leaderboard_table, to_csv

    require_unsealed_place(arguments.out)
    reading = read_results(arguments.results, _verifier(arguments))
    sources, left_out = reading.sources, reading.left_out
    table = leaderboard_table(sources)
    before = _text(arguments.out / "leaderboard.csv")
    # All files or none: a table without its chart would look complete.
    with files_together(arguments.out) as staging:
        paths = write_leaderboard(table, sources, staging, arguments.with_paper, left_out)
        paths += speed_accuracy_chart(sources, staging, with_paper=arguments.with_paper)
        page = staging / PAGE
        sheets = _sheets(table, sources, arguments)
        write_text(page, leaderboard_page(table, sources, arguments.with_paper, sheets, left_out))
        paths.insert(0, page)
    files = [arguments.out / path.name for path in paths]
    changed = [] if before is None else changes(before, to_csv(table))
    failed = int(table["failed"].sum())
    say(f"{len(sources)} results, {len(table)} rows{f', {failed} of them failed runs' if failed else ''}")
    for line in shortened(f"warning: {each.path} is left out: {each.reason}" for each in left_out):
        say(line)
    for line in shortened(_verdicts(sources) if arguments.verify else ()):
        say(line)
    if arguments.with_paper:
        _tell_of_paper(sources)
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
                "left_out": [{"file": each.path, "reason": each.reason} for each in left_out],
                "files": [str(file) for file in files],
                "changes": changed,
                "sources": [source.path for source in sources],
                **({"verified": _verified(sources)} if arguments.verify else {}),
            }
        )
    return 0


def _verifier(arguments: argparse.Namespace) -> Callable[[Result, Path], Verification] | None:
    """What scores a result's submission again, where that is asked for."""
    from splashbench.errors import SplashbenchError
    from splashbench.score.verification import Evidence

    if not arguments.verify:
        if arguments.submissions or arguments.scenes or arguments.lpips_weights:
            arguments.usage_error("--submissions, --scenes and --lpips-weights are for --verify; add it")
        return None
    if not arguments.scenes:
        arguments.usage_error("--verify needs the scenes to score against: --scenes FOLDER")
    for place in (*arguments.submissions, *arguments.scenes):
        if not place.is_dir():
            raise SplashbenchError(f"{place} is not a folder; give one of submissions or scenes")
    evidence = Evidence(arguments.submissions, arguments.scenes, arguments.lpips_weights)

    def verify(result: Result, beside: Path) -> Verification:
        say(f"scoring again: {result.method} on {result.scene}, seed {result.seed}")
        return evidence.verify(result, beside)

    return verify


def _verdicts(sources: Sequence[ResultFile]) -> Iterator[str]:
    """A line for every result that scoring again did not confirm, and how many it did."""
    from splashbench.report.results import shown_differences

    found = [(source, source.verification) for source in sources if source.verification is not None]
    confirmed = sum(verification.verdict == "confirmed" for _, verification in found)
    yield f"verified: {confirmed} of {len(found)} results are what their submissions give"
    for source, verification in found:
        if verification.verdict == "differs":
            yield f"warning: {source.path} states otherwise: {shown_differences(verification.differences)}"
        elif verification.verdict == "not verified":
            yield f"warning: {source.path} is not verified: {verification.reason}"


def _verified(sources: Sequence[ResultFile]) -> list[dict[str, Any]]:
    from splashbench.cli.verification import verification_facts

    return [verification_facts(source.path, source.verification) for source in sources if source.verification]


def _tell_of_paper(sources: Sequence[ResultFile]) -> None:
    """Say where the paper's figures stand: of most scenes it prints none, and then no table has any."""
    from splashbench.report.reported import has_reported_figures

    scenes = {source.result.scene for source in sources}
    shown = sorted(scene for scene in scenes if has_reported_figures(scene))
    if not shown:
        say(
            "--with-paper adds nothing to the tables: the paper prints no figures of these scenes one by one; its "
            "means over its own scenes are in the chart and on the page"
        )


def _text(path: Path) -> str | None:
    """What the file `path` says; None where there is none that can be read."""
    from splashbench.errors import SplashbenchError
    from splashbench.files import read_plain

    try:
        return read_plain(path, _MAX_TABLE_BYTES).decode("utf-8")
    except (SplashbenchError, OSError, UnicodeDecodeError):
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

"""`splashbench study run SPEC OUT`: a table of runs that shows what a part of a method or of its input is worth."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from splashbench.cli.arguments import add_lpips_weights, add_settings, whole_number
from splashbench.cli.command import add_command, add_group
from splashbench.cli.output import emit, say

_EPILOG = """\
examples:
  splashbench study run ablation OUT --scenes scenes/bowl_001 scenes/bowl_002
  splashbench study run masks OUT --scenes SCENE --seeds 0 1 2 --set iterations=300
  splashbench study run my_study.toml OUT --jobs 2
  splashbench study run ablation OUT --scenes SCENE --only per_frame      one row; the others stay as they are

SPEC is a TOML file, or one of: ablation, baselines, best, interpolation, masks, sensitivity, views
(docs/study.md). OUT gets table.md, table.csv, runs.csv, table.json, chart.png and chart.svg. The same command again
continues where it stopped. Failed runs have rows of their own.
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    actions = add_group(
        subparsers,
        "study",
        summary="many runs in one table: ablations, worse masks, fewer views",
        description="Run variants of a method on several scenes and seeds, and tabulate them.",
        epilog=_EPILOG,
    )
    parser = add_command(
        actions,
        "run",
        run,
        summary="run, score and tabulate variants",
        description="Run every variant of SPEC on every scene with every seed, score the runs, and tabulate them.",
        epilog=_EPILOG,
    )
    parser.add_argument("spec", metavar="SPEC", help="a TOML file, or the name of a study that is shipped")
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the study; finished runs in it are reused")
    parser.add_argument(
        "--scenes",
        nargs="+",
        action="extend",
        default=[],
        metavar="SCENE",
        help="folders of scenes, in place of the spec's",
    )
    parser.add_argument(
        "--seeds",
        nargs="+",
        action="extend",
        type=whole_number(0),
        default=[],
        metavar="SEED",
        help="seeds, in place of the spec's",
    )
    add_settings(parser, "a setting of every row, such as the number of iterations; overrides the spec's", dest="base")
    parser.add_argument("--only", nargs="+", action="extend", metavar="VARIANT", help="run these variants only")
    parser.add_argument(
        "--jobs", type=whole_number(1), default=1, metavar="N", help="runs at the same time (default: 1)"
    )
    parser.add_argument("--retry", action="store_true", help="repeat failed runs")
    parser.add_argument("--keep", action="store_true", help="keep every submission, with renders and model")
    add_lpips_weights(parser)


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench study run`."""
    from splashbench.harness.runner import parse_overrides
    from splashbench.study.execution import ExecutionOptions, carry_out_plan
    from splashbench.study.job import Store
    from splashbench.study.plan import make_plan
    from splashbench.study.report import as_json, write_report
    from splashbench.study.spec import load_spec
    from splashbench.study.table import make_table

    spec = load_spec(
        arguments.spec, scenes=arguments.scenes, seeds=arguments.seeds, base=parse_overrides(arguments.base)
    )
    for name in arguments.only or []:
        spec.variant(name)
    plan = make_plan(spec)
    options = ExecutionOptions(
        only=tuple(arguments.only) if arguments.only else None,
        jobs=arguments.jobs,
        keep=arguments.keep,
        retry=arguments.retry,
        lpips_weights=arguments.lpips_weights,
        tell=say,
    )
    tally = carry_out_plan(plan, arguments.out, options)
    table = make_table(plan, Store(arguments.out))
    command = _command(arguments)
    files = write_report(table, arguments.out, command)
    failed = len(table.failed)
    reused = f", {tally.reused} reused" if tally.reused else ""
    say(f"{tally.made} runs made{reused}; {len(table.rows)} rows, {failed} failed runs")
    for file in files:
        say(f"wrote {file}")
    if arguments.json:
        emit(
            {"out": str(arguments.out), "made": tally.made, "kept": tally.reused, "failed": failed}
            | {"files": [str(file) for file in files], "table": as_json(table, command)}
        )
    return 0


def _command(arguments: argparse.Namespace) -> str:
    """The command line that makes this table again."""
    words = ["splashbench", "study", "run", arguments.spec, str(arguments.out)]
    for flag, values in (("--scenes", arguments.scenes), ("--seeds", arguments.seeds)):
        words += [flag, *map(str, values)] if values else []
    for pair in arguments.base:
        words += ["--set", pair]
    return shlex.join(words)

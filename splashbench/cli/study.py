"""`splashbench study ablate SPEC OUT`: a table of runs, what each part of a method or each doubtful input is worth."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from splashbench.cli.output import add_json, emit, say

_EPILOG = """\
examples:
  splashbench study ablate ablation OUT --scenes scenes/bowl_001 scenes/bowl_002
  splashbench study ablate masks OUT --scenes SCENE --seeds 0 1 2 --set iterations=300
  splashbench study ablate my_study.toml OUT --jobs 2
  splashbench study ablate ablation OUT --scenes SCENE --only per_frame      one row; the others stay as they are

SPEC is a TOML file, or one of: ablation, baselines, best, interpolation, masks, sensitivity, views
(docs/study.md). OUT gets table.md, table.csv, runs.csv, table.json, chart.png and chart.svg. The same command again
goes on where it stopped. Failed runs are rows.
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = subparsers.add_parser(
        "study",
        help="many runs in one table: ablations, worse masks, fewer views",
        description="Run variants of a method on several scenes and seeds, and tabulate them.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = parser.add_subparsers(dest="action", metavar="ablate", required=True)
    ablate = actions.add_parser(
        "ablate",
        help="run, score and tabulate variants",
        description="Run every variant of SPEC on every scene with every seed, score the runs, and tabulate them.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    ablate.add_argument("spec", metavar="SPEC", help="a TOML file, or the name of a study that is shipped")
    ablate.add_argument("out", type=Path, metavar="OUT", help="folder of the study; runs that are in it are kept")
    ablate.add_argument(
        "--scenes", nargs="+", action="extend", default=[], metavar="SCENE", help="folders of scenes, for the spec's"
    )
    ablate.add_argument(
        "--seeds", nargs="+", action="extend", type=_not_negative, default=[], metavar="SEED", help="for the spec's"
    )
    ablate.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="base",
        help="a setting of every row, as the budget of iterations is; on top of the spec's",
    )
    ablate.add_argument("--only", nargs="+", action="extend", metavar="VARIANT", help="run these variants only")
    ablate.add_argument("--jobs", type=_positive, default=1, metavar="N", help="runs at once (default 1)")
    ablate.add_argument("--retry", action="store_true", help="run again what failed")
    ablate.add_argument("--keep", action="store_true", help="keep every submission, with renders and model")
    ablate.add_argument("--lpips-weights", type=Path, metavar="FILE", help=".npz of LPIPS weights (AlexNet, v0.1)")
    add_json(ablate)
    ablate.set_defaults(handler=run)


def _not_negative(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 0 or more")
    return int(text)


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 1 or more")
    return int(text)


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench study ablate`."""
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
    failed = sum(len(row.failed) for row in table.rows)
    kept = f", {tally.kept} were there" if tally.kept else ""
    say(f"{tally.made} runs made{kept}; {len(table.rows)} rows, {failed} failed runs")
    for file in files:
        say(f"wrote {file}")
    if arguments.json:
        emit(
            {"out": str(arguments.out), "made": tally.made, "kept": tally.kept, "failed": failed}
            | {"files": [str(file) for file in files], "table": as_json(table, command)}
        )
    return 0


def _command(arguments: argparse.Namespace) -> str:
    """The command that makes this table from nothing."""
    words = ["splashbench", "study", "ablate", arguments.spec, str(arguments.out)]
    for flag, values in (("--scenes", arguments.scenes), ("--seeds", arguments.seeds)):
        words += [flag, *map(str, values)] if values else []
    for pair in arguments.base:
        words += ["--set", pair]
    return shlex.join(words)

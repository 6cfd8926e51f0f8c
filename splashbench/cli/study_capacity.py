"""`splashbench study capacity METHOD OUT`: how good a method becomes as it grows, its knee, and what lies beyond it."""

from __future__ import annotations

import argparse
import shlex

from splashbench.cli.arguments import (
    add_lpips_weights,
    add_method,
    add_seeds,
    add_settings,
    add_study_out,
    add_study_runs,
)
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say
from splashbench.cli.study_machines import add_machines, machine_options

_EPILOG = """\
examples:
  splashbench study capacity hull_points OUT --scenes scenes/bowl_001
  splashbench study capacity spacetime_gaussians OUT --scenes SCENE --preset quick --ladder iterations=500,1000,2000
  splashbench study capacity my.py:Mine OUT --scenes SCENE --ladder points=1000,4000,16000 --ladder cells=32,64,128
  splashbench study capacity splashsplat OUT --scenes A B --seeds 0 1 --budget 120
  splashbench study capacity splashsplat OUT --scenes A B --on ray --cores 4

Several --ladder are climbed together, and need as many values each. OUT gets capacity.md with a chart, and
capacity.csv with a row per rung, scene and seed. Some training views are scored besides: where they rise while test
views fall, the method overfits. The same command again continues where it stopped (docs/study.md).
"""


def register(actions: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = add_command(
        actions,
        "capacity",
        run,
        summary="rate against quality of one method, and its knee",
        description=(
            "Run a method on every rung of a ladder of settings, from small to large, and tell where more size and\n"
            "time no longer pay, and whether what lies beyond is overfitting."
        ),
        epilog=_EPILOG,
    )
    add_method(parser)
    add_study_out(parser)
    parser.add_argument(
        "--scenes", nargs="+", action="extend", required=True, metavar="SCENE", help="folders of scenes"
    )
    parser.add_argument("--preset", help="preset that rungs are on top of (default: the method's first)")
    parser.add_argument(
        "--ladder",
        action="append",
        default=[],
        metavar="SETTING=V1,V2,...",
        help="a setting's value on every rung, from the smallest model to the largest (default: the method's ladder)",
    )
    add_settings(parser, "a setting of every rung", dest="base")
    add_seeds(parser, "of the method (default: 0)")
    add_study_runs(parser, "has no figures", "the smallest rungs first")
    add_lpips_weights(parser)
    add_machines(parser)


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench study capacity`."""
    from splashbench.harness.runner import parse_overrides
    from splashbench.study.capacity import make_capacity_plan, smallest_first
    from splashbench.study.capacity_report import find_knees, knee_text, write_capacity_report
    from splashbench.study.execution import ExecutionOptions, carry_out_plan, gpu_elsewhere
    from splashbench.study.job import Store
    from splashbench.study.spending import StudyBudget

    capacity = make_capacity_plan(
        arguments.method,
        arguments.scenes,
        preset=arguments.preset,
        ladder=arguments.ladder,
        base=parse_overrides(arguments.base),
        seeds=list(dict.fromkeys(arguments.seeds)) or [0],
        timeout_seconds=60 * arguments.timeout if arguments.timeout else None,
        device=arguments.device,
        gpu_elsewhere=gpu_elsewhere(arguments.on, arguments.device),
    )
    plan, store = capacity.plan, Store(arguments.out)
    say(
        f"{len(plan.runs)} runs: {capacity.ladder.height} rungs, {len(plan.scenes)} scenes, "
        f"{len(plan.spec.seeds)} seeds"
    )
    options = ExecutionOptions(
        **machine_options(arguments),
        retry=arguments.retry,
        lpips_weights=arguments.lpips_weights,
        tell=say,
        training=True,
    )
    if arguments.budget:
        options.order = smallest_first(capacity, store, StudyBudget(60 * arguments.budget))
    tally = carry_out_plan(plan, arguments.out, options)
    files = write_capacity_report(capacity, store, arguments.out, _command(arguments))
    knees = find_knees(capacity, store)
    say(f"{tally.made} runs made" + (f", {tally.reused} reused" if tally.reused else ""))
    for name, knee in knees.items():
        say(f"{name}: {knee_text(capacity, knee)}")
    for file in files:
        say(f"wrote {file}")
    if arguments.json:
        emit(
            {
                "out": str(arguments.out),
                "made": tally.made,
                "kept": tally.reused,
                "knees": {
                    name: {
                        "rung": knee.rung,
                        "settings": capacity.ladder.row(knee.rung) if knee.rung else None,
                        "still_rising": knee.rising,
                        "bend_bytes": knee.bend_bytes,
                        "bend_seconds": knee.bend_seconds,
                        "beyond": knee.beyond,
                    }
                    for name, knee in knees.items()
                },
                "files": [str(file) for file in files],
            }
        )
    return 0


def _command(arguments: argparse.Namespace) -> str:
    """The command line that makes this report again."""
    words = ["splashbench", "study", "capacity", arguments.method, str(arguments.out)]
    words += ["--scenes", *arguments.scenes]
    words += ["--preset", arguments.preset] if arguments.preset else []
    for flag, values in (("--ladder", arguments.ladder), ("--set", arguments.base)):
        for value in values:
            words += [flag, value]
    words += ["--seeds", *map(str, arguments.seeds)] if arguments.seeds else []
    words += ["--timeout", f"{arguments.timeout:g}"] if arguments.timeout else []
    words += ["--budget", f"{arguments.budget:g}"] if arguments.budget else []
    words += ["--device", arguments.device] if arguments.device != "auto" else []
    return shlex.join(words)

"""`splashbench study run SPEC OUT`: a table of runs that shows what a part of a method or of its input is worth.

`splashbench study stress OUT`: what methods keep where recordings are worse.
`splashbench study capacity METHOD OUT` is in study_capacity.py.
"""

from __future__ import annotations

import argparse
import shlex

from splashbench.cli import study_capacity
from splashbench.cli.arguments import (
    add_lpips_weights,
    add_methods,
    add_seeds,
    add_settings,
    add_study_out,
    add_study_runs,
    whole_number,
)
from splashbench.cli.command import add_command, add_group
from splashbench.cli.output import emit, say
from splashbench.cli.study_machines import add_machines, machine_options

_EPILOG = """\
examples:
  splashbench study run ablation OUT --scenes scenes/bowl_001 scenes/bowl_002
  splashbench study run masks OUT --scenes SCENE --seeds 0 1 2 --set iterations=300
  splashbench study run my_study.toml OUT --jobs 2
  splashbench study run my_study.toml OUT --on ray --cores 2    on all machines of a Ray cluster
  splashbench study run ablation OUT --scenes SCENE --only per_frame      one row; the others stay as they are

SPEC is a TOML file, or one of: ablation, baselines, best, interpolation, masks, sensitivity, views
(docs/study.md). OUT gets table.md, table.csv, runs.csv, table.json, chart.png and chart.svg. The same command again
continues where it stopped. Failed runs have rows of their own.
"""

_STRESS_EPILOG = """\
examples:
  splashbench study stress OUT --methods splashsplat:quick spacetime_gaussians --scenes scenes/bowl_001
  splashbench study stress OUT --methods my.py:Mine --scenes SCENE --severities 1 3 5 --kinds pose_rotation exposure
  splashbench study stress OUT --methods splashsplat --scenes SCENE --seeds 0 1 2 --jobs 2
  splashbench study stress OUT --methods splashsplat --scenes SCENE --on ray://head:6379 --memory 8
  splashbench study stress OUT --methods splashsplat --scenes DENSE --every 4     clocks off by part of a timestep

Training views alone are made worse; test views stay. OUT gets stability.md with a chart, and stability.csv,
breakdown.csv and retention.csv. The same command again continues where it stopped. A run that fails keeps nothing.
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
    add_study_out(parser)
    parser.add_argument(
        "--scenes",
        nargs="+",
        action="extend",
        default=[],
        metavar="SCENE",
        help="folders of scenes, in place of the spec's",
    )
    add_seeds(parser, "in place of the spec's")
    add_settings(parser, "a setting of every row, such as the number of iterations; overrides the spec's", dest="base")
    parser.add_argument("--only", nargs="+", action="extend", metavar="VARIANT", help="run these variants only")
    parser.add_argument("--retry", action="store_true", help="repeat failed runs")
    parser.add_argument("--keep", action="store_true", help="keep every submission, with renders and model")
    add_lpips_weights(parser)
    add_machines(parser)

    _register_stress(actions)
    study_capacity.register(actions)


def _register_stress(actions: argparse._SubParsersAction) -> None:
    parser = add_command(
        actions,
        "stress",
        stress,
        summary="make recordings worse, and see where methods break",
        description=(
            "Run methods on scenes whose training views were made worse in every way, at five severities each,\n"
            "and tell what they keep: stability S, CVaR10 and the points at which they break."
        ),
        epilog=_STRESS_EPILOG,
    )
    add_study_out(parser)
    add_methods(parser, "; the preset is a method's first by default", required=True)
    parser.add_argument(
        "--scenes", nargs="+", action="extend", required=True, metavar="SCENE", help="folders of scenes"
    )
    parser.add_argument(
        "--kinds",
        nargs="+",
        action="extend",
        default=[],
        metavar="KIND",
        help="what is made worse, such as clock_offset or exposure (docs/study.md has all; default: every kind)",
    )
    parser.add_argument(
        "--severities",
        nargs="+",
        action="extend",
        type=whole_number(1, 5),
        default=[],
        metavar="1-5",
        help="which of the five (default: all)",
    )
    add_seeds(parser, "of methods and of what is drawn (default: 0)")
    parser.add_argument(
        "--every",
        type=whole_number(1),
        default=1,
        metavar="K",
        help="use each K-th timestep of the scenes; the frames between serve harm in milliseconds (default: 1)",
    )
    add_study_runs(parser, "keeps nothing", "those first that say the most about where methods break")
    add_lpips_weights(parser)
    add_machines(parser)


def stress(arguments: argparse.Namespace) -> int:
    """Handle `splashbench study stress`."""
    from splashbench.scene import Scene
    from splashbench.study.execution import ExecutionOptions, carry_out_plan, claimed, gpu_elsewhere
    from splashbench.study.job import Store
    from splashbench.study.spending import StudyBudget, by_uncertainty
    from splashbench.study.stress import make_stress_plan
    from splashbench.study.stress_report import write_stress_report
    from splashbench.study.thinning import thinned

    store = Store(arguments.out)

    def thin(scene: Scene) -> Scene:
        if arguments.every == 1:
            return scene
        with claimed(store):
            return thinned(scene, arguments.every, store.cache / "thinned")

    planned = make_stress_plan(
        arguments.methods,
        arguments.scenes,
        kinds=arguments.kinds,
        levels=arguments.severities or (1, 2, 3, 4, 5),
        seeds=list(dict.fromkeys(arguments.seeds)) or [0],
        timeout_seconds=60 * arguments.timeout if arguments.timeout else None,
        device=arguments.device,
        gpu_elsewhere=gpu_elsewhere(arguments.on, arguments.device),
        thin=thin,
    )
    for harm, reason in planned.left_out:
        say(f"left out: {harm.kind.named()} {harm.amount:g} {harm.kind.unit}: {reason}")
    say(
        f"{len(planned.plan.runs)} runs: {len(planned.methods)} methods, {len(planned.harms)} harms and none, "
        f"{len(planned.plan.scenes)} scenes, {len(planned.plan.spec.seeds)} seeds"
    )
    options = ExecutionOptions(
        **machine_options(arguments),
        retry=arguments.retry,
        lpips_weights=arguments.lpips_weights,
        tell=say,
        pictures=True,
    )
    if arguments.budget:
        options.order = by_uncertainty(planned, store, StudyBudget(60 * arguments.budget))
    tally = carry_out_plan(planned.plan, arguments.out, options)
    files = write_stress_report(planned, store, arguments.out, _stress_command(arguments))
    say(f"{tally.made} runs made" + (f", {tally.reused} reused" if tally.reused else ""))
    for file in files:
        say(f"wrote {file}")
    if arguments.json:
        emit(
            {
                "out": str(arguments.out),
                "made": tally.made,
                "kept": tally.reused,
                "left_out": [f"{harm.kind.named()} {harm.amount:g}" for harm, _ in planned.left_out],
                "files": [str(file) for file in files],
            }
        )
    return 0


def _stress_command(arguments: argparse.Namespace) -> str:
    words = ["splashbench", "study", "stress", str(arguments.out)]
    for flag in ("methods", "scenes", "kinds", "severities", "seeds"):
        values = getattr(arguments, flag)
        words += [f"--{flag}", *map(str, values)] if values else []
    words += ["--every", str(arguments.every)] if arguments.every > 1 else []
    words += ["--timeout", f"{arguments.timeout:g}"] if arguments.timeout else []
    words += ["--budget", f"{arguments.budget:g}"] if arguments.budget else []
    words += ["--device", arguments.device] if arguments.device != "auto" else []
    return shlex.join(words)


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench study run`."""
    from splashbench.harness.runner import parse_overrides
    from splashbench.study.execution import ExecutionOptions, carry_out_plan, gpu_elsewhere
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
    plan = make_plan(spec, gpu_elsewhere(arguments.on, spec.device))
    options = ExecutionOptions(
        only=tuple(arguments.only) if arguments.only else None,
        **machine_options(arguments),
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

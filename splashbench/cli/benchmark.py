"""`splashbench benchmark`: methods on the real scenes with an estimate before, and a public leaderboard in a folder."""

from __future__ import annotations

import argparse
import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from splashbench.cli import benchmark_site
from splashbench.cli.arguments import add_lpips_weights, add_methods, add_run_timeout, add_seeds, add_study_out
from splashbench.cli.command import add_command, add_group
from splashbench.cli.output import emit, say
from splashbench.cli.study_machines import add_machines, machine_options

if TYPE_CHECKING:
    from splashbench.benchmark.budgets import Entrant
    from splashbench.benchmark.estimate import Estimate
    from splashbench.study.job import Store
    from splashbench.study.plan import StudyPlan

_RUN_EXAMPLES = """\
  splashbench benchmark run OUT --scenes REAL --dry-run                 how long it takes, and what it needs
  splashbench benchmark run OUT --scenes all --budget full              the published schedules
  splashbench benchmark run OUT --scenes REAL --methods splashsplat:best scaffold_4d my.py:Mine
  splashbench benchmark run OUT --scenes REAL --on ray --cores 2        on all machines of a Ray cluster
"""
_RUN_EPILOG = f"""\
examples:
{_RUN_EXAMPLES}
OUT gets leaderboard/index.html with the paper's figures beside, table.md with means over all scenes, results/, and what
`splashbench study run` leaves. The same command goes on where it stopped; --retry makes failed runs again.
Scenes are folders of scenes, folders that hold some, or `all`: the 20 of `splashbench download scenes`.

Every method sees photographs at the size they have. The baselines' preset `quick` shrinks them to 400 pixels, which was
no handicap at 240x160 and is one of 4.5 times at 1200x1800: so longest_side is set to 16384, unless you set it. What a
fit takes longer for that is in the estimate. --budget quick is each method's preset `quick`; full is `best` of
splashsplat and the published schedules of the baselines, which take days on a processor.
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    actions = add_group(
        subparsers,
        "benchmark",
        summary="methods on the real scenes, and a public leaderboard",
        description="Run methods on many scenes up to the leaderboard, or make a site of what others hand in.",
        epilog=f"examples:\n{_RUN_EXAMPLES}{benchmark_site.EXAMPLES}",
    )
    parser = add_command(
        actions,
        "run",
        run,
        summary="run methods on many scenes, up to the leaderboard",
        description="Estimate the time, run and score methods on scenes, make the leaderboard.",
        epilog=_RUN_EPILOG,
    )
    add_study_out(parser, "benchmark")
    parser.add_argument(
        "--scenes",
        nargs="+",
        action="extend",
        required=True,
        metavar="DIR",
        help="scenes, folders of some, or `all` for the 20 released ones",
    )
    add_methods(parser, " (default: splashsplat, the three baselines, hull_points and nearest_camera)")
    parser.add_argument(
        "--budget", choices=("quick", "full"), default="quick", help="presets of the methods (default: quick)"
    )
    parser.add_argument("--dry-run", action="store_true", help="print the estimate, and make nothing")
    add_seeds(parser, "of every method (default: 0)")
    add_run_timeout(parser, "has failed")
    parser.add_argument("--retry", action="store_true", help="repeat failed runs")
    parser.add_argument("--keep", action="store_true", help="keep every submission, with renders and model")
    parser.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda"),
        default="auto",
        help="auto: a GPU for the methods that can use one, where there is one with gsplat; cuda: a GPU for every "
        "method, each of which has to use it (default: auto)",
    )
    add_machines(parser)
    add_lpips_weights(parser)
    benchmark_site.register(actions)


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench benchmark run`."""
    from splashbench.benchmark.budgets import DEFAULT_METHODS, make_benchmark_plan, make_entrants
    from splashbench.benchmark.estimate import as_json, estimate, load_rates, measure_machine
    from splashbench.benchmark.scenes import find_scenes
    from splashbench.score.image.lpips import load_lpips
    from splashbench.study.execution import ExecutionOptions, carry_out_plan, claimed, gpu_elsewhere
    from splashbench.study.job import Store

    scenes = find_scenes(arguments.scenes)
    entrants = make_entrants(arguments.methods or DEFAULT_METHODS, arguments.budget)
    plan = make_benchmark_plan(
        entrants,
        [str(scene) for scene in scenes],
        arguments.budget,
        seeds=list(dict.fromkeys(arguments.seeds)) or [0],
        device=arguments.device,
        gpu_elsewhere=gpu_elsewhere(arguments.on, arguments.device),
        timeout_seconds=60 * arguments.timeout if arguments.timeout else None,
    )
    rates, store = load_rates(), Store(arguments.out)
    with_lpips = load_lpips(arguments.lpips_weights)[0] is not None
    found = estimate(plan, store, rates, measure_machine(rates), with_lpips)
    _tell(found, entrants, plan, arguments)
    if not with_lpips:
        say("LPIPS will be null: `splashbench download lpips-weights` fetches its weights, once")
    if arguments.dry_run:
        if arguments.json:
            emit({"out": str(arguments.out), "estimate": as_json(found)})
        return 0
    options = ExecutionOptions(
        **machine_options(arguments),
        keep=arguments.keep,
        retry=arguments.retry,
        lpips_weights=arguments.lpips_weights,
        tell=say,
    )
    tally = carry_out_plan(plan, arguments.out, options)
    with claimed(store):
        _remove_leftovers(arguments.out)
        failed, files = _report(plan, store, arguments)
    say(f"{tally.made} runs made{f', {tally.reused} reused' if tally.reused else ''}; {failed} failed")
    for file in files:
        say(f"wrote {file}")
    if arguments.json:
        emit(
            {
                "out": str(arguments.out),
                "made": tally.made,
                "kept": tally.reused,
                "failed": failed,
                "files": [str(file) for file in files],
                "estimate": as_json(found),
            }
        )
    return 0


def _remove_leftovers(out: Path) -> None:
    """Remove what an earlier process left that was killed while it wrote tables, charts or the leaderboard."""
    from splashbench.files import remove_any

    for path in (*out.glob(".tmp-*"), *(out / "leaderboard").glob(".tmp-*")):
        remove_any(path)


def _report(plan: StudyPlan, store: Store, arguments: argparse.Namespace) -> tuple[int, list[Path]]:
    """Write the tables and the leaderboard; returns how many runs failed, and the files."""
    from splashbench.cli.main import run_within
    from splashbench.errors import SplashbenchError
    from splashbench.study.report import write_report
    from splashbench.study.table import make_table

    means = make_table(plan, store)
    files = write_report(means, arguments.out, _command(arguments))
    board = arguments.out / "leaderboard"
    if not any(store.results.glob("*.json")):
        raise SplashbenchError(f"no run of {arguments.out} has a result; see the lines above, and {files[0]}")
    paper = ["--with-paper"] if plan.spec.paper else []
    if run_within(["leaderboard", str(store.results), str(board), *paper]):
        raise SplashbenchError(f"the leaderboard of {store.results} was not made; see the lines above")
    return len(means.failed), [*files, board / "index.html"]


def _tell(found: Estimate, entrants: list[Entrant], plan: StudyPlan, arguments: argparse.Namespace) -> None:
    """The estimate for people: one line, then what it rests on, method by method."""
    from splashbench.harness.devices import CPU
    from splashbench.harness.estimates import duration

    jobs, elsewhere = arguments.jobs or 1, arguments.on is not None
    seconds = found.seconds_at_once(1 if elsewhere else jobs, arguments.cores or (1 if elsewhere else None))
    memory = found.memory_bytes * (1 if elsewhere else jobs)
    unknown = f", and {', '.join(found.unknown)}, of which nothing is known" if found.unknown else ""
    say(
        f"{found.scenes} scene{'' if found.scenes == 1 else 's'}, {len(found.methods)} methods with the control, "
        f"{found.left} runs to make: about "
        f"{_long(seconds)}{unknown}; {memory / 1e9:.1f} GB of memory, {_disk(found.disk_bytes)} on the disk"
    )
    if elsewhere:
        say(
            "That is one run at a time, with the threads of --cores (1), on a machine like this one; Ray says how many "
            "it has room for at once"
        )
    for line in _lacking(0 if elsewhere else memory, found.disk_bytes, arguments.out, jobs):
        say(line)
    rows = [
        [
            each.label,
            each.preset,
            f"{each.made} of {each.runs}",
            "unknown" if each.seconds is None else duration(each.seconds),
            each.basis + (f"; photographs {each.beyond:.1f} times as large as those" if each.beyond > 1.05 else ""),
        ]
        for each in found.methods
    ]
    widths = [max(len(row[i]) for row in rows) for i in range(4)]
    for row in rows:
        say("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, [*widths, 0])).rstrip())
    say(
        f"This rests on the lines above, times {found.machine.factor:.2f} for this machine ({found.machine.cores} "
        "cores), by a render. Expect it to be off by a factor of two; with every run that is made it gets better."
    )
    if any(run.device != CPU for run in plan.runs):
        say("The estimate is for the processor: at 600x400 an H100 took a sixth of the time (docs/gpu.md)")
    native = [each.label for each in entrants if each.native]
    if native:
        say(f"Photographs at the size they have (longest_side=16384): {', '.join(native)}")
    own = [each.label for each in entrants if each.id == "splashsplat"]
    if own:
        say(
            f"{', '.join(own)}: its own settings show it the liquid's photographs at their size; those of the "
            "background are shrunk, to 400 pixels in `quick` and 800 in `best`, which is its own handicap"
        )


def _lacking(memory: float, disk: float, out: Path, jobs: int) -> list[str]:
    """A line for what this machine has less of than the estimate asks for, in bytes."""
    import shutil

    import psutil

    lines = []
    if memory > psutil.virtual_memory().total:
        lines.append(
            f"That is more memory than the {psutil.virtual_memory().total / 1e9:.1f} GB of this machine: "
            + ("give fewer --jobs" if jobs > 1 else "leave out the method that takes most, or take another machine")
        )
    place = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.is_dir())
    free = shutil.disk_usage(place).free
    if disk > free:
        lines.append(f"That is more than the {free / 1e9:.1f} GB that are free at {place}: give OUT on a larger disk")
    return lines


def _long(seconds: float) -> str:
    from splashbench.harness.estimates import duration

    if seconds < 48 * 3600:
        return duration(seconds)
    return f"{seconds / 3600:.0f} h ({seconds / 86400:.1f} days)"


def _disk(count: float) -> str:
    return f"{max(0.1, math.ceil(count / 1e8) / 10):.1f} GB"


def _command(arguments: argparse.Namespace) -> str:
    """The command line that makes the benchmark again."""
    words = ["splashbench", "benchmark", "run", str(arguments.out)]
    words += ["--budget", arguments.budget]
    words += ["--device", arguments.device] if arguments.device != "auto" else []
    for flag in ("scenes", "methods", "seeds"):
        values = getattr(arguments, flag)
        words += [f"--{flag}", *map(str, values)] if values else []
    return shlex.join(words)

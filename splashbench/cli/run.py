"""`splashbench run METHOD SCENE OUT`: reconstruct a scene with any method, measured by the harness."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from splashbench.cli.arguments import add_method, add_run_options, add_scene, add_settings, positive_number
from splashbench.cli.command import RENAMED, add_command
from splashbench.cli.output import emit, say

if TYPE_CHECKING:
    from splashbench.scene import Scene, SignedDistance
    from splashbench.submission import Budget, Submission

_EPILOG = """\
examples:
  splashbench run splashsplat scenes/bowl_001 submissions/bowl_001/splashsplat
  splashbench run splashsplat SCENE OUT --preset quick --seed 1 --set iterations=500
  splashbench run splashsplat SCENE OUT --preset auto   no larger than the scene needs
  splashbench run splashsplat SCENE OUT --checkpoints   with its quality over time, for `score` and `leaderboard`
  splashbench run splashsplat SCENE OUT --budget-seconds 60 --budget-mb 2
  splashbench run splashsplat SCENE OUT --budget-memory 800     within 800 MB of memory, on coarser grids
  splashbench run splashsplat SCENE OUT --withhold odd --exr    fitted to every second timestep; OpenEXR, too
  splashbench run nothing SCENE OUT                 the frozen background alone, the reference for dPSNR
  splashbench run oracle SCENE OUT                  the ground truth itself, a check of the scoring
  splashbench run my_method.py:MyMethod SCENE OUT   a method that is not installed (CONTRIBUTING.md)

With --checkpoints the fit's time leaves out what saving them takes, while --timeout and the memory include it.
A method that crashes, hangs, runs out of memory or returns NaN gives a submission with that status, and exit status 1.
A method is a program with your rights: run a stranger's in a container. A code in an environment of its own, such as
an official implementation, runs by `splashbench run-external`.
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = add_command(
        subparsers,
        "run",
        run,
        summary="reconstruct a scene with a method",
        description="Run METHOD on SCENE in a process of its own and write the submission OUT.",
        epilog=_EPILOG,
    )
    add_method(parser, also=" `oracle`,")
    add_scene(parser)
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the submission, made by the run")
    parser.add_argument("--preset", help="settings by name; see `splashbench methods show METHOD`")
    add_settings(parser, "a single setting on top of the preset; may be given several times")
    parser.add_argument(
        "--withhold",
        type=_which_timesteps,
        metavar="WHICH",
        help="keep timesteps from the method: `odd` ones, all but each third by `keep_1_of_3`, or a third at random by "
        "`drop_33_percent`; these are rendered, and they alone are scored",
    )
    parser.add_argument(
        "--checkpoints",
        action="store_true",
        help="also keep the views of the fit on its way, after about 5, 7, 10, 14, 20 ... seconds of it",
    )
    _add_budgets(parser)
    add_run_options(parser, automatic_device=True)


def _add_budgets(parser: argparse.ArgumentParser) -> None:
    budgets = parser.add_argument_group("what the fit may cost (`splashbench explain OUT` tells what it was spent on)")
    for name, unit, what in (
        ("seconds", "seconds", "of the fit"),
        ("mb", "megabytes", "of the stored model"),
        ("memory", "megabytes", "of memory, at the most"),
    ):
        budgets.add_argument(
            f"--budget-{name}", type=positive_number(unit, 1e9), metavar=unit.upper(), help=f"{unit} {what}"
        )


def _budget(arguments: argparse.Namespace) -> Budget | None:
    from splashbench.submission import Budget

    def whole(megabytes: float | None) -> int | None:
        return None if megabytes is None else max(round(megabytes * 1e6), 1)

    budget = Budget(
        seconds=arguments.budget_seconds,
        storage_bytes=whole(arguments.budget_mb),
        memory_bytes=whole(arguments.budget_memory),
    )
    return budget if budget.limits else None


def _which_timesteps(text: str) -> str:
    from splashbench.errors import SplashbenchError
    from splashbench.submission.withheld import kept_timesteps

    try:
        kept_timesteps(3, text)
    except SplashbenchError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench run`."""
    from splashbench.harness.checkpoints import MARKS
    from splashbench.harness.runner import TIMING_FRAMES, parse_overrides, run_method

    if arguments.method == "external":
        arguments.usage_error(f"METHOD external has a new name: {RENAMED['run', 'external']}")
    submission = run_method(
        arguments.method,
        arguments.scene,
        arguments.out,
        preset=arguments.preset,
        overrides=parse_overrides(arguments.overrides),
        seed=arguments.seed,
        device=arguments.device,
        timeout_seconds=arguments.timeout,
        timing_frames=TIMING_FRAMES if arguments.timing_frames is None else arguments.timing_frames,
        exr=arguments.exr,
        withheld=arguments.withhold,
        checkpoints=MARKS if arguments.checkpoints else None,
        budget=_budget(arguments),
        keep_model=not arguments.no_model,
        replace=arguments.replace,
        oracle_geometry=_oracle_geometry,
        tell=say,
    )
    return report_submission(submission, arguments)


def _oracle_geometry(scene: Scene) -> SignedDistance | None:
    from splashbench.score.truth.comparison import oracle_geometry

    return oracle_geometry(scene)


def report_submission(submission: Submission, arguments: argparse.Namespace) -> int:
    """Print how a run ended, as JSON too where it is asked for; returns the exit status."""
    from splashbench.errors import one_line

    identity, record = submission.identity, submission.record
    if arguments.json:
        emit(identity.model_dump(mode="json") | record.model_dump(mode="json"))
    if record.status.value != "ok":
        say(
            f"error: {identity.method}: {record.status.value}: {one_line(record.reason)}; "
            f"see {arguments.out / 'record.json'}"
        )
        return 1
    costs = record.fit_seconds, record.storage_bytes, record.peak_memory_bytes
    for words in identity.budget.exceeded(*costs) if identity.budget else []:
        say(f"warning: {identity.method}: {words}")
    cost = f", fit in {record.fit_seconds:.1f} s" if record.fit_seconds is not None else ""
    say(f"{identity.method}: ok{cost}; submission in {arguments.out}")
    return 0

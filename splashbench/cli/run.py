"""`splashbench run METHOD SCENE OUT`: reconstruct a scene with any method, measured by the harness."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from splashbench.cli import run_external as external
from splashbench.cli.output import add_json, emit, say

if TYPE_CHECKING:
    from splashbench.scene import Scene, SignedDistance
    from splashbench.submission import Submission

_EPILOG = """\
examples:
  splashbench run splashsplat scenes/bowl_001 submissions/bowl_001/splashsplat
  splashbench run splashsplat SCENE OUT --preset quick --seed 1 --set iterations=500
  splashbench run nothing SCENE OUT                 the frozen background alone, the reference for dPSNR
  splashbench run oracle SCENE OUT                  the ground truth itself, a check of the scoring
  splashbench run my_method.py:MyMethod SCENE OUT   a method that is not installed (CONTRIBUTING.md)
  splashbench run external SCENE OUT --name theirs --format blender \\
    --command "/envs/theirs/bin/python train.py -s {scene} -m {out} --seed {seed}" \\
    --render-command "/envs/theirs/bin/python render_views.py -m {out} --views {views} --to {into}"
                                                    a code in an environment of its own (docs/external_methods.md)

A method that crashes, hangs, runs out of memory or returns NaN gives a submission with that status, and exit status 1.
It is a program with your rights: run a stranger's method in a container.
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = subparsers.add_parser(
        "run",
        help="reconstruct a scene with a method",
        description="Run METHOD on SCENE in a process of its own and write the submission OUT.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("method", help="a name from `splashbench methods list`, `oracle`, `external`, or FILE.py:CLASS")
    parser.add_argument("scene", type=Path, help="folder of the scene")
    parser.add_argument("out", type=Path, help="folder of the submission, made by the run")
    parser.add_argument("--preset", help="settings by name; see `splashbench methods show METHOD`")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides")
    parser.add_argument("--seed", type=_not_negative, default=0, help="seed of every random choice (default 0)")
    parser.add_argument("--device", default="cpu", help="cpu (default), or cuda for methods that can")
    parser.add_argument(
        "--timeout", type=seconds_above_zero, metavar="SECONDS", help="limit for the fit, and for the rendering"
    )
    parser.add_argument(
        "--timing-frames",
        type=_not_negative,
        metavar="N",
        help="frames timed for FPS (default 100; of fewer it is not scored)",
    )
    parser.add_argument(
        "--withhold",
        choices=["odd"],
        help="keep every second timestep from the method; these are rendered, and they alone are scored",
    )
    parser.add_argument("--exr", action="store_true", help="write the renders also as OpenEXR, for compositing")
    parser.add_argument("--no-model", action="store_true", help="do not keep the fitted model under OUT/model")
    parser.add_argument("--replace", action="store_true", help="replace OUT when it exists")
    add_json(parser)
    external.add_options(parser)
    parser.set_defaults(handler=run, usage_error=parser.error)


def _not_negative(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 0 or more")
    return int(text)


def seconds_above_zero(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds above 0")
    return seconds


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench run`."""
    from splashbench.errors import one_line

    fault = external.fault(arguments)
    if fault:
        arguments.usage_error(fault)
    submission = external.run(arguments) if arguments.method == external.NAME else _run_method(arguments)
    record = submission.record
    if arguments.json:
        emit(submission.identity.model_dump(mode="json") | record.model_dump(mode="json"))
    if record.status.value != "ok":
        say(
            f"error: {submission.identity.method}: {record.status.value}: {one_line(record.reason)}; "
            f"see {arguments.out / 'record.json'}"
        )
        return 1
    cost = f", fit in {record.fit_seconds:.1f} s" if record.fit_seconds is not None else ""
    say(f"{submission.identity.method}: ok{cost}; submission in {arguments.out}")
    return 0


def _run_method(arguments: argparse.Namespace) -> Submission:
    from splashbench.harness.runner import TIMING_FRAMES, parse_overrides, run_method

    return run_method(
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
        keep_model=not arguments.no_model,
        replace=arguments.replace,
        oracle_geometry=_oracle_geometry,
    )


def _oracle_geometry(scene: Scene) -> SignedDistance | None:
    from splashbench.score.truth.comparison import oracle_geometry

    return oracle_geometry(scene)

"""`splashbench synth session`: a synthetic recording of a pour, as seven cameras would film it."""

from __future__ import annotations

import argparse
from pathlib import Path

from splashbench.cli.arguments import add_replace, add_seed, image_size, whole_number
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say

_EPILOG = """\
examples:
  splashbench synth session sessions/synthetic
  splashbench synth session sessions/small --size 320x180 --fps 30 --particle-radius 0.004 --seed 7

Needs the extra `splashbench[synth]` and the Debian packages libgl1 and libx11-6. The default session takes two to three
minutes on two cores. The same seed always gives the same truth.
"""


def register(actions: argparse._SubParsersAction) -> None:
    """Add the action to those of `splashbench synth`."""
    parser = add_command(
        actions,
        "session",
        film,
        summary="make a session: the recordings of seven cameras and a sweep",
        description="Simulate a pour into a bowl and film it with seven cameras, each with its own lens and clock.",
        epilog=_EPILOG,
    )
    parser.add_argument("out", type=Path, metavar="OUT", help="folder to be made")
    parser.add_argument(
        "--size", type=image_size, default=(480, 270), metavar="WxH", help="size of the frames (default: 480x270)"
    )
    parser.add_argument("--fps", type=int, default=60, help="frames per second of the cameras (default: 60)")
    add_seed(parser, "decides lenses, poses, clocks and sounds")
    parser.add_argument(
        "--duration", type=float, default=2.0, metavar="SECONDS", help="length of the liquid's motion (default: 2.0)"
    )
    parser.add_argument(
        "--particle-radius",
        type=float,
        default=0.003,
        metavar="METRES",
        help="radius of the simulated particles (default: 0.003)",
    )
    parser.add_argument(
        "--workers",
        type=whole_number(1),
        metavar="N",
        help="number of processes that film (default: one per core, as far as memory goes)",
    )
    add_replace(parser)


def film(arguments: argparse.Namespace) -> int:
    """Handle `splashbench synth session`."""
    from splashbench.synth.recording.plan import RecordingOptions
    from splashbench.synth.recording.session import make_session

    options = RecordingOptions(
        size=arguments.size,
        fps=arguments.fps,
        seed=arguments.seed,
        duration=arguments.duration,
        particle_radius=arguments.particle_radius,
    )
    out = make_session(arguments.out, options, replace=arguments.replace, workers=arguments.workers)
    if arguments.json:
        emit({"session": str(out), "seed": options.seed})
    say(f"{out} is ready. Next: splashbench prepare {out} SCENE, then splashbench synth verify {out} SCENE")
    return 0

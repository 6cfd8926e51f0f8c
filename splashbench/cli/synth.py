"""`splashbench synth`: made-up sessions with exact ground truth, and what `prepare` made of them held against it."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from splashbench.cli.output import add_json, emit, say, table
from splashbench.errors import SplashbenchError

_EPILOG = """\
examples:
  splashbench synth session sessions/made_up
  splashbench prepare sessions/made_up scenes/made_up
  splashbench synth verify sessions/made_up scenes/made_up
"""
_SESSION_EPILOG = """\
examples:
  splashbench synth session sessions/made_up
  splashbench synth session sessions/small --size 320x180 --fps 30 --particle-radius 0.004 --seed 7

Needs the extra `splashbench[synth]` and the Debian packages libgl1 and libx11-6. The default takes two to three minutes
on two cores. The same seed always gives the same truth.
"""
_SCENE_EPILOG = """\
examples:
  splashbench synth scene balls scenes/balls                 a second; balls in free flight, to try a method on
  splashbench synth scene opaque_bowl scenes/opaque_bowl     minutes; a simulated pour
  splashbench synth scene glass_tank scenes/tank --step 33 --timesteps 20

scenes, and the time between their frames:
  balls        balls in free flight, 8 frames within a third of a second
  opaque_bowl  a pour that splashes in an opaque bowl, 33 ms
  glass_tank   a pour into a glass tank, seen through its walls, 50 to 83 ms, uneven as in real captures
  thin_stream  a stream a centimetre thick, 40 ms
  still_pool   a pool coming to rest, 100 ms
"""
# The names of splashbench.synth.scenes.RECIPES, repeated here so that `--help` need not import them, and the scene
# that needs no simulation.
_BALLS = "balls"
_SCENES = (_BALLS, "opaque_bowl", "glass_tank", "thin_stream", "still_pool")
_LONGEST_SIDE = 8192
_VERIFY_EPILOG = """\
example:
  splashbench synth verify sessions/made_up scenes/made_up --json

Also writes SCENE/truth/particles.npz, the true particles in the scene's own coordinates and times, from which
`splashbench score` measures a method's geometry and motion. The scene's digest does not change by it.
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = subparsers.add_parser(
        "synth",
        help="made-up recordings with exact ground truth",
        description="Make up a recorded pour of which everything is known, or judge a preparation by it.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    kinds = parser.add_subparsers(dest="kind", metavar="COMMAND", required=True)
    _register_session(kinds)
    _register_scene(kinds)
    _register_verify(kinds)


def _register_session(kinds: argparse._SubParsersAction) -> None:
    parser = kinds.add_parser(
        "session",
        help="make a session: the recordings of seven cameras and a sweep",
        description="Simulate a pour into a bowl and film it with seven cameras, each with its own lens and clock.",
        epilog=_SESSION_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("out", type=Path, metavar="OUT", help="folder to be made")
    parser.add_argument("--size", type=_size, default=(480, 270), metavar="WxH", help="of frames (default: 480x270)")
    parser.add_argument("--fps", type=int, default=60, help="frames per second of the cameras (default: 60)")
    parser.add_argument(
        "--seed", type=_not_negative, default=0, help="decides lenses, poses, clocks and sounds (default: 0)"
    )
    parser.add_argument(
        "--duration", type=float, default=2.0, metavar="SECONDS", help="of the liquid's motion (default: 2.0)"
    )
    parser.add_argument(
        "--particle-radius", type=float, default=0.003, metavar="METRES", help="of the simulation (default: 0.003)"
    )
    parser.add_argument("--workers", type=_positive, metavar="N", help="processes that render (default: one per core)")
    parser.add_argument("--replace", action="store_true", help="replace OUT where it exists")
    add_json(parser)
    parser.set_defaults(handler=run_session)


def _register_scene(kinds: argparse._SubParsersAction) -> None:
    parser = kinds.add_parser(
        "scene",
        help="make a scene: perfect cameras, exact masks",
        description="Make up a liquid and see it with seven perfect cameras: a scene ready for `splashbench run`.",
        epilog=_SCENE_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", choices=_SCENES, metavar="NAME", help=f"one of {', '.join(_SCENES)}")
    parser.add_argument("out", type=Path, metavar="OUT", help="folder to be made")
    parser.add_argument("--size", type=_size, metavar="WxH", help="of frames (default: 480x320; balls: 96x64)")
    parser.add_argument("--timesteps", type=_positive, metavar="N", help="frames per camera (default: 50; balls: 8)")
    parser.add_argument(
        "--step", type=_milliseconds, metavar="MS", help="between frames, all alike (default: as fits the scene)"
    )
    parser.add_argument(
        "--particle-radius", type=float, metavar="METRES", help="of the simulation (default: as fits the scene)"
    )
    parser.add_argument("--seed", type=_not_negative, default=0, help="decides poses, lenses and noise (default: 0)")
    parser.add_argument("--replace", action="store_true", help="replace OUT where it exists")
    add_json(parser)
    parser.set_defaults(handler=run_scene)


def _register_verify(kinds: argparse._SubParsersAction) -> None:
    parser = kinds.add_parser(
        "verify",
        help="hold a prepared scene against its session's truth",
        description="Compare the scene that `splashbench prepare` made from a made-up session with its truth.",
        epilog=_VERIFY_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("session", type=Path, metavar="SESSION", help="folder made by `splashbench synth session`")
    parser.add_argument("scene", type=Path, metavar="SCENE", help="folder made from it by `splashbench prepare`")
    parser.add_argument("--out", type=Path, metavar="FILE", help="also write the figures to this JSON file")
    parser.add_argument("--replace", action="store_true", help="replace FILE where it exists")
    add_json(parser)
    parser.set_defaults(handler=run_verify)


def _size(text: str) -> tuple[int, int]:
    width, separator, height = text.lower().partition("x")
    if not (separator and width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} is no size; write it like 480x270")
    if not (0 < int(width) <= _LONGEST_SIDE and 0 < int(height) <= _LONGEST_SIDE):
        raise argparse.ArgumentTypeError(f"{text!r} will not do; give 1x1 to {_LONGEST_SIDE}x{_LONGEST_SIDE}")
    return int(width), int(height)


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above 0")
    return int(text)


def _milliseconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of milliseconds above 0")
    return value


def _not_negative(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 0 or more")
    return int(text)


def run_session(arguments: argparse.Namespace) -> int:
    """Handle `splashbench synth session`."""
    from splashbench.synth.recording.plan import Options
    from splashbench.synth.recording.session import make_session

    options = Options(
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


def run_scene(arguments: argparse.Namespace) -> int:
    """Handle `splashbench synth scene`."""
    if arguments.name == _BALLS:
        for option, value in (("--step", arguments.step), ("--particle-radius", arguments.particle_radius)):
            if value is not None:
                raise SplashbenchError(f"{option} is for simulated scenes, and balls is not one; leave it out")
        from splashbench.synth.balls import write_balls_scene

        scene = write_balls_scene(
            arguments.out,
            size=arguments.size or (96, 64),
            n_frames=arguments.timesteps or 8,
            seed=arguments.seed,
            replace=arguments.replace,
        )
    else:
        from splashbench.synth.scenes import DEFAULT_SIZE, make_scene

        scene = make_scene(
            arguments.name,
            arguments.out,
            size=arguments.size or DEFAULT_SIZE,
            timesteps=arguments.timesteps or 50,
            seed=arguments.seed,
            particle_radius=arguments.particle_radius,
            step_ms=arguments.step,
            replace_existing=arguments.replace,
        )
    if arguments.json:
        emit({"scene": str(arguments.out), "name": scene.name, "frames": scene.n_frames, "digest": scene.digest})
    say(f"{arguments.out} is ready. Next: splashbench run METHOD {arguments.out} OUT")
    return 0


def run_verify(arguments: argparse.Namespace) -> int:
    """Handle `splashbench synth verify`."""
    from splashbench.files import write_model
    from splashbench.synth.recording.verification import verify_scene

    if arguments.out and arguments.out.exists() and not arguments.replace:
        raise SplashbenchError(f"{arguments.out} exists already; give another place, or --replace to replace it")
    found = verify_scene(arguments.session, arguments.scene)
    if arguments.out:
        write_model(arguments.out, found)
    if arguments.json:
        emit(found.model_dump())
    rows = [
        [
            name,
            f"{errors.sync_error_ms:+.3f}",
            f"{errors.focal_error_percent:+.3f}",
            f"{errors.rotation_error_deg:.3f}",
            f"{errors.position_error_mm:.2f}",
            "-" if errors.mask_iou is None else f"{errors.mask_iou:.3f}",
        ]
        for name, errors in found.cameras.items()
    ]
    say(table(["camera", "sync ms", "focal %", "rotation deg", "position mm", "mask IoU"], rows))
    scale = "unknown" if found.scale_error_percent is None else f"{found.scale_error_percent:+.3f} %"
    say(f"error of the metre: {scale}; {found.particles_attached} true particles written to {found.scene}/truth")
    return 0

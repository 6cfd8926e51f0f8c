"""`splashbench synth scene`: a synthetic scene with perfect cameras and exact masks."""

from __future__ import annotations

import argparse
from pathlib import Path

from splashbench.cli.arguments import add_replace, add_seed, image_size, positive_number, whole_number
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say
from splashbench.errors import SplashbenchError

_EPILOG = """\
examples:
  splashbench synth scene balls scenes/balls                 takes a second: to try a method on
  splashbench synth scene opaque_bowl scenes/opaque_bowl     takes minutes: a simulated pour
  splashbench synth scene glass_tank scenes/tank --step 33 --timesteps 20
  splashbench synth scene glass_tank scenes/amber --dye amber     the same pour, of another colour
  splashbench synth scene thin_stream scenes/stream --size 240x160 --times-alone

scenes, and the time between their frames:
  balls         balls in free flight, 8 frames within a third of a second
  opaque_bowl   a pour that splashes in an opaque bowl, 33 ms
  glass_tank    a pour into a glass tank, seen through its walls, 50 to 83 ms, uneven as in real captures
  thin_stream   a stream a centimetre thick, 40 ms
  still_pool    a pool coming to rest, 100 ms
  glossy_bowl   a lively pour into a glossy basin without texture, in which the room is mirrored, 33 ms
  clear_liquid  a clear liquid in a painted dish, whose pattern is seen through it, 40 ms
"""
# The names of splashbench.synth.scenes.RECIPES, repeated here so that `--help` need not import them, and the scene
# that needs no simulation.
_BALLS = "balls"
_SCENES = (_BALLS, "opaque_bowl", "glass_tank", "thin_stream", "still_pool", "glossy_bowl", "clear_liquid")


def register(actions: argparse._SubParsersAction) -> None:
    """Add the action to those of `splashbench synth`."""
    parser = add_command(
        actions,
        "scene",
        make,
        summary="make a scene: perfect cameras, exact masks",
        description="Simulate a liquid and see it with seven perfect cameras: a scene ready for `splashbench run`.",
        epilog=_EPILOG,
    )
    parser.add_argument("name", choices=_SCENES, metavar="NAME", help=f"one of {', '.join(_SCENES)}")
    parser.add_argument("out", type=Path, metavar="OUT", help="folder to be made")
    parser.add_argument(
        "--size", type=image_size, metavar="WxH", help="size of the frames (default: 480x320; balls: 96x64)"
    )
    parser.add_argument(
        "--timesteps", type=whole_number(1), metavar="N", help="frames per camera (default: 50; balls: 8)"
    )
    parser.add_argument(
        "--step",
        type=positive_number("milliseconds"),
        metavar="MS",
        help="time between frames, the same for all (default: depends on the scene)",
    )
    parser.add_argument(
        "--particle-radius",
        type=float,
        metavar="METRES",
        help="radius of the simulated particles (default: depends on the scene)",
    )
    parser.add_argument(
        "--dye",
        metavar="DYE",
        help="colour of the liquid: amber, brown, green, blue, clear or '#rrggbb' (default: depends on the scene)",
    )
    parser.add_argument(
        "--times-alone",
        action="store_true",
        help="tell neither scale, gravity nor the container's mesh, as of footage that nobody measured",
    )
    parser.add_argument(
        "--workers",
        type=whole_number(1),
        metavar="N",
        help="number of processes that film (default: one per core, as far as memory goes)",
    )
    add_seed(parser, "decides poses, lenses and noise")
    add_replace(parser)


def make(arguments: argparse.Namespace) -> int:
    """Handle `splashbench synth scene`."""
    if arguments.name == _BALLS:
        for option, value in (
            ("--step", arguments.step),
            ("--particle-radius", arguments.particle_radius),
            ("--dye", arguments.dye),
            ("--times-alone", arguments.times_alone or None),
            ("--workers", arguments.workers),
        ):
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
            dye=arguments.dye,
            times_alone=arguments.times_alone,
            replace_existing=arguments.replace,
            workers=arguments.workers,
        )
    if arguments.json:
        emit({"scene": str(arguments.out), "name": scene.name, "frames": scene.n_frames, "digest": scene.digest})
    say(f"{arguments.out} is ready. Next: splashbench run METHOD {arguments.out} OUT")
    return 0

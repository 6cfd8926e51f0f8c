"""`splashbench video SUBMISSION OUT`: a video of a reconstruction, from anywhere and at any speed."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from splashbench.cli.arguments import add_dye, add_replace, positive_number
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say

if TYPE_CHECKING:
    from splashbench.replay import Reconstruction
    from splashbench.video import Comparison

#: As in `splashbench.video.layers`, repeated here so that `--help` need not import it.
LAYERS = ("color", "opacity", "depth", "error", "velocity", "liquid")
_TRUTH = "truth"
_MAX_FPS = 1000
_MAX_BESIDE = 5

_EPILOG = """\
examples:
  splashbench video submissions/bowl bowl.mp4                                     the first test view, in real time
  splashbench video submissions/bowl slow.mp4 --slow 8                            eight times slower
  splashbench video submissions/bowl around.mp4 --orbit --slow 4                  around the liquid
  splashbench video submissions/bowl frozen.mp4 --orbit --start 0.5 --end 0.5 --seconds 6
  splashbench video submissions/bowl path.mp4 --path camera_path.json             as saved by nerfstudio's viewer
  splashbench video submissions/bowl truth.mp4 --scene scenes/bowl --beside truth
  splashbench video submissions/bowl wipe.mp4 --wipe submissions/bowl_quick --view 7
  splashbench video submissions/bowl error.mp4 --scene scenes/bowl --layer error
  splashbench video submissions/bowl amber.mp4 --dye amber --beside submissions/bowl    dyed, and as it was filmed
  splashbench video submissions/bowl frames --timesteps                           a folder of PNGs

Every frame is rendered at its own time, by the method's own interpolation between timesteps. OUT ends in .mp4 (H.264,
played by browsers), in .gif, or in nothing for a folder of PNGs with frames.json. A submission without its model has
its test views at the timesteps alone. Photographs are of timesteps: between them the nearest is shown, and the caption
says when it was taken. --scene is also needed for submissions that do not tell their cameras.
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = add_command(
        subparsers,
        "video",
        run,
        summary="a video of a reconstruction: any view, any speed, any layer",
        description="Render SUBMISSION as a video, from anywhere and at any speed, alone or compared.",
        epilog=_EPILOG,
    )
    parser.add_argument("submission", type=Path, metavar="SUBMISSION", help="folder of the submission")
    parser.add_argument("out", type=Path, metavar="OUT", help="file in .mp4 or .gif, or a folder for PNGs")
    parser.add_argument("--scene", type=Path, metavar="SCENE", help="folder of the scene, for its photographs")
    parser.add_argument("--method", metavar="FILE.py:CLASS", help="method that is not installed, which runs its code")
    _add_views(parser)
    _add_times(parser)
    _add_looks(parser)
    add_replace(parser)


def _add_views(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("from where")
    views = group.add_mutually_exclusive_group()
    views.add_argument("--view", metavar="NAME", help="camera of the scene (default: the first test camera)")
    views.add_argument("--orbit", action="store_true", help="around the liquid, as far as the training cameras stand")
    views.add_argument("--path", type=Path, metavar="FILE", help="camera path, JSON of nerfstudio's viewer")
    group.add_argument(
        "--orbit-degrees",
        type=positive_number("degrees", 360.001),
        metavar="DEGREES",
        help="of an orbit, about the middle of the training cameras' arc (default: that arc; 360 goes all around)",
    )
    group.add_argument(
        "--orbit-height",
        type=_number("degrees", -89, 89),
        metavar="DEGREES",
        help="of an orbit above the horizon (default: the training cameras')",
    )


def _add_times(parser: argparse.ArgumentParser) -> None:
    times = parser.add_argument_group("when and how fast")
    times.add_argument(
        "--fps",
        type=positive_number("frames a second", _MAX_FPS),
        metavar="N",
        help="frames a second (default: 30, or the path's; for .gif the nearest that it can have)",
    )
    speed = times.add_mutually_exclusive_group()
    speed.add_argument(
        "--slow", type=_number("times", 1e-3, 1e12), metavar="N", help="N times slower than real (default: 1)"
    )
    speed.add_argument(
        "--seconds",
        type=positive_number("seconds"),
        metavar="S",
        help="length of the video, whatever its speed; with --start equal to --end the liquid stands still",
    )
    times.add_argument(
        "--timesteps",
        action="store_true",
        help="a frame for each timestep, nothing in between; in real time without --fps",
    )
    for option, what in (("--start", "first"), ("--end", "last")):
        times.add_argument(
            option,
            type=_number("seconds"),
            metavar="SECONDS",
            help=f"{what} instant, on the scene's clock (default: the recording's {what})",
        )


def _add_looks(parser: argparse.ArgumentParser) -> None:
    looks = parser.add_argument_group("what is shown")
    looks.add_argument("--layer", choices=LAYERS, default=LAYERS[0], help="what is shown (default: color)")
    looks.add_argument(
        "--range", nargs=2, type=_number("the layer"), metavar=("LOW", "HIGH"), help="ends of the layer's colour scale"
    )
    looks.add_argument("--flat", type=_color, metavar="RRGGBB", help="colour behind --layer liquid (default: 262a36)")
    add_dye(looks)
    layouts = looks.add_mutually_exclusive_group()
    layouts.add_argument(
        "--beside",
        nargs="+",
        metavar="WITH",
        help="side by side with: truth, which are the scene's photographs, or folders of other submissions",
    )
    layouts.add_argument("--wipe", metavar="WITH", help="in one picture with truth or a submission, a divider between")
    looks.add_argument(
        "--divider",
        type=_number("the width", 0, 1),
        metavar="SHARE",
        help="place of --wipe's divider, as a share of the width (default: it moves forth and back)",
    )
    looks.add_argument(
        "--resize", type=positive_number("times", 100), default=1.0, metavar="FACTOR", help="size of the pictures"
    )
    looks.add_argument("--no-caption", action="store_true", help="no lines of text below the pictures")


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench video`."""
    from splashbench.replay import load
    from splashbench.video import VideoSettings, make_film, write_video
    from splashbench.video.output import rate_for, require_place

    _require_sense(arguments)
    require_place(arguments.out, arguments.replace)
    reconstruction = load(arguments.submission, arguments.scene, method=arguments.method)
    if arguments.dye is not None:
        from splashbench.dyes import dye_named
        from splashbench.restyle import restyled

        reconstruction = restyled(reconstruction, dye_named(arguments.dye), arguments.density, arguments.light)
    compared = _comparison(arguments, reconstruction)
    for source in (reconstruction, *compared.reconstructions):
        if not source.has_model and not arguments.timesteps:
            say(f"{source.submission.directory} has no model to render: a frame for each timestep")
    settings = VideoSettings(
        view=arguments.view,
        orbit=arguments.orbit,
        orbit_degrees=arguments.orbit_degrees,
        orbit_height=arguments.orbit_height,
        path=arguments.path,
        start=arguments.start,
        end=arguments.end,
        fps=arguments.fps,
        slow=arguments.slow,
        seconds=arguments.seconds,
        timesteps=arguments.timesteps,
        layer=arguments.layer,
        scale=None if arguments.range is None else tuple(arguments.range),
        resize=arguments.resize,
        caption=not arguments.no_caption,
        **({} if arguments.flat is None else {"flat": arguments.flat}),
    )
    film = make_film(reconstruction, settings, compared, rate_for(arguments.out))
    write_video(film, arguments.out, arguments.replace)
    about = film.about()
    say("wrote {}: {frames} frames of {width}x{height}, {seconds:.2f} s".format(arguments.out, **about))
    if arguments.json:
        emit({"out": str(arguments.out), **about})
    return 0


def _comparison(arguments: argparse.Namespace, shown: Reconstruction) -> Comparison:
    """What SUBMISSION, `shown`, is compared with, opened."""
    from splashbench.replay import load
    from splashbench.video import TRUTH, Comparison

    def opened(folder: Path) -> Reconstruction:
        # --method is of SUBMISSION, and may be of both.
        same = arguments.method and _method(folder) == shown.name
        return load(folder, shown.scene, method=arguments.method if same else None)

    named = arguments.beside or ([arguments.wipe] if arguments.wipe is not None else [])
    others: list[Reconstruction | str] = [TRUTH if name == _TRUTH else opened(Path(name)) for name in named]
    return Comparison(others, "beside" if arguments.wipe is None else "wipe", arguments.divider)  # type: ignore[arg-type]


def _method(folder: Path) -> str:
    """Id of the method of the submission in `folder`."""
    from splashbench.submission import Submission

    return Submission.open(folder, verify=False).identity.method


def _require_sense(arguments: argparse.Namespace) -> None:
    """Raise SplashbenchError for an option that would have no effect, and for what cannot be."""
    from splashbench.errors import SplashbenchError

    idle = {
        "--orbit-degrees": (arguments.orbit_degrees is not None and not arguments.orbit, "--orbit"),
        "--orbit-height": (arguments.orbit_height is not None and not arguments.orbit, "--orbit"),
        "--divider": (arguments.divider is not None and arguments.wipe is None, "--wipe"),
        "--density": (arguments.density != 1 and arguments.dye is None, "--dye"),
        "--light": (arguments.light != 1 and arguments.dye is None, "--dye"),
        "--flat": (arguments.flat is not None and arguments.layer != "liquid", "--layer liquid"),
        "--range": (
            arguments.range is not None and arguments.layer in ("color", "liquid"),
            "--layer opacity, depth, error or velocity",
        ),
    }
    for option, (is_idle, needed) in idle.items():
        if is_idle:
            raise SplashbenchError(f"{option} has no effect without {needed}; give both, or leave it out")
    if arguments.range is not None and not arguments.range[0] < arguments.range[1]:
        low, high = arguments.range
        raise SplashbenchError(f"--range {low:g} {high:g} has no colours in it; give the lower end first")
    if arguments.beside is not None and len(arguments.beside) > _MAX_BESIDE:
        raise SplashbenchError(f"--beside takes {_MAX_BESIDE} at most, not {len(arguments.beside)}")


def _number(unit: str, least: float = -math.inf, greatest: float = math.inf) -> Callable[[str], float]:
    """A validator of finite numbers from `least` to `greatest`; `unit` is named in its message."""
    limits = "" if math.isinf(least) else f" from {least:g} to {greatest:g}"

    def parse(text: str) -> float:
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not (math.isfinite(number) and least <= number <= greatest):
            raise argparse.ArgumentTypeError(f"{text!r} is not a number of {unit}{limits}")
        return number

    return parse


def _color(text: str) -> tuple[int, int, int]:
    """sRGB of 255 from a text such as `262a36`."""
    if not re.fullmatch(r"#?[0-9A-Fa-f]{6}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is no colour; write it like 262a36")
    red, green, blue = bytes.fromhex(text.removeprefix("#"))
    return red, green, blue

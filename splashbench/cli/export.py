"""`splashbench export SUBMISSION OUT --format ...`: a reconstruction as files that other programs open."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splashbench.cli.arguments import add_replace, positive_number, whole_number
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say

if TYPE_CHECKING:
    from splashbench.export import Manifest

_EPILOG = """\
examples:
  splashbench export SUBMISSION OUT --format ply --up y-down        3D Gaussians; drop OUT/frames onto SuperSplat
  splashbench export SUBMISSION OUT --format mesh --up z --metres   a closed mesh per timestep, for Blender
  splashbench export SUBMISSION OUT --format mesh --mesh-format usd --fps 120     one USD file, 120 frames a second
  splashbench export SUBMISSION OUT --format particles --every 2
  splashbench export SUBMISSION OUT --format velocity --times 0.5:1.0
  splashbench export SUBMISSION OUT --format nerfstudio --scene SCENE --times 0.8:0.8

Files of single instants are OUT/frames/frame0001.ply and so on; OUT/manifest.json says when each is and in which units.
Lengths are the scene's unless --metres, axes the scene's unless --up. docs/exports.md describes the formats, with
recipes for SuperSplat, Blender and numpy.
"""

#: Format -> the function of splashbench.export that writes it; `--help` imports none of them.
_FORMATS = {
    "ply": "export_gaussians",
    "mesh": "export_meshes",
    "particles": "export_particles",
    "velocity": "export_velocity",
    "nerfstudio": "export_nerfstudio",
}
#: Option -> the format that it goes with.
_OPTIONS = {"part": "ply", "degree": "ply", "backdrop": "ply", "mesh_format": "mesh", "points": "nerfstudio"}


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = add_command(
        subparsers,
        "export",
        run,
        summary="write Gaussians, meshes, particles or velocities for other programs",
        description="Write the reconstruction in SUBMISSION into the folder OUT as files that other programs open.",
        epilog=_EPILOG,
    )
    parser.add_argument("submission", type=Path, metavar="SUBMISSION", help="folder of the submission")
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the export, made by the command")
    parser.add_argument(
        "--format",
        required=True,
        choices=tuple(_FORMATS),
        help="ply: 3D Gaussians; mesh: the surface; particles; velocity: the field on its grid; nerfstudio: cameras, "
        "photographs and points",
    )
    parser.add_argument(
        "--scene",
        type=Path,
        metavar="SCENE",
        help="the scene that it was run on: for photographs, and for methods and older submissions that ask for it",
    )
    parser.add_argument("--method", metavar="FILE.py:CLASS", help="the submission's method, where it is not installed")
    times = parser.add_argument_group("which instants (default: all timesteps)")
    times.add_argument(
        "--times", type=_interval, metavar="A:B", help="from second A to second B; either may be left out"
    )
    rate = times.add_mutually_exclusive_group()
    rate.add_argument("--every", type=whole_number(1), default=1, metavar="N", help="each N-th timestep")
    rate.add_argument(
        "--fps",
        type=positive_number("frames", below=1e6),
        metavar="F",
        help="F frames for each second of the recording, between timesteps by the method's own interpolation",
    )
    space = parser.add_argument_group("units and axes (default: the scene's)")
    space.add_argument("--metres", action="store_true", help="lengths in metres, where the scene states its scale")
    space.add_argument(
        "--up",
        choices=("y", "z", "y-down"),
        help="turn gravity against this axis: z for Blender, y-down for viewers of 3D Gaussians",
    )
    space.add_argument(
        "--gravity",
        nargs=3,
        type=float,
        metavar=("X", "Y", "Z"),
        help="the direction along which things fall in the scene, where it does not state it",
    )
    only = parser.add_argument_group("of single formats")
    only.add_argument("--part", choices=("all", "liquid", "background"), help="of ply: which Gaussians (default: all)")
    only.add_argument(
        "--degree",
        type=whole_number(0, 3),
        metavar="0-3",
        help="of ply: degree of the spherical harmonics of view-dependent colours (default: 1)",
    )
    only.add_argument(
        "--backdrop",
        action="store_true",
        default=None,
        help="of ply: a far sphere of the colour that shows through the background, for viewers that know no other "
        "background than black",
    )
    only.add_argument("--mesh-format", choices=("ply", "obj", "usd"), help="of mesh: the files' format (default: ply)")
    only.add_argument(
        "--points",
        type=whole_number(1, 100_000),
        metavar="N",
        help="of nerfstudio: most points to start from, of liquid and of background each (default: 20000)",
    )
    add_replace(parser)


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench export`."""
    given = {name: getattr(arguments, name) for name in _OPTIONS if getattr(arguments, name) is not None}
    for name in given:
        if _OPTIONS[name] != arguments.format:
            arguments.usage_error(f"--{name.replace('_', '-')} goes with --format {_OPTIONS[name]}")
    if arguments.gravity is not None and arguments.up is None:
        arguments.usage_error("--gravity goes with --up")
    from splashbench.export import export_times, place
    from splashbench.files import tree_bytes
    from splashbench.replay import load

    reconstruction = load(arguments.submission, scene=arguments.scene, method=arguments.method)
    times = export_times(reconstruction.times, arguments.times or (None, None), arguments.every, arguments.fps)
    placement = place(reconstruction, metres=arguments.metres, up=arguments.up, gravity=arguments.gravity)
    manifest = _exporter(arguments.format)(
        reconstruction, arguments.out, times, placement, replace=arguments.replace, **given
    )
    size = tree_bytes(arguments.out)
    if arguments.json:
        emit({"out": str(arguments.out), "bytes": size, **manifest.model_dump(mode="json")})
    for note in manifest.notes:
        say(f"note: {note}")
    say(f"{arguments.out}: {_summary(manifest)}; {size / 1e6:.3g} MB")
    return 0


def _exporter(name: str) -> Any:
    from splashbench import export

    return getattr(export, _FORMATS[name])


def _summary(manifest: Manifest) -> str:
    """What was written, how much of it, and in which units."""
    frames = f"{len(manifest.times)} instant{'' if len(manifest.times) == 1 else 's'}"
    counts = [f"{sum(values):,} {name.replace('_', ' ')}" for name, values in manifest.counts.items()]
    up = "axes of the scene" if manifest.up == "scene" else f"{manifest.up} up"
    return f"{manifest.format}, {frames}, {', '.join(counts)}; {manifest.units}, {up}"


def _interval(text: str) -> tuple[float | None, float | None]:
    """First and last second from a text such as 0.5:1.2, :1.2 or 0.5:."""
    parts = text.split(":")
    try:
        low, high = (float(part) if part.strip() else None for part in parts)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no interval of seconds; write it like 0.5:1.2") from None
    if not all(value is None or math.isfinite(value) for value in (low, high)):
        raise argparse.ArgumentTypeError(f"{text!r} is no interval of finite seconds; write it like 0.5:1.2")
    return low, high

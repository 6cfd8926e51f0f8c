"""`splashbench restyle`: the reconstructed liquid with another dye."""

from __future__ import annotations

import argparse
from pathlib import Path

from splashbench.cli.arguments import add_dye, add_replace
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say

_EPILOG = """\
examples:
  splashbench restyle submissions/bowl amber_bowl --dye amber
  splashbench restyle submissions/bowl milk --dye '#f4efe2' --density opaque
  splashbench restyle submissions/bowl for_compositing --dye clear --exr --scene scenes/bowl

The liquid's shape, the background and the container stay. Light is solved for anew: absorption along the way through
the liquid, what a thick layer returns, Fresnel's mirror; highlights and shading stay as they were filmed. The dye that
was filmed is found in the reconstruction itself. Where nothing is seen through it, its density cannot be known.
--density 1 is the dye's own: light that has gone 25 mm has its color. Of a scene without a metric scale the longest
ways through the liquid count as 25 mm.
OUT gets <camera>/<frame>.png, dye.json, and with --exr exr/<camera>/<frame>.exr with opacity, depth, normals, the way
through the liquid, and the background.
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = add_command(
        subparsers,
        "restyle",
        run,
        summary="give the reconstructed liquid another dye",
        description="Render SUBMISSION with its liquid dyed anew, into the new folder OUT.",
        epilog=_EPILOG,
    )
    parser.add_argument("submission", type=Path, metavar="SUBMISSION", help="folder of the submission, with its model")
    parser.add_argument("out", type=Path, metavar="OUT", help="folder to be made")
    add_dye(parser, required=True)
    parser.add_argument(
        "--view",
        action="append",
        metavar="CAMERA",
        help="a camera to render; may be repeated (default: the test views)",
    )
    parser.add_argument(
        "--scene", type=Path, metavar="SCENE", help="the scene, where the submission does not hold its cameras"
    )
    parser.add_argument("--exr", action="store_true", help="also write the buffers as OpenEXR, for compositing")
    add_replace(parser)


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench restyle`."""
    from splashbench.dyes import dye_named
    from splashbench.files import require_folder_place, require_unsealed_place
    from splashbench.replay import load
    from splashbench.restyle import filmed_dye, restyled
    from splashbench.restyle.pictures import filmed_facts, write_restyled

    dye = dye_named(arguments.dye)
    require_folder_place(arguments.out)
    require_unsealed_place(arguments.out)
    reconstruction = load(arguments.submission, scene=arguments.scene)
    views = list(dict.fromkeys(arguments.view or reconstruction.test))
    for name in views:
        reconstruction.camera(name)
    filmed = filmed_dye(reconstruction)
    dyed = restyled(reconstruction, dye, arguments.density, arguments.light, filmed)
    found = filmed_facts(reconstruction, filmed)
    say(_told(found))
    facts = {
        "dye": arguments.dye,
        "density": "opaque" if arguments.density == float("inf") else arguments.density,
        "light": arguments.light,
        "submission_digest": reconstruction.submission.digest,
    }
    count = write_restyled(dyed, arguments.out, views, facts=facts, exr=arguments.exr, replace=arguments.replace)
    say(f"wrote {count} frames into {arguments.out}")
    if arguments.json:
        emit({"out": str(arguments.out), "frames": count, "filmed": found, **facts})
    return 0


def _told(found: dict) -> str:
    """The filmed dye in one or two lines."""
    unit = "per metre" if found["metric"] else "per metre, if the longest ways through the liquid are 25 mm"

    def three(values: list[float]) -> str:
        return ", ".join(f"{value:.0f}" if value >= 100 else f"{value:.3g}" for value in values)

    if found["opaque"]:
        return (
            f"the filmed liquid is opaque, {found['thick_layers']}: its density cannot be known (red, green and blue "
            f"are absorbed by {three(found['absorption_at_least'])} {unit} or more); --density opaque keeps it opaque"
        )
    low, high = found["absorption_low"], found["absorption_high"]
    ranges = ", ".join(f"{a:.3g} to {b:.3g}" for a, b in zip(low, high))
    return (
        f"the filmed dye absorbs {three(found['absorption_per_metre'])} of red, green and blue {unit} ({ranges}); "
        f"its thick layers are {found['thick_layers']}"
    )

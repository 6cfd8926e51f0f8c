"""`splashbench scene check|info|export|place|container`: look a scene over, write it for others, put a container in."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from splashbench.cli.output import add_json, emit, say
from splashbench.cli.scene import place_container as place
from splashbench.cli.scene import reconstruct_container as container

_EPILOG = """\
examples:
  splashbench scene info scenes/bowl_001
  splashbench scene check scenes/bowl_001           every file is read; every fault is listed
  splashbench scene export scenes/bowl_001 NeRF/bowl_001 --format nerfies
  splashbench scene place scenes/bowl_001 bowl_001.glb
  splashbench scene container scenes/bowl_001
"""

_EXPORT_EPILOG = """\
examples:
  splashbench scene export SCENE NeRF/bowl_001 --format nerfies     Deformable-3DGS; the parent's name matters to it
  splashbench scene export SCENE OUT --format colmap                SpacetimeGaussians: a model per timestep
  splashbench scene export SCENE OUT --format blender --blank-test-images      4D-Scaffold-GS

Only training views have pixels, unless --with-test-images asks for the ground truth of the test views too. A code that
is to be scored must not see it: official codes compute their own test figures from it, and some choose by them. Test
views are in the export as poses and times (test_views.json). docs/external_methods.md has the rest.
"""

#: Points of the liquid in each timestep, by default.
POINTS = 2000


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = subparsers.add_parser(
        "scene",
        help="look a scene over, write it for other codes",
        description="A scene is a folder in the released layout, with or without scene.json, or one of NeuroFluid's.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = parser.add_subparsers(dest="action", metavar="check|info|export|place|container", required=True)
    for name, help_text, handler in (
        ("check", "read every file and list every fault", check),
        ("info", "cameras, sizes, times, what is known and unknown", info),
    ):
        action = actions.add_parser(
            name,
            help=help_text,
            description=help_text,
            epilog=_EPILOG,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        action.add_argument("scene", type=Path, help="folder of the scene")
        add_json(action)
        action.set_defaults(handler=handler)
    _register_export(actions)
    place.register(actions)
    container.register(actions)


def _register_export(actions: argparse._SubParsersAction) -> None:
    action = actions.add_parser(
        "export",
        help="write it in the layout that another code reads",
        description="Write SCENE into the folder OUT in the layout that another code reads.",
        epilog=_EXPORT_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    action.add_argument("scene", type=Path, help="folder of the scene")
    action.add_argument("out", type=Path, help="folder of the export, made by the command")
    action.add_argument("--format", required=True, choices=("nerfies", "nerfstudio", "blender", "colmap"))
    images = action.add_mutually_exclusive_group()
    images.add_argument(
        "--with-test-images",
        action="store_true",
        help="write the test views' images too: the ground truth, not for a code whose results are to be scored",
    )
    images.add_argument(
        "--blank-test-images",
        action="store_true",
        help="write black images for the test views, for codes that open them while loading",
    )
    action.add_argument("--masks", action="store_true", help="write liquid masks too, of views that have true images")
    add_points(action)
    action.add_argument("--replace", action="store_true", help="replace OUT when it is an export")
    add_json(action)
    action.set_defaults(handler=export)


def add_points(parser: argparse._ActionsContainer, default: int | None = POINTS) -> None:
    """Add `--points`, the number of initial points of the liquid."""
    parser.add_argument(
        "--points",
        type=_not_negative,
        default=default,
        metavar="N",
        help=f"initial points of the liquid in each timestep, from the masks' visual hull (default {POINTS}; 0: none)",
    )


def _not_negative(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 0 or more")
    return int(text)


def check(arguments: argparse.Namespace) -> int:
    """Handle `splashbench scene check`."""
    from splashbench.scene.inspection import check_scene

    faults = check_scene(arguments.scene)
    if arguments.json:
        emit({"scene": str(arguments.scene), "ok": not faults, "faults": faults})
    for fault in faults:
        say(f"error: {fault}")
    if not faults:
        say(f"{arguments.scene}: no fault found")
    return 1 if faults else 0


def info(arguments: argparse.Namespace) -> int:
    """Handle `splashbench scene info`."""
    from splashbench.scene import Scene
    from splashbench.scene.inspection import describe_scene

    facts = describe_scene(Scene.open(arguments.scene))
    if arguments.json:
        emit(facts)
    else:
        for key, value in facts.items():
            print(f"{key:18} {value if isinstance(value, str) else json.dumps(value)}")
    return 0


def export(arguments: argparse.Namespace) -> int:
    """Handle `splashbench scene export`."""
    from splashbench.observe import initial_points
    from splashbench.scene import Scene
    from splashbench.scene.export import export_scene, remarks

    scene = Scene.open(arguments.scene)
    facts = export_scene(
        scene,
        arguments.out,
        arguments.format,
        initial_points(scene, arguments.points),
        test_images="true" if arguments.with_test_images else "blank" if arguments.blank_test_images else "none",
        masks=arguments.masks,
        replace=arguments.replace,
    )
    notes = remarks(scene, arguments.format, arguments.out)
    if arguments.json:
        emit({"out": str(arguments.out), **facts.model_dump(mode="json"), "remarks": notes})
    for note in notes:
        say(f"note: {note}")
    pixels = {"none": "without images", "blank": "with black images", "true": "with their images, the ground truth"}
    say(
        f"{arguments.out}: {facts.format}, {facts.n_frames} timesteps of {len(facts.train)} training views, "
        f"{len(facts.test)} test views {pixels[facts.test_images]}"
    )
    return 0

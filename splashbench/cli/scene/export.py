"""`splashbench scene export`: write a scene in the layout that another code reads."""

from __future__ import annotations

import argparse
from pathlib import Path

from splashbench.cli.arguments import EXPORT_FORMATS, add_points, add_replace, add_scene
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say

_EPILOG = """\
examples:
  splashbench scene export SCENE NeRF/bowl_001 --format nerfies     Deformable-3DGS; the parent's name matters to it
  splashbench scene export SCENE OUT --format colmap                SpacetimeGaussians: a model per timestep
  splashbench scene export SCENE OUT --format blender --blank-test-images      4D-Scaffold-GS

Only training views have pixels. --with-test-images writes those of the test views too: the ground truth. A code that is
to be scored must not see it: official codes compute test figures from it, and some select a model by them. The export
has the poses and times of the test views in test_views.json. docs/external_methods.md describes the formats.
"""


def register(actions: argparse._SubParsersAction) -> None:
    """Add the action to those of `splashbench scene`."""
    action = add_command(
        actions,
        "export",
        export,
        summary="write it in the layout that another code reads",
        description="Write SCENE into the folder OUT in the layout that another code reads.",
        epilog=_EPILOG,
    )
    add_scene(action)
    action.add_argument("out", type=Path, metavar="OUT", help="folder of the export, made by the command")
    action.add_argument("--format", required=True, choices=EXPORT_FORMATS, help="layout of the export")
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
    add_replace(action)


def export(arguments: argparse.Namespace) -> int:
    """Handle `splashbench scene export`."""
    from splashbench.files import require_unsealed_place
    from splashbench.observe import initial_points
    from splashbench.scene import Scene
    from splashbench.scene.export import export_scene, remarks

    require_unsealed_place(arguments.out)
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

"""`splashbench scene reconstruct-container`: a container that nobody scanned, from the scene's own footage."""

from __future__ import annotations

import argparse
from pathlib import Path

from splashbench.cli.arguments import add_container_masks, add_replace, add_scene
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say

_EPILOG = """\
examples:
  splashbench scene reconstruct-container real_scene/bowl_001 --picture bowl_001.png
  splashbench scene reconstruct-container real_scene_crop/bowl_001 --masks real_scene/bowl_001

For an opaque container without a scan (with one: `splashbench scene place-container`). A plane sweep over what stands
still finds the surface, within container_mask/ of the training cameras. The masks of the test cameras verify it. The
container needs texture, and views that overlap. splashsplat then knows what the container hides; without it it looks
for an upright vessel by itself. Gravity and metric scale stay as they are. SCENE has another digest then: run methods
again.
"""


def register(actions: argparse._SubParsersAction) -> None:
    """Add the action to those of `splashbench scene`."""
    action = add_command(
        actions,
        "reconstruct-container",
        reconstruct_container,
        summary="reconstruct its container from the footage, where there is no scan",
        description="Reconstruct the opaque container in SCENE from its training views, and name it in scene.json.",
        epilog=_EPILOG,
    )
    add_scene(action)
    add_container_masks(action)
    action.add_argument(
        "--picture",
        type=Path,
        metavar="PNG",
        help="draw every camera's image with its outline, its surface beside",
    )
    add_replace(action, "the container that scene.json names")


def reconstruct_container(arguments: argparse.Namespace) -> int:
    """Handle `splashbench scene reconstruct-container`."""
    from splashbench.container.entry import doubtful, require_place
    from splashbench.container.reconstruction import container_from_footage, picture, write_reconstruction
    from splashbench.errors import SplashbenchError
    from splashbench.files import require_picture_place, write_png
    from splashbench.scene import Scene

    scene = Scene.open(arguments.scene)
    if scene.container_transparent:
        raise SplashbenchError(
            f"{scene.directory / 'scene.json'}: the container is transparent; it hides nothing, and its depth cannot be"
            " seen; place a scan (`splashbench scene place-container`)"
        )
    require_place(scene, arguments.replace)
    if arguments.picture is not None:
        require_picture_place(arguments.picture, scene.directory)
    mask_scene = None if arguments.masks is None else Scene.open(arguments.masks)
    say(f"reconstructing the container from {len(scene.train)} training views")
    reconstruction = container_from_footage(scene, mask_scene)
    drawing = None if arguments.picture is None else picture(scene, reconstruction)
    path = write_reconstruction(scene, reconstruction, arguments.replace)
    if drawing is not None:
        write_png(arguments.picture, drawing)
    doubtful_cameras = doubtful(reconstruction.projections)
    if arguments.json:
        emit(
            {
                "scene": str(scene.directory),
                "mesh": str(path),
                "faces": len(reconstruction.mesh.faces),
                "overlap": {name: projection.iou for name, projection in reconstruction.projections.items()},
                "doubtful": doubtful_cameras,
            }
        )
    for name, projection in reconstruction.projections.items():
        held_out = "" if name in scene.train else " (held out)"
        say(f"camera {name}{held_out}: surface and mask overlap {projection.iou:.3f}")
    if doubtful_cameras:
        say(f"note: little overlap in camera {', '.join(doubtful_cameras)}; check it in --picture")
    if scene.container_transparent is None:
        say("note: the container was assumed to be opaque; a transparent one needs a scan")
    say(f"wrote {path}, {len(reconstruction.mesh.faces)} triangles, and scene.json; run methods again")
    return 0

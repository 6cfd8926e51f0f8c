"""`splashbench scene place-container`: say in a scene's scene.json where its scanned container stands."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from splashbench.cli.arguments import add_container_masks, add_replace, add_scene, positive_number
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say

if TYPE_CHECKING:
    from splashbench.container.scene_placement import ScenePlacement
    from splashbench.scene.layout import SceneMeta

# A note is printed where gravity or scale in scene.json differs from the container's by more.
_TILT_DEGREES, _SCALE = 3.0, 1.05

_EPILOG = """\
examples:
  splashbench scene place-container real_scene/bowl_001 meshes/bowl_001.glb --picture bowl_001.png
  splashbench scene place-container real_scene_crop/bowl_001 meshes/bowl_001.glb --masks real_scene/bowl_001

The masks in container_mask/ of the training cameras place the mesh; those of the test cameras verify it. MESH is copied
into SCENE. scene.json then says where it stands, which way is down and how long a scene unit is; what it said of these
before stays. That takes a mesh that stands level in its own coordinates and has a known unit (a scan is in metres).
splashsplat uses all three. SCENE has another digest then: run methods again.
"""


def register(actions: argparse._SubParsersAction) -> None:
    """Add the action to those of `splashbench scene`."""
    action = add_command(
        actions,
        "place-container",
        place_container,
        summary="find where its scanned container stands, for scene.json",
        description="Place the mesh of the container in SCENE by its container masks, and write that to scene.json.",
        epilog=_EPILOG,
    )
    add_scene(action)
    action.add_argument("mesh", type=Path, metavar="MESH", help="the container's mesh: .glb, .ply or .obj")
    add_container_masks(action)
    action.add_argument(
        "--up",
        choices=("x", "-x", "y", "-y", "z", "-z"),
        help="the mesh's direction that points up (default: what fits; y where several do)",
    )
    action.add_argument(
        "--metres-per-unit",
        type=positive_number("metres"),
        default=1.0,
        metavar="M",
        help="length of the mesh's unit (default: 1)",
    )
    action.add_argument(
        "--transparent",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="whether the liquid is seen through the container's walls (default: as scene.json says; else not)",
    )
    action.add_argument("--picture", type=Path, metavar="PNG", help="draw the placed outline over every camera's image")
    add_replace(action, "container, gravity and scale in scene.json")


def place_container(arguments: argparse.Namespace) -> int:
    """Handle `splashbench scene place-container`."""
    from splashbench.container.entry import doubtful, picture
    from splashbench.container.scene_placement import place_in_scene, require_container_place, write_placement
    from splashbench.files import require_picture_place, write_png
    from splashbench.scene import Scene
    from splashbench.scene.container import read_mesh

    scene = Scene.open(arguments.scene)
    require_container_place(scene, arguments.mesh, arguments.replace)
    if arguments.picture is not None:
        require_picture_place(arguments.picture, scene.directory)
    mesh = read_mesh(arguments.mesh)
    mask_scene = None if arguments.masks is None else Scene.open(arguments.masks)
    say("placing the mesh by its masks")
    outcome = place_in_scene(scene, mesh, mask_scene, arguments.up, arguments.metres_per_unit)
    drawing = None if arguments.picture is None else picture(scene, mesh, outcome.placement.pose)
    meta = write_placement(scene, arguments.mesh, outcome, arguments.transparent, arguments.replace)
    if drawing is not None:
        write_png(arguments.picture, drawing)
    placement = outcome.placement
    doubtful_cameras = doubtful(outcome.projections)
    if arguments.json:
        emit(
            {
                "scene": str(scene.directory),
                "pose": placement.pose.tolist(),
                "gravity": meta.gravity,
                "metres_per_unit": meta.metres_per_unit,
                "found_gravity": outcome.gravity,
                "found_metres_per_unit": outcome.metres_per_unit,
                "up_axis": placement.up_axis,
                "up_is_ambiguous": placement.up_is_ambiguous,
                "turn": placement.turn,
                "overlap": {name: projection.iou for name, projection in outcome.projections.items()},
                "doubtful": doubtful_cameras,
            }
        )
    for name, projection in outcome.projections.items():
        distance = projection.contour_median_px
        off = "" if distance is None else f", outlines {distance:.2f} px apart"
        held_out = "" if name in scene.train else " (held out)"
        say(f"camera {name}{held_out}: mesh and mask overlap {projection.iou:.3f}{off}")
    _say_what_is_doubtful(outcome, doubtful_cameras, meta)
    say(f"wrote {scene.directory / 'scene.json'}: a scene unit is {meta.metres_per_unit:.4g} m; run methods again")
    return 0


def _say_what_is_doubtful(outcome: ScenePlacement, doubtful_cameras: list[str], meta: SceneMeta) -> None:
    placement = outcome.placement
    if doubtful_cameras:
        say(f"note: little overlap in camera {', '.join(doubtful_cameras)}; check it in --picture")
    if placement.up_is_ambiguous:
        say(f"note: the mesh fits with other directions up as well; {placement.up_axis} was chosen, see --up")
    if placement.turn != "determined":
        looks = "at every turn" if placement.turn == "free" else f"at {placement.equivalent_turns} turns"
        say(f"note: the container looks the same {looks}; one was chosen")
    angle = math.degrees(
        math.acos(max(-1.0, min(1.0, sum(a * b for a, b in zip(meta.gravity or (), outcome.gravity)))))
    )
    if angle > _TILT_DEGREES:
        say(f"note: scene.json's gravity stays, {angle:.0f} degrees from the container's; --replace replaces it")
    if not 1 / _SCALE < (meta.metres_per_unit or 0) / outcome.metres_per_unit < _SCALE:
        say(
            f"note: scene.json's metres_per_unit stays, {meta.metres_per_unit:.4g}; by the mesh it is"
            f" {outcome.metres_per_unit:.4g}, see --metres-per-unit; --replace replaces it"
        )

"""`splashbench scene place`: say in a scene's scene.json where its scanned container stands."""

from __future__ import annotations

import argparse
from pathlib import Path

from splashbench.cli.output import add_json, emit, say

_EPILOG = """\
examples:
  splashbench scene place data/real_scene/bowl_001 data/meshes/bowl_001.glb --picture bowl_001.png
  splashbench scene place data/real_scene_crop/bowl_001 data/meshes/bowl_001.glb --masks data/real_scene/bowl_001

The masks in container_mask/ of the training cameras place the mesh, those of the test cameras verify it. MESH is copied
into the scene, and scene.json says where it stands, what is down (a container stands upright) and how long a scene unit
is (a scan is in metres). splashsplat uses all three. The scene is another one for the scorer then: run methods again.
"""


def register(actions: argparse._SubParsersAction) -> None:
    """Add the action to those of `splashbench scene`."""
    action = actions.add_parser(
        "place",
        help="find where its scanned container stands, for scene.json",
        description="Place the mesh of the container in SCENE by its container masks, and write that to scene.json.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    action.add_argument("scene", type=Path, help="folder of the scene")
    action.add_argument("mesh", type=Path, help="the container's mesh: .glb, .ply or .obj")
    action.add_argument(
        "--masks", type=Path, metavar="SCENE", help="the scene before it was cropped, which has the container masks"
    )
    action.add_argument(
        "--up",
        choices=("x", "-x", "y", "-y", "z", "-z"),
        help="the mesh's direction that points up (default: what fits; y where several do)",
    )
    action.add_argument(
        "--metres-per-unit", type=_positive, default=1.0, metavar="M", help="length of the mesh's unit (default 1)"
    )
    action.add_argument("--transparent", action="store_true", help="the liquid is seen through the container's walls")
    action.add_argument("--picture", type=Path, metavar="PNG", help="draw the placed outline over every camera's image")
    action.add_argument("--replace", action="store_true", help="replace what scene.json says of a container")
    add_json(action)
    action.set_defaults(handler=place)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is no length")
    return value


def place(arguments: argparse.Namespace) -> int:
    """Handle `splashbench scene place`."""
    from splashbench.errors import SplashbenchError
    from splashbench.files import require_file_place, write_png
    from splashbench.prepare.container.released import picture, place_in_scene, write_placement
    from splashbench.scene import Scene
    from splashbench.scene.container import read_mesh

    scene = Scene.open(arguments.scene)
    if scene.meta is not None and scene.meta.container_mesh is not None and not arguments.replace:
        raise SplashbenchError(f"{scene.directory / 'scene.json'} has a container already; --replace places it anew")
    if arguments.picture is not None:
        require_file_place(arguments.picture)
    if not arguments.mesh.is_file():
        raise SplashbenchError(f"{arguments.mesh} is no file; give the container's mesh")
    mesh = read_mesh(arguments.mesh)
    masked = None if arguments.masks is None else Scene.open(arguments.masks)
    found = place_in_scene(scene, mesh, masked, arguments.up, arguments.metres_per_unit)
    write_placement(scene, arguments.mesh, found, True if arguments.transparent else None)
    if arguments.picture is not None:
        write_png(arguments.picture, picture(scene, mesh, found))
    if arguments.json:
        emit(
            {
                "scene": str(scene.directory),
                "pose": found.placement.pose.tolist(),
                "gravity": list(found.gravity),
                "metres_per_unit": found.metres_per_unit,
                "up_axis": found.placement.up_axis,
                "up_is_ambiguous": found.placement.up_is_ambiguous,
                "turn": found.placement.turn,
                "overlap": {name: projection.iou for name, projection in found.projections.items()},
            }
        )
    for name, projection in found.projections.items():
        distance = projection.contour_median_px
        off = "" if distance is None else f", outlines {distance:.2f} px apart"
        held_out = "" if name in scene.train else " (held out)"
        say(f"camera {name}{held_out}: mesh and mask overlap {projection.iou:.3f}{off}")
    if found.placement.up_is_ambiguous:
        say(f"note: the mesh fits with other directions up as well; {found.placement.up_axis} was taken, see --up")
    say(f"wrote {scene.directory / 'scene.json'}: a scene unit is {found.metres_per_unit:.4g} m")
    return 0

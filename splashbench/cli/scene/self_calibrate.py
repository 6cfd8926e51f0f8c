"""`splashbench scene self-calibrate`: find clocks, cameras, exposures and masks that are other than the scene says."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splashbench.cli.arguments import add_replace, add_scene
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say

if TYPE_CHECKING:
    from splashbench.scene import Scene
    from splashbench.selfcalibration import SelfCalibration

_EPILOG = """\
examples:
  splashbench scene self-calibrate real_scene/bowl_001
  splashbench scene self-calibrate real_scene/bowl_001 --out corrected/bowl_001

It looks at the training views alone: at what they show in common of the still surroundings, and at droplets in their
masks; and it holds masks against photographs. Where masks are empty, liquid is what changes in these. --out writes a
copy for any method to be run on: photographs evenly exposed and straightened, with the cameras, the clocks and the
masks that were found. Test views stay as they are. splashsplat does the same by itself before it fits.
`splashbench masks sheet OUT --out PNG` draws its outlines.
"""


def register(actions: argparse._SubParsersAction) -> None:
    """Add the action to those of `splashbench scene`."""
    action = add_command(
        actions,
        "self-calibrate",
        self_calibrate,
        summary="find clocks, cameras, exposures and masks that are other than it says",
        description="Find by the footage of SCENE which clocks, cameras, exposures and masks are other than it says.",
        epilog=_EPILOG,
    )
    add_scene(action)
    action.add_argument("--out", type=Path, metavar="OUT", help="write a corrected copy of the scene into this folder")
    add_replace(action)


def self_calibrate(arguments: argparse.Namespace) -> int:
    """Handle `splashbench scene self-calibrate`."""
    from splashbench.errors import SplashbenchError
    from splashbench.files import atomic_directory
    from splashbench.scene import Scene
    from splashbench.selfcalibration import write_calibrated

    scene, out = Scene.open(arguments.scene), arguments.out
    if len(scene.train) < 2:
        raise SplashbenchError(
            f"{arguments.scene} has one training view; self-calibration compares views, give a scene with two or more"
        )
    if out is None:
        found = _found(scene)
    else:
        if out.resolve().is_relative_to(scene.directory.resolve()):
            raise SplashbenchError(f"{out} is within the scene {arguments.scene}; give another place for the copy")
        # The place is refused before the minutes that the search takes.
        with atomic_directory(
            out, replace=arguments.replace, holds="train_meta.json", inputs=[scene.directory]
        ) as staging:
            found = _found(scene)
            write_calibrated(scene, found, staging)
    told = scene.training().cameras
    if arguments.json:
        written = None if out is None else {"out": str(out), "digest": Scene.open(out).digest}
        emit({"scene": str(arguments.scene), **_facts(scene, found), "written": written})
    else:
        for line in found.lines(told) or ["cameras, clocks and masks are as told"]:
            print(line)
    if out is not None:
        say(f"{out} is ready: {'the scene as found' if found else 'the scene as it was, since nothing was found'}")
    return 0


def _found(scene: Scene) -> SelfCalibration:
    from splashbench.selfcalibration import self_calibration

    return self_calibration(scene.training(), told=say)


def _facts(scene: Scene, found: SelfCalibration) -> dict[str, Any]:
    """What was found, in values that JSON has: seconds, degrees, scene units, pixels, stops (EV)."""
    from splashbench.selfcalibration.cameras import corrections

    told, fitted = scene.training().cameras, found.cameras
    return {
        "lines": found.lines(told),
        "clocks": {name: found.seconds_per_step * offset.timesteps for name, offset in found.offsets.items()},
        "knocks": {
            name: {"timestep": knock.frame, "degrees": knock.degrees, "rotation": knock.rotation.tolist()}
            for name, knock in found.knocks.items()
        },
        "cameras": fitted
        and {
            "changed": fitted.kinds,
            "error_before": fitted.before,
            "error_after": fitted.after,
            "points": fitted.points,
            "k1": fitted.distortion,
            "corrections": {name: vars(change) for name, change in corrections(fitted, told).items()},
        },
        "exposures": {
            name: {"stops": response.stops.tolist(), "contrast": response.contrast}
            for name, response in found.responses.items()
        },
        "masks": {
            name: {"timesteps": sorted(outline.masks.bits), "reach_beyond_px": outline.beyond}
            for name, outline in found.outlines.items()
        },
        "noise": dict(found.noisy),
    }

"""Gaussians as .ply files of 3D Gaussian Splatting, one for each instant: viewers play the folder as a sequence.

Liquid and background are Gaussians alike there, and what is in front hides what is behind. How a method composes the
two otherwise is not in such a file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.export.backdrop import backdrop_color
from splashbench.export.coloured import Coloured, coloured, require_finite
from splashbench.export.gaussian_files import write_gaussians
from splashbench.export.harmonics import MAX_DEGREE, Viewpoints, viewpoints
from splashbench.export.instants import all_or
from splashbench.export.manifest import Manifest, export_folder, frame_files, nothing_of, write_manifest
from splashbench.export.placement import Placement
from splashbench.export.sphere import enclosing_sphere
from splashbench.progress import track
from splashbench.replay import Reconstruction
from splashbench.scene import Gaussians
from splashbench.srgb import hex_color

Part = Literal["all", "liquid", "background"]
PARTS: tuple[Part, ...] = get_args(Part)
DEFAULT_DEGREE = 1
#: The file of a background that is exported alone: it is the same at all times.
BACKGROUND = "background.ply"

_BY_DEPTH = (
    "the files hold Gaussians, which viewers draw by depth: where the method composes liquid and background otherwise, "
    "such as behind a container's wall or through its glass, they look different"
)
_NO_BACKGROUND = "the method keeps no background apart; the files hold the liquid alone"
_MIXED = (
    "the method has liquid and background in one set of Gaussians: what the silhouettes pick out is the liquid, and "
    "the rest stands still in the files, as it is at the first timestep"
)
_CHANGING = "the method's Gaussians change with the viewpoint: the files have those seen from the cameras' mean place"


def export_gaussians(
    reconstruction: Reconstruction,
    out: Path | str,
    times: NDArray[np.float64] | None = None,
    placement: Placement | None = None,
    *,
    part: Part = "all",
    degree: int = DEFAULT_DEGREE,
    backdrop: bool = False,
    replace: bool = False,
) -> Manifest:
    """Write frames/frame0001.ply and so on into the folder `out`: the Gaussians at each of `times` [F], in seconds.

    Args:
        times: all timesteps by default; between them the method interpolates.
        placement: units and axes, the scene's own by default.
        part: "liquid", "background" (one file, background.ply), or "all": both in each file.
        degree: of the spherical harmonics of the colours, 0 (the same from everywhere) to 3.
        backdrop: whether a far sphere around the background has the colour that shows through its Gaussians.
        replace: whether an earlier export in `out` may go.

    Gaussians that no renderer draws, fainter than one grey level, are left out. Raises SplashbenchError for a method
    that hands out no Gaussians, for Gaussians that are not finite, and for places that are taken.
    """
    if part not in PARTS or not 0 <= degree <= MAX_DEGREE:
        raise SplashbenchError(f"part {part!r} or degree {degree} is none; give {', '.join(PARTS)}, and 0 to 3")
    if backdrop and part == "liquid":
        raise SplashbenchError("a backdrop goes with a background; export part all or background, or no backdrop")
    instants, placed = all_or(reconstruction, times), placement or Placement()
    cameras = [reconstruction.cameras[name].center for name in reconstruction.train]
    seen_from = viewpoints(cameras, _middle(reconstruction, instants, part))
    notes = [] if part == "background" else [_BY_DEPTH]
    options: dict[str, object] = {"part": part, "degree": degree, "backdrop": backdrop}
    groups: dict[str, Coloured] = {}
    with export_folder(reconstruction, out, replace) as staging:
        static = None
        if part != "liquid":
            static = coloured(reconstruction, reconstruction.static_gaussians, seen_from, placed, degree)
        if static is not None:
            groups["background"] = static
            color = backdrop_color(reconstruction)
            options["background_color"] = None if color is None else hex_color(color)
            if color is not None and backdrop:
                groups["backdrop"] = _sphere(color, cameras, static, placed, degree)
            elif color is not None:
                notes.append(
                    f"{hex_color(color)} shows through the background's Gaussians; give your viewer this background "
                    "colour, or add a sphere of it (--backdrop)"
                )
            notes += [_MIXED] if reconstruction.submission.identity.mixed else []
        elif part == "all":
            notes.append(_NO_BACKGROUND)
        counts = {name: [len(group)] for name, group in groups.items()}
        fixed = static is not None and static.fixed
        if part == "background":
            files, instants = [BACKGROUND], instants[:1]
            write_gaussians(staging / BACKGROUND, list(groups.values()))
        else:
            files = frame_files(len(instants), "ply")
            counts = {name: values * len(files) for name, values in counts.items()} | {"liquid": []}
            for name, time in zip(files, track(instants, "exporting Gaussians", total=len(instants))):
                liquid = _liquid(reconstruction, float(time), seen_from, placed, degree)
                write_gaussians(staging / name, [liquid, *groups.values()])
                counts["liquid"].append(len(liquid))
                fixed |= liquid.fixed
        notes += [_CHANGING] if fixed else []
        return write_manifest(
            staging, reconstruction, "ply", instants, placed, files, options=options, counts=counts, notes=notes
        )


def _liquid(
    reconstruction: Reconstruction, time: float, seen_from: Viewpoints, placement: Placement, degree: int
) -> Coloured:
    """The liquid at `time` (seconds), as it is exported."""
    found = coloured(reconstruction, lambda eye: reconstruction.gaussians(time, eye), seen_from, placement, degree)
    if found is None:
        raise _no_liquid(reconstruction)
    return found


def _sphere(
    color: NDArray[np.float64],
    cameras: list[NDArray[np.float64]],
    static: Coloured,
    placement: Placement,
    degree: int,
) -> Coloured:
    """A sphere of `color` around the Gaussians `static` and the `cameras`, in the export's places."""
    inside = np.concatenate([static.gaussians.means, placement.points(np.stack(cameras))])
    middle = np.median(inside, axis=0)
    reach = float(np.linalg.norm(inside - middle, axis=1).max())
    return Coloured.plain(enclosing_sphere(color, middle, reach), degree)


def _middle(reconstruction: Reconstruction, times: NDArray[np.float64], part: Part) -> NDArray[np.float64]:
    """About where the Gaussians are, [3]: what viewpoints lie around. Raises SplashbenchError where there are none."""
    if part == "background":
        found = reconstruction.static_gaussians()
        if found is None:
            raise nothing_of(reconstruction, "Gaussians of a background", "export its liquid (--part liquid)")
        return _median(found, reconstruction)
    order = np.argsort(np.abs(times - times[len(times) // 2]), kind="stable")  # early on there may be no liquid yet
    for time in times[order]:
        liquid = reconstruction.gaussians(float(time))
        if liquid is None:
            raise _no_liquid(reconstruction)
        if len(liquid):
            return _median(liquid, reconstruction)
    return np.zeros(3)


def _no_liquid(reconstruction: Reconstruction) -> SplashbenchError:
    return nothing_of(reconstruction, "Gaussians of its liquid", "export its particles, its mesh or its background")


def _median(gaussians: Gaussians, reconstruction: Reconstruction) -> NDArray[np.float64]:
    require_finite(gaussians, reconstruction)
    return np.median(gaussians.means, axis=0).astype(np.float64) if len(gaussians) else np.zeros(3)

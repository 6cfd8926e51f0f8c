"""The liquid's surface as closed meshes: a .ply or .obj for each instant, or one USD file of all (usd.py)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.export.instants import all_or
from splashbench.export.manifest import Manifest, export_folder, frame_files, nothing_of, write_manifest
from splashbench.export.mesh_files import PlacedMesh, write_obj_mesh, write_ply_mesh
from splashbench.export.placement import Placement
from splashbench.export.surface import surface_mesh
from splashbench.progress import track
from splashbench.replay import Reconstruction

MeshFormat = Literal["ply", "obj", "usd"]
MESH_FORMATS: tuple[MeshFormat, ...] = get_args(MeshFormat)
USD_FILE = "liquid.usdc"

_NO_VELOCITY = "the method hands out no velocity; the meshes have none"
_OBJ_HAS_NONE = "OBJ has no place for velocities; .ply and USD have"
_USD_UP = "USD has to state y or z as up, and says y here; the scene's axes are as they were (turn them by --up)"
_USD_UNIT = "USD has to state a unit, and says metres here; the scene's own are not known"


def export_meshes(
    reconstruction: Reconstruction,
    out: Path | str,
    times: NDArray[np.float64] | None = None,
    placement: Placement | None = None,
    *,
    mesh_format: MeshFormat = "ply",
    replace: bool = False,
) -> Manifest:
    """Write a closed mesh of the liquid at each of `times` [F] (seconds) into the folder `out`.

    Args:
        times: all timesteps by default; between them the method interpolates.
        placement: units and axes, the scene's own by default.
        mesh_format: "ply" has normals and velocities (vx vy vz), "obj" normals; "usd" is one file with both.
        replace: whether an earlier export in `out` may go.

    An instant without liquid is a file without vertices. Raises SplashbenchError for a method without a signed
    distance, for USD where usd-core is not installed, and for places that are taken.
    """
    if mesh_format not in MESH_FORMATS:
        raise SplashbenchError(f"{mesh_format!r} is no format of meshes; give one of {', '.join(MESH_FORMATS)}")
    instants, placed = all_or(reconstruction, times), placement or Placement()
    stage = None
    with export_folder(reconstruction, out, replace) as staging:
        files = frame_files(len(instants), mesh_format)
        if mesh_format == "usd":
            from splashbench.export.usd import MeshStage

            files = [USD_FILE]
            stage = MeshStage(staging / USD_FILE, instants, placed, reconstruction.metres_per_unit)
        counts: dict[str, list[int]] = {"vertices": [], "faces": []}
        still = False
        for frame, time in enumerate(track(instants, "exporting meshes", total=len(instants))):
            mesh = mesh_at(reconstruction, float(time), placed)
            still |= mesh.velocities is None and len(mesh.vertices) > 0
            counts["vertices"].append(len(mesh.vertices))
            counts["faces"].append(len(mesh.faces))
            if stage is not None:
                stage.add(frame, mesh)
            elif mesh_format == "ply":
                write_ply_mesh(staging / files[frame], mesh)
            else:
                write_obj_mesh(staging / files[frame], mesh)
        if stage is not None:
            stage.save()
        notes = [_NO_VELOCITY] if still else [_OBJ_HAS_NONE] if mesh_format == "obj" else []
        if mesh_format == "usd":
            notes += [] if placed.up in ("y", "z") else [_USD_UP]
            notes += [] if placed.units == "metres" or reconstruction.metres_per_unit is not None else [_USD_UNIT]
        return write_manifest(
            staging,
            reconstruction,
            "mesh",
            instants,
            placed,
            files,
            options={"mesh_format": mesh_format},
            counts=counts,
            notes=notes,
        )


def mesh_at(reconstruction: Reconstruction, time: float, placement: Placement) -> PlacedMesh:
    """The surface at `time` (seconds), placed. Raises SplashbenchError for a method without a signed distance."""
    distance = reconstruction.surface(time)
    if distance is None:
        raise nothing_of(reconstruction, "signed distance", "export its particles (--format particles)")
    mesh = surface_mesh(distance)
    field = reconstruction.velocity(time)
    velocities = None if field is None else field.at(mesh.vertices)
    if velocities is not None and not np.isfinite(velocities).all():
        directory, name = reconstruction.submission.directory, reconstruction.name
        raise SplashbenchError(f"{directory}: velocities of method {name} are not finite; fit again")
    return PlacedMesh(
        placement.points(mesh.vertices),
        mesh.faces,
        placement.directions(mesh.normals),
        None if velocities is None else placement.points(velocities),
        distance.voxel * placement.scale,
    )

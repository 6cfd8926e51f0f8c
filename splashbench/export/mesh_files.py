"""One closed mesh as a file: binary .ply with velocities, or Wavefront .obj."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.files import atomic_path
from splashbench.files.ply import write_vertices

# A file of float32 must keep vertices apart that lie near one node: they may be a 500th of a voxel from it.
_FINEST = 1 / 5000


@dataclass(frozen=True)
class PlacedMesh:
    """A surface as it is exported.

    Attributes:
        vertices: [V, 3], in the export's units. faces: [F, 3] int32, counter-clockwise from outside.
        normals: [V, 3], unit vectors that point out of the liquid.
        velocities: [V, 3], of the liquid there, in the export's units per second; None where they are not known.
        voxel: spacing of the grid that it was made on, in the export's units.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    normals: NDArray[np.float64]
    velocities: NDArray[np.float64] | None
    voxel: float


def write_ply_mesh(path: Path, mesh: PlacedMesh) -> None:
    """Write `mesh` as binary .ply: x y z, nx ny nz and, where they are known, vx vy vz of each vertex."""
    largest = np.abs(mesh.vertices).max(initial=0.0)
    coarse = np.spacing(np.float32(largest)) > mesh.voxel * _FINEST
    tables: dict[tuple[str, ...], NDArray] = {
        ("x", "y", "z"): mesh.vertices.astype(np.float64 if coarse else np.float32),
        ("nx", "ny", "nz"): mesh.normals.astype(np.float32),
    }
    if mesh.velocities is not None:
        tables["vx", "vy", "vz"] = mesh.velocities.astype(np.float32)
    write_vertices(path, tables, mesh.faces)


def write_obj_mesh(path: Path, mesh: PlacedMesh) -> None:
    """Write `mesh` as Wavefront .obj: v and vn lines, and faces of both."""
    lines = [f"# {len(mesh.vertices)} vertices, {len(mesh.faces)} triangles"]
    lines += ["v {:.9g} {:.9g} {:.9g}".format(*row) for row in mesh.vertices.tolist()]
    lines += ["vn {:.5g} {:.5g} {:.5g}".format(*row) for row in mesh.normals.tolist()]
    lines += ["f {0}//{0} {1}//{1} {2}//{2}".format(*row) for row in (mesh.faces + 1).tolist()]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="ascii")

"""Meshes over time as one USD file, by OpenUSD (the package usd-core, which the extra [usd] installs).

The mesh /liquid has a time sample for each instant. Its topology changes from one to the next, so readers hold a sample
until the next one, and its velocities say how it moves in between (OpenUSD, UsdGeomPointBased).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.export.mesh_files import PlacedMesh
from splashbench.export.placement import Placement
from splashbench.files import as_asked

#: Of a single instant, which has no step.
_FPS = 24.0
# A time code this near to a whole frame is one: programs ask for whole frames.
_SAME = 1e-3


class MeshStage:
    """A USD file under way: meshes are added instant by instant, then saved.

    times: [F] seconds. Frame 1 is the first of them; frames per second are those of the shortest step, so that each
    instant has a frame of its own. metres_per_unit: of the scene, or None where it is not known.

    Raises SplashbenchError where usd-core is not installed.
    """

    def __init__(
        self, path: Path, times: NDArray[np.float64], placement: Placement, metres_per_unit: float | None
    ) -> None:
        try:
            from pxr import Usd, UsdGeom, Vt
        except ImportError:
            raise SplashbenchError(
                f"{path.name} needs the package usd-core; in a checkout: pip install -c constraints.txt -e '.[usd]', "
                "or take --mesh-format ply"
            ) from None
        self._vt, self._path = Vt, path
        fps = 1 / float(np.diff(times).min()) if len(times) > 1 else _FPS
        codes = 1 + (times - times[0]) * fps
        self._codes = np.where(np.abs(codes - codes.round()) < _SAME, codes.round(), codes)
        self._stage = Usd.Stage.CreateNew(str(path))
        z_up = placement.up == "z"
        UsdGeom.SetStageUpAxis(self._stage, UsdGeom.Tokens.z if z_up else UsdGeom.Tokens.y)
        metres = 1.0 if placement.units == "metres" else metres_per_unit
        UsdGeom.SetStageMetersPerUnit(self._stage, metres or 1.0)
        self._stage.SetTimeCodesPerSecond(fps)
        self._stage.SetFramesPerSecond(fps)
        self._stage.SetStartTimeCode(float(self._codes[0]))
        self._stage.SetEndTimeCode(float(self._codes[-1]))
        self._mesh = UsdGeom.Mesh.Define(self._stage, "/liquid")
        self._stage.SetDefaultPrim(self._mesh.GetPrim())
        self._mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        self._mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)

    def add(self, frame: int, mesh: PlacedMesh) -> None:
        """Add the mesh of instant number `frame`, which may be empty."""
        code = float(self._codes[frame])
        vertices = mesh.vertices.astype(np.float32)
        extent = np.stack([vertices.min(axis=0), vertices.max(axis=0)]) if len(vertices) else np.zeros((2, 3))
        usd = self._mesh
        usd.CreatePointsAttr().Set(self._vectors(vertices), code)
        usd.CreateNormalsAttr().Set(self._vectors(mesh.normals), code)
        usd.CreateFaceVertexCountsAttr().Set(self._integers(np.full(len(mesh.faces), 3)), code)
        usd.CreateFaceVertexIndicesAttr().Set(self._integers(mesh.faces.ravel()), code)
        usd.CreateExtentAttr().Set(self._vectors(extent), code)
        if mesh.velocities is not None:
            usd.CreateVelocitiesAttr().Set(self._vectors(mesh.velocities), code)

    def save(self) -> None:
        """Write the file. Raises SplashbenchError where OpenUSD does not say why it could not."""
        if not self._stage.GetRootLayer().Save():
            raise SplashbenchError(
                f"{as_asked(self._path)} could not be written by OpenUSD; look at its place and disk"
            )

    def _vectors(self, table: NDArray) -> Any:
        return self._vt.Vec3fArray.FromNumpy(np.ascontiguousarray(table, dtype=np.float32))

    def _integers(self, values: NDArray) -> Any:
        return self._vt.IntArray.FromNumpy(np.ascontiguousarray(values, dtype=np.int32))

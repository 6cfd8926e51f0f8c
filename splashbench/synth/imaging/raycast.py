"""Ray casting with Embree: nearest hits and occlusion for many rays at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float32]
FAR = np.float32(1e30)


@dataclass(frozen=True, eq=False)
class Hits:
    """Nearest hits of R rays.

    `distance` [R] metres, FAR where nothing was hit; `geometry` [R] index of the mesh in the order given, -1 for none;
    `triangle` [R]; `normal` [R, 3] unit geometric normals facing the ray's origin; `weights` [R, 3] barycentric.
    """

    distance: NDArray[np.float32]
    geometry: NDArray[np.int32]
    triangle: NDArray[np.int32]
    normal: Points
    weights: Points


class Tracer:
    """A set of triangle meshes to cast rays at."""

    def __init__(self, meshes: list[tuple[Points, NDArray[np.int32]]]) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene: Any = EmbreeScene()
        # Embree keeps pointers into these objects: they have to live as long as the scene does.
        self._kept = [
            TriangleMesh(self._scene, np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32))
            for vertices, faces in meshes
        ]

    def nearest(self, origins: Points, directions: Points) -> Hits:
        """The first thing each ray meets; `origins` and unit `directions` are [R, 3]."""
        origins, directions = _rays(origins, directions)
        hits = self._scene.run(origins, directions, output=True)
        geometry = hits["geomID"].astype(np.int32)
        missed = geometry < 0
        normal = hits["Ng"].astype(np.float32)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normal /= np.where(length > 0, length, 1)
        away = np.einsum("ij,ij->i", normal, directions) > 0
        normal[away] *= -1
        u, v = hits["u"], hits["v"]
        return Hits(
            distance=np.where(missed, FAR, hits["tfar"]).astype(np.float32),
            geometry=geometry,
            triangle=hits["primID"].astype(np.int32),
            normal=normal,
            weights=np.stack([1 - u - v, u, v], axis=1),
        )

    def occluded(self, origins: Points, directions: Points) -> NDArray[np.bool_]:
        """Whether anything lies along each ray [R]."""
        origins, directions = _rays(origins, directions)
        if not len(directions):
            return np.zeros(0, np.bool_)
        return np.asarray(self._scene.run(origins, directions, query="OCCLUDED")) != -1


def _rays(origins: Points, directions: Points) -> tuple[Points, Points]:
    directions = np.ascontiguousarray(directions, np.float32)
    origins = np.ascontiguousarray(np.broadcast_to(np.asarray(origins, np.float32), directions.shape))
    return origins, directions

"""The container that the liquid is poured into, as a triangle mesh in scene units: reading and checking it.

scene.json names the file (`container_mesh`: PLY, GLB or OBJ) and its place (`container_pose`). A mesh may come from a
stranger: trimesh reads it in a process of its own (mesh_process.py), and opens no other file.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import read_plain

#: endings of mesh files that are read
FORMATS = (".ply", ".glb", ".obj")
MAX_FACES = 2_000_000
# Scene units: nothing real comes near, and squares stay finite.
_LARGEST = 1e9
# Vertices as near as this, relative to the mesh's size, are one: files split them along seams of textures.
_SAME_VERTEX = 1e-7


@dataclass(frozen=True, eq=False)
class ContainerMesh:
    """A triangle mesh: `vertices` float64 [V, 3] in scene units, `faces` int64 [F, 3] of indices into them.

    Vertices at one place are one vertex, and no face is without area in this sense (two equal corners).
    Raises ValueError when an index is out of range, an entry is not finite, or no face is left.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]

    def __post_init__(self) -> None:
        vertices = np.array(self.vertices, dtype=np.float64)
        faces = np.array(self.faces, dtype=np.int64)
        if vertices.ndim != 2 or vertices.shape[1:] != (3,) or faces.ndim != 2 or faces.shape[1:] != (3,):
            raise ValueError(f"vertices are {vertices.shape} and faces {faces.shape}, not [V, 3] and [F, 3]")
        if not (np.abs(vertices) <= _LARGEST).all():
            raise ValueError(f"vertices that are not finite or beyond {_LARGEST:g}")
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise ValueError(f"faces that name vertices which are not there (of {len(vertices)})")
        vertices, faces = _merged(vertices, faces)
        if not len(faces):
            raise ValueError("no triangle")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        vertices.setflags(write=False)
        faces.setflags(write=False)

    @property
    def triangles(self) -> NDArray[np.float64]:
        """Corners of the faces, [F, 3, 3] scene units."""
        return self.vertices[self.faces]

    @cached_property
    def is_closed(self) -> bool:
        """Whether it encloses a volume: every edge lies in an even number of faces."""
        return bool((np.unique(self._edges, return_counts=True)[1] % 2 == 0).all())

    @cached_property
    def is_oriented(self) -> bool:
        """Whether neighbouring faces agree on inside and outside: every edge runs both ways equally often."""
        forward = self.faces < np.roll(self.faces, -1, axis=1)
        _, edge = np.unique(self._edges, return_inverse=True)
        return not np.bincount(edge.ravel(), weights=np.where(forward, 1.0, -1.0).ravel()).any()

    @property
    def _edges(self) -> NDArray[np.int64]:
        """A number for the undirected edge that starts at each corner, [3 F]."""
        ends = np.roll(self.faces, -1, axis=1)
        return (np.minimum(self.faces, ends) * len(self.vertices) + np.maximum(self.faces, ends)).ravel()

    def placed(self, pose: ArrayLike) -> ContainerMesh:
        """The mesh moved by `pose` [4, 4], mesh to scene; it may scale and shear.

        Raises ValueError where that leaves no mesh, or one beyond all bounds.
        """
        matrix = np.asarray(pose, dtype=np.float64)
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused
            vertices = self.vertices @ matrix[:3, :3].T + matrix[:3, 3]
        return ContainerMesh(vertices, self.faces)


def _merged(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Without unused vertices, with vertices at one place merged, and without the faces that this makes degenerate."""
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    if len(vertices):
        low = vertices.min(axis=0)
        size = float((vertices.max(axis=0) - low).max()) or 1.0
        raster = np.rint((vertices - low) / (size * _SAME_VERTEX)).astype(np.int64)
        _, first, merged = np.unique(raster, axis=0, return_index=True, return_inverse=True)
        vertices, faces = vertices[first], merged.ravel()[faces]
    a, b, c = faces.T
    return vertices, faces[(a != b) & (b != c) & (c != a)]


def mesh_path(directory: Path, name: str) -> Path:
    """The file that scene.json in `directory` names as `container_mesh`.

    Raises SplashbenchError for a name that leads out of the folder or has another ending than FORMATS.
    """
    path = PurePosixPath(name)
    where = f"{directory / 'scene.json'}: container_mesh"
    if path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name or not path.name:
        raise SplashbenchError(f"{where} is {name!r}; give a path within the scene's folder")
    if path.suffix.lower() not in FORMATS:
        raise SplashbenchError(f"{where} is {name!r}; convert the mesh to one of {', '.join(FORMATS)}")
    return Path(directory) / path


def copy_mesh(source: Path, target: Path, name: str) -> None:
    """Copy the file that scene.json in `source` names as `container_mesh` to its place in the scene `target`."""
    from splashbench.scene import mesh_process

    content = read_plain(mesh_path(source, name), mesh_process.MAX_FILE_BYTES)
    path = Path(target, name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def read_mesh(path: Path) -> ContainerMesh:
    """Read a PLY (ASCII or binary), GLB or OBJ file, every part of it where its scene graph puts it.

    Textures, materials and files that it refers to are not read. Raises SplashbenchError naming the file.
    """
    from splashbench.scene import mesh_process

    path = Path(path)
    try:
        return ContainerMesh(*mesh_process.decode(path, MAX_FACES))
    except FileNotFoundError:
        raise SplashbenchError(
            f"{path} does not exist; restore the container's mesh, or take container_mesh out of scene.json"
        ) from None
    except OSError as error:
        raise SplashbenchError(f"{path} cannot be read ({error}); restore it") from None
    except ValueError as error:
        raise SplashbenchError(f"{path} is not a readable mesh ({error}); export it again") from None

"""Coloured points as a binary PLY file, with the normals (zero) that codes built on 3D Gaussian Splatting ask for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.files import atomic_path

_VERTEX = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(name, "u1") for name in ("red", "green", "blue")]
)
_TYPES = {"<f4": "float", "|u1": "uchar"}


def write_ply(path: Path, points: NDArray[np.float64]) -> None:
    """Write `points` [N, 6] (x, y, z, r, g, b in [0, 1]), atomically."""
    vertices = np.zeros(len(points), _VERTEX)
    for column, name in enumerate(("x", "y", "z")):
        vertices[name] = points[:, column]
    for column, name in enumerate(("red", "green", "blue"), 3):
        vertices[name] = np.rint(np.clip(points[:, column], 0, 1) * 255)
    properties = [f"property {_TYPES[_VERTEX[name].str]} {name}" for name in _VERTEX.names or ()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *properties, "end_header", ""]
    with atomic_path(path) as temporary:
        temporary.write_bytes("\n".join(header).encode() + vertices.tobytes())

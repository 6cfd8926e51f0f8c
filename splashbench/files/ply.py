"""Point clouds and meshes as .ply (Turk, The PLY Polygon File Format, 1994).

A point cloud is binary: a row per point and a number per property. Published codes write Gaussians and anchors so, and
ask for their first points so; other programs take meshes so. A file that is read comes from a stranger: its header is
held against the file's size before anything else is read. The usual library, plyfile, has a licence (GPL) that does not
go with this project's.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files.atomic import atomic_path
from splashbench.files.plain import open_plain

#: More points than this are no reconstruction that could be rendered.
MAX_POINTS = 20_000_000
_MAX_HEADER_BYTES = 1 << 16
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_WRITTEN_TYPES = {"<f4": "float", "<f8": "double", "|u1": "uchar", "<i4": "int"}
_TRIANGLE = np.dtype([("count", "u1"), ("corners", "<i4", (3,))])
_NAME = re.compile(r"\w{1,64}", re.ASCII)
_END = re.compile(rb"^end_header\r?\n", re.MULTILINE)


@dataclass(frozen=True)
class PointCloud:
    """N points with named properties. path: of the file, for messages."""

    path: Path
    points: NDArray[np.void]

    @property
    def names(self) -> tuple[str, ...]:
        """The properties, in the file's order."""
        return self.points.dtype.names or ()

    def __len__(self) -> int:
        return len(self.points)

    def table(self, *names: str) -> NDArray[np.float32]:
        """The properties `names` as float32 [N, len(names)].

        Raises SplashbenchError for one that is missing, or holds a NaN or an infinity.
        """
        table = np.empty((len(self), len(names)), np.float32)
        for column, name in enumerate(names):
            if name not in self.names:
                raise SplashbenchError(f"{self.path} lacks the property {name}; give the file as the code saved it")
            with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is told of
                table[:, column] = self.points[name]
            if not np.isfinite(table[:, column]).all():
                raise SplashbenchError(f"{self.path}: {name} has NaN or infinite entries; the fit failed, repeat it")
        return table

    def numbered(self, prefix: str, count: int) -> NDArray[np.float32]:
        """The properties `prefix`0, `prefix`1, ... as float32 [N, count]."""
        return self.table(*(f"{prefix}{i}" for i in range(count)))

    def count(self, prefix: str) -> int:
        """How many properties are called `prefix` and a number."""
        return sum(name.removeprefix(prefix).isdecimal() for name in self.names if name.startswith(prefix))


def read_point_cloud(path: Path) -> PointCloud:
    """Read the element `vertex` of a binary .ply; what follows it is left alone.

    Raises SplashbenchError for a file that is missing, text, cut short, empty, or not of numbers alone.
    """
    path = Path(path)
    try:
        with open_plain(path) as (stream, size):
            head = stream.read(_MAX_HEADER_BYTES)
            end = _END.search(head)
            if not head.startswith((b"ply\n", b"ply\r\n")) or end is None:
                raise SplashbenchError(f"{path} is no .ply (it has no such header); give the file as the code saved it")
            count, kind = _header(path, head[: end.start()].decode("ascii", "replace").splitlines())
            available = (size - end.end()) // kind.itemsize
            if count > available:
                raise SplashbenchError(f"{path} is cut short: {available} of {count} points are there; copy it again")
            stream.seek(end.end())
            points = np.fromfile(stream, kind, count)
    except FileNotFoundError:
        raise SplashbenchError(f"{path} does not exist; let the code save its last iteration") from None
    except (OSError, ValueError, MemoryError) as error:
        raise SplashbenchError(f"{path} cannot be read ({error}); copy it again") from None
    return PointCloud(path, points)


def _header(path: Path, lines: list[str]) -> tuple[int, np.dtype]:
    """Number of points and what one row holds, of the lines between "ply" and "end_header"."""
    order, count = None, None
    fields: dict[str, str] = {}
    for words in (line.split() for line in lines[1:]):
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3:
            if words[1] == "ascii":
                raise SplashbenchError(f"{path} is written as text; give the binary .ply that the code saved")
            order = _ORDERS.get(words[1])
        elif words[0] == "element" and len(words) == 3:
            if count is not None:
                break  # what follows the points
            if words[1] != "vertex" or not (words[2].isdecimal() and len(words[2]) < 12):
                raise SplashbenchError(f"{path} begins with {' '.join(words)[:80]}, not points; give a point cloud")
            count = int(words[2])
        elif words[0] == "property" and len(words) == 3 and words[1] in _TYPES and _NAME.fullmatch(words[2]):
            if words[2] in fields:
                raise SplashbenchError(f"{path} has the property {words[2]} twice; give the file as the code saved it")
            fields[words[2]] = _TYPES[words[1]]
        else:
            raise SplashbenchError(f"{path}: {' '.join(words)[:80]!r} in the header is not known; give a point cloud")
    if order is None or count is None or not fields:
        raise SplashbenchError(f"{path}: the header lacks the format, the points or their properties; copy it again")
    if not 0 < count <= MAX_POINTS:
        raise SplashbenchError(f"{path} has {count} points, not 1 to {MAX_POINTS}; give a model that was fitted")
    return count, np.dtype([(name, order + kind) for name, kind in fields.items()])


def write_colored_points(path: Path, points: NDArray[np.float64]) -> None:
    """Write `points` [N, 6] (x, y, z, r, g, b in [0, 1]), atomically.

    Codes built on 3D Gaussian Splatting ask for normals, too; they are zero.
    """
    tables: dict[tuple[str, ...], NDArray] = {
        ("x", "y", "z"): points[:, :3].astype(np.float32),
        ("nx", "ny", "nz"): np.zeros((len(points), 3), np.float32),
        ("red", "green", "blue"): np.rint(np.clip(points[:, 3:], 0, 1) * 255).astype(np.uint8),
    }
    write_vertices(path, tables)


def write_vertices(
    path: Path, tables: Mapping[tuple[str, ...], NDArray], faces: NDArray[np.integer] | None = None
) -> None:
    """Write points with properties, or the triangles between them, as binary, atomically.

    Args:
        tables: names of properties -> [V, number of names], of float32, float64, uint8 or int32.
        faces: [F, 3] of row numbers; None for points alone. A file of nothing is a valid one, too.
    """
    kinds = [(name, table.dtype.newbyteorder("<")) for names, table in tables.items() for name in names]
    rows = np.empty(len(next(iter(tables.values()))), np.dtype(kinds))
    for names, table in tables.items():
        for column, name in enumerate(names):
            rows[name] = table[:, column]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {_WRITTEN_TYPES[kind.str]} {name}" for name, kind in kinds]
    triangles = np.zeros(0 if faces is None else len(faces), _TRIANGLE)
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        triangles["count"], triangles["corners"] = 3, faces
    head = "\n".join([*header, "end_header", ""]).encode("ascii")
    with atomic_path(path) as temporary:
        temporary.write_bytes(head + rows.tobytes() + triangles.tobytes())


def write_mesh(path: Path, vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> None:
    """Write a triangle mesh (`vertices` [V, 3] in metres, y up; `faces` [F, 3]) as text that people can read."""
    head = (
        f"ply\nformat ascii 1.0\ncomment metres, y up\nelement vertex {len(vertices)}\nproperty float x\n"
        f"property float y\nproperty float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\n"
        "end_header\n"
    )
    body = ["{:.6f} {:.6f} {:.6f}".format(*vertex) for vertex in vertices.tolist()]
    body += ["3 {} {} {}".format(*face) for face in faces.tolist()]
    with atomic_path(path) as temporary:
        temporary.write_text(head + "\n".join(body) + "\n", encoding="ascii")

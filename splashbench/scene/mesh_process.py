"""The child process that decodes a mesh file from a stranger, within limits of memory and time.

trimesh believes what a file states of itself: a few bytes of glTF ask for gigabytes, an OBJ file of many groups for
hours. Its formats have too many such corners to be checked from outside, and a process has none: the kernel holds it
to its limits. That costs the start of a process, about what importing trimesh into this one would.
"""

from __future__ import annotations

import os
import resource
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.child import child_command
from splashbench.errors import SplashbenchError
from splashbench.files import read_npz, read_plain, require_plain_file, write_text
from splashbench.processes import limit_memory

#: Of the child: address space, processor time, and patience with a busy machine.
MAX_MEMORY_BYTES, MAX_SECONDS, _MAX_WAIT_SECONDS = 4 << 30, 60, 300
MAX_FILE_BYTES = 256 << 20
_MESH, _FAULT, _MAX_FAULT = "mesh.npz", "fault", 500


def decode(path: Path, max_faces: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices [V, 3] and faces [F, 3] of a PLY, GLB or OBJ file, every part where its scene graph puts it.

    Raises SplashbenchError naming the file, and OSError as reading it does.
    """
    require_plain_file(path)
    if path.stat().st_size > MAX_FILE_BYTES:
        raise SplashbenchError(f"{path} is larger than {MAX_FILE_BYTES >> 20} MiB; simplify the mesh")
    with tempfile.TemporaryDirectory(prefix="splashbench-mesh-") as folder:
        command = child_command(carry_out, path, folder, str(max_faces))
        # A thread's stack counts as memory, and numpy would start one per processor.
        environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        try:
            done = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=environment,
                timeout=_MAX_WAIT_SECONDS,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise _too_much(path) from None
        fault = Path(folder, _FAULT)
        if fault.is_file():
            raise SplashbenchError(fault.read_text(encoding="utf-8"))
        if done.returncode != 0:
            raise _too_much(path)
        arrays = read_npz(Path(folder, _MESH), {"vertices": 2, "faces": 2})
    return arrays["vertices"], arrays["faces"]


def _too_much(path: Path) -> SplashbenchError:
    return SplashbenchError(
        f"{path} is not a readable mesh (it needs more than {MAX_MEMORY_BYTES >> 30} GiB or {MAX_SECONDS} s); "
        "simplify the mesh"
    )


def carry_out(path: str, folder: str, max_faces: str) -> int:
    """Decode the mesh `path` into `folder`, or leave there what is wrong with it."""
    limit_memory(MAX_MEMORY_BYTES)
    resource.setrlimit(resource.RLIMIT_CPU, (MAX_SECONDS, MAX_SECONDS + 1))
    try:
        vertices, faces = decoded(Path(path), int(max_faces))
    except MemoryError:
        return 1
    except SplashbenchError as error:
        write_text(Path(folder, _FAULT), str(error))
        return 0
    # A damaged file makes the readers of trimesh fail in any way that Python knows.
    except Exception as error:
        said = str(error)[:_MAX_FAULT].encode("utf-8", "replace").decode("utf-8")
        write_text(Path(folder, _FAULT), f"{path} is not a readable mesh ({said}); export it again")
        return 0
    np.savez(Path(folder, _MESH), vertices=vertices, faces=faces)
    return 0


def decoded(path: Path, max_faces: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """`decode` in this process, without limits. Raises whatever trimesh does."""
    import io

    import trimesh

    # process=False: as the file has it; the checks are ContainerMesh's. No resolver: no file beside it is opened.
    loaded = trimesh.load_scene(
        io.BytesIO(read_plain(path, MAX_FILE_BYTES)),
        file_type=path.suffix.lower()[1:],
        process=False,
        skip_materials=True,
        allow_remote=False,
    )
    # A scene graph may show one part many times: counted before it is written out.
    parts = (loaded.geometry[loaded.graph[node][1]] for node in loaded.graph.nodes_geometry)
    count = sum(len(getattr(part, "faces", ())) for part in parts)
    if count > max_faces:
        raise SplashbenchError(f"{path} has {count} faces, more than {max_faces}; simplify the mesh")
    mesh = loaded.to_mesh()
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    if not np.isfinite(vertices).all():
        raise ValueError("vertices that are not finite")
    return vertices, np.asarray(mesh.faces, dtype=np.int64)

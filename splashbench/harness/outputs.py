"""What a phase has to leave behind, looked at from outside once its process is gone.

The child process checks every array before it writes it. A method that ends that process early, or writes files of its
own, goes around those checks; here it does not.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from splashbench.errors import SplashbenchError
from splashbench.files import image_size, list_files, sha256_file
from splashbench.harness.messages import Failure
from splashbench.harness.output_checks import check_geometry, check_particles
from splashbench.scene import Camera, Particles, SignedDistance
from splashbench.submission import Status
from splashbench.submission.submission import render_path


def require_views(output: Path, views: Sequence[tuple[Camera, int]]) -> None:
    """Raise Failure unless the folder `output` has both pictures of every view (camera, timestep), in their sizes."""
    for camera, t in views:
        for kind in ("renders", "alpha"):
            path = render_path(output, kind, camera.name, t)
            where = f"camera {camera.name}, timestep {t}"
            if path.is_symlink():
                raise Failure(Status.INCOMPLETE, f"{where}: the picture in {kind} is a link")
            try:
                width, height = image_size(path)
            except SplashbenchError:
                raise Failure(Status.INCOMPLETE, f"{where}: there is no picture in {kind}") from None
            if (width, height) != (camera.width, camera.height):
                size = f"{width}x{height}, not {camera.width}x{camera.height}"
                raise Failure(Status.WRONG_SIZE, f"{where}: the picture in {kind} is {size}")


def require_liquid(output: Path, n_frames: int) -> None:
    """Raise Failure unless particles and signed distance in the folder `output`, where there are any, are whole."""
    try:
        if (output / "particles.npz").exists():
            check_particles(Particles.load(output / "particles.npz"), n_frames)
        if (output / "geometry.npz").exists():
            check_geometry(SignedDistance.load(output / "geometry.npz"), n_frames)
    except SplashbenchError as error:
        raise Failure(Status.INCOMPLETE, str(error).replace(f"{output}/", "")) from None


def tree_digest(directory: Path) -> str:
    """SHA-256 over the names and bytes of all files below `directory`; "" where it is none, or holds other than files
    and folders."""
    digest = hashlib.sha256()
    try:
        listing = list_files(directory)
        if listing.faults or directory.is_symlink():
            return ""
        for name in listing.names:
            digest.update(f"{name} {sha256_file(directory / name)}\n".encode())
    except SplashbenchError:
        return ""
    return digest.hexdigest()

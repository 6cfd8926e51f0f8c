"""Collecting what an external code rendered: every file is checked, decoded, and written anew into the submission.

The folder that the code was given holds renders/<cam>/<frame>.png, alpha/<cam>/<frame>.png, and where it has them
particles.npz and geometry.npz, as in docs/submission_format.md.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from splashbench.errors import SplashbenchError
from splashbench.files import image_size, read_gray, read_image
from splashbench.harness.messages import Failure
from splashbench.progress import track
from splashbench.scene import Particles, Scene, SignedDistance
from splashbench.submission import Status, write_view
from splashbench.submission.submission import render_path

T = TypeVar("T")


def collect(into: Path, staging: Path, scene: Scene) -> None:
    """Check what the code left in `into` and write it into `staging`. Raises Failure with the fault's status."""
    views = [(name, t) for name in scene.test for t in range(scene.n_frames)]
    missing = [
        path.relative_to(into).as_posix()
        for name, t in views
        for kind in ("renders", "alpha")
        if not (path := render_path(into, kind, name, t)).is_file()
    ]
    if missing:
        more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
        raise Failure(Status.INCOMPLETE, f"{missing[0]} is missing{more}")
    for name, t in track(views, "taking over the renders"):
        camera = scene.cameras[name]
        rgb, alpha = (render_path(into, kind, name, t) for kind in ("renders", "alpha"))
        for path in (rgb, alpha):
            _require_plain(path, into)
            width, height = _read(image_size, path, into)
            if (width, height) != (camera.width, camera.height):
                raise Failure(
                    Status.WRONG_SIZE,
                    f"{path.relative_to(into).as_posix()} is {width}x{height}; the view is "
                    f"{camera.width}x{camera.height} pixels",
                )
        write_view(staging, name, t, _read(read_image, rgb, into), _read(read_gray, alpha, into))
    _collect_array_file(Particles.load, into / "particles.npz", staging, scene)
    _collect_array_file(SignedDistance.load, into / "geometry.npz", staging, scene)


def _collect_array_file(
    load: Callable[[Path], Particles | SignedDistance], path: Path, staging: Path, scene: Scene
) -> None:
    if not path.exists() and not path.is_symlink():
        return
    _require_plain(path, path.parent)
    arrays = _read(load, path, path.parent)
    if arrays.n_frames != scene.n_frames:
        raise Failure(Status.INCOMPLETE, f"{path.name} has {arrays.n_frames} instants, the scene {scene.n_frames}")
    arrays.save(staging / path.name)


def _require_plain(path: Path, into: Path) -> None:
    """A link could name a file that the code was not to see, and hand it in as its own."""
    for place in (path, *path.parents):
        if place == into:
            return
        if place.is_symlink():
            raise Failure(Status.INCOMPLETE, f"{place.relative_to(into).as_posix()} is a link, not a file")


def _read(read: Callable[[Path], T], path: Path, into: Path) -> T:
    """What `read(path)` gives; an unreadable file is a fault of the code, named as it knows it."""
    try:
        return read(path)
    except SplashbenchError as error:
        reason = str(error).replace(f"{into}/", "")
        status = Status.NOT_FINITE if "NaN or infinite" in reason else Status.INCOMPLETE
        raise Failure(status, reason) from None

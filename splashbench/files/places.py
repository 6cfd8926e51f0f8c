"""Whether a file can be read from a place or written to it: asked before long work."""

from __future__ import annotations

import os
from pathlib import Path

from splashbench.errors import SplashbenchError


def require_file_place(path: Path, replace: bool = True) -> None:
    """Raise SplashbenchError where no file can be written at `path`; called before long work.

    replace: whether a file that is there may go. A link that leads nowhere counts as one.
    """
    path = Path(path)
    if path.is_dir():
        raise SplashbenchError(f"{path} is a folder; give the name of a file")
    if path.exists() and not path.is_file():
        raise SplashbenchError(f"{path} is a device or pipe; give the name of a file")
    if not replace and os.path.lexists(path):
        raise taken(path)
    require_folder_place(path.parent)


def taken(path: Path) -> SplashbenchError:
    """The error for a place where there is something that may not be replaced."""
    return SplashbenchError(f"{path} exists already; give another place, or --replace to replace it")


def require_folder_place(directory: Path) -> None:
    """Raise SplashbenchError where `directory` is a file, lies below one, or may not be written."""
    place = Path(directory).resolve()
    while not place.exists():
        place = place.parent
    if not place.is_dir():
        raise SplashbenchError(f"{place} is a file; give another place for {directory}")
    if not os.access(place, os.W_OK | os.X_OK):
        raise SplashbenchError(f"{place} may not be written; give another place for {directory}")

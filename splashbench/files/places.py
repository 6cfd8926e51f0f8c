"""Whether a file can be read from a place or written to it: asked before long work."""

from __future__ import annotations

import os
from pathlib import Path

from splashbench.errors import SplashbenchError

# What a finished submission has, and no other folder.
_SEALED = ("submission.toml", "SHA256SUMS")


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


def require_picture_place(path: Path, *folders: Path) -> None:
    """Raise SplashbenchError, before long work, unless a PNG can take the place `path`.

    folders: of what is read; files in them are not replaced.
    """
    require_file_place(path)
    if Path(path).suffix.lower() != ".png":
        raise SplashbenchError(f"{path}: the picture is a PNG; give a name that ends in .png")
    for folder in folders:
        if Path(path).exists() and Path(path).resolve().is_relative_to(Path(folder).resolve()):
            raise SplashbenchError(f"{path} is a file of {folder}, which is read, and stays; give another place")
    require_unsealed_place(path)


def require_unsealed_place(path: Path) -> None:
    """Raise SplashbenchError where `path` lies in a submission: a file that is added there breaks its seal."""
    place = Path(path).resolve()
    for folder in (place, *place.parents):
        if all((folder / name).is_file() for name in _SEALED):
            raise SplashbenchError(f"{path} lies in {folder}, whose files are sealed; give a place outside it")


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

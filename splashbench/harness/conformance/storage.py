"""The files that a method saved: plain files alone, and no pickles, which run code when they are read."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np

#: Of these formats' common names; torch.save and joblib write pickles too.
_SUFFIXES = (".pkl", ".pickle", ".pt", ".pth", ".joblib", ".dill", ".cloudpickle")
_FIRST, _LAST = (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05"), b"."


def storage_faults(directory: Path) -> list[str]:
    """A line for each fault of the files that `Fitted.save` wrote into `directory`.

    A pickle shows by its name, by its first and last bytes (protocols 2 to 5), inside zip archives (what torch.save
    writes), and by arrays of objects in .npy and .npz. Not noticed: pickles in a compression of the method's own.
    """
    faults, files = [], 0
    for root, folders, names in os.walk(directory):
        folders.sort()
        for name in sorted([*names, *folders]):
            path = Path(root, name)
            shown = path.relative_to(directory).as_posix()
            if path.is_symlink() or not (path.is_file() or path.is_dir()):
                faults.append(f"{shown} is no plain file")
            elif path.is_file():
                files += 1
                if _is_pickle(path):
                    faults.append(f"{shown} is or holds a pickle")
    return faults if files or faults else ["save() wrote no file"]


def _is_pickle(path: Path) -> bool:
    if path.suffix.lower() in _SUFFIXES:
        return True
    with path.open("rb") as stream:
        start = stream.read(6)
        if start == b"\x93NUMPY":
            stream.seek(0)
            return _of_objects(stream)
        if start[:2] in _FIRST and path.stat().st_size > 2:
            stream.seek(-1, os.SEEK_END)
            return stream.read(1) == _LAST
    if not start.startswith(b"PK"):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return any(_holds_pickle(archive, name) for name in archive.namelist())
    except (zipfile.BadZipFile, OSError, RuntimeError, NotImplementedError):
        return False  # no archive after all; `load` shows whether it can be read


def _holds_pickle(archive: zipfile.ZipFile, name: str) -> bool:
    if name.lower().endswith(_SUFFIXES):
        return True
    with archive.open(name) as stream:
        return name.endswith(".npy") and _of_objects(stream)


def _of_objects(stream: object) -> bool:
    """Whether the .npy in `stream` holds objects, from its header alone."""
    try:
        version = np.lib.format.read_magic(stream)  # type: ignore[arg-type]
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        return bool(read(stream)[2].hasobject)  # type: ignore[arg-type]
    except ValueError:
        return False

"""What lies in a file or below a folder: digests, names, numbers of bytes."""

from __future__ import annotations

import hashlib
import os
import stat
from dataclasses import dataclass, field
from pathlib import Path

from splashbench.errors import SplashbenchError
from splashbench.files.plain import open_plain

#: Files and folders below a folder that is listed, and folders within each other, at most.
MAX_ENTRIES, MAX_FOLDERS_DEEP = 200_000, 32
_BLOCK = 1 << 20


def sha256_file(path: Path, max_bytes: int | None = None) -> str:
    """Hex SHA-256 of a file's bytes. Raises SplashbenchError for what is no regular file, or larger than `max_bytes`
    (`plain.MAX_FILE_BYTES` by default)."""
    digest = hashlib.sha256()
    with open_plain(path, max_bytes) as (stream, size):
        while size > 0 and (block := stream.read(min(size, _BLOCK))):
            digest.update(block)
            size -= len(block)  # a file that grows meanwhile is read no further
    return digest.hexdigest()


@dataclass
class Listing:
    """What lies below a folder. names: of regular files, relative with forward slashes, in one order on every machine;
    bytes: of all of them together. faults: a line for everything else that is no folder, and for unusable names."""

    names: list[str] = field(default_factory=list)
    bytes: int = 0
    faults: list[str] = field(default_factory=list)


def list_files(directory: Path, max_entries: int = MAX_ENTRIES) -> Listing:
    """List the files below `directory`; nothing is opened and no link followed.

    Raises SplashbenchError for more than `max_entries` files and folders, and folders that are too deep or closed.
    """
    directory, listing = Path(directory), Listing()
    folders, n_entries = [("", 0)], 0
    while folders:
        folder, depth = folders.pop()
        place = directory / folder if folder else directory
        try:
            with os.scandir(place) as entries:
                for entry in entries:
                    n_entries += 1
                    if n_entries > max_entries:
                        raise SplashbenchError(
                            f"{directory} holds more than {max_entries} files and folders; give another folder"
                        )
                    name = f"{folder}/{entry.name}" if folder else entry.name
                    if entry.is_dir(follow_symlinks=False):
                        if depth >= MAX_FOLDERS_DEEP:
                            raise SplashbenchError(
                                f"{directory} has folders more than {MAX_FOLDERS_DEEP} deep; give another folder"
                            )
                        folders.append((name, depth + 1))
                    elif fault := _fault(entry, name):
                        listing.faults.append(f"{directory / name} {fault}")
                    else:
                        listing.names.append(name)
                        listing.bytes += entry.stat(follow_symlinks=False).st_size
        except OSError as error:
            raise SplashbenchError(f"{place} cannot be listed ({error.strerror or error}); restore it") from None
    listing.names.sort()
    listing.faults.sort()
    return listing


def _fault(entry: os.DirEntry[str], name: str) -> str:
    """Why an entry that is no folder cannot be listed and read; empty where it can."""
    if entry.is_symlink():
        return "is a link"
    if not stat.S_ISREG(entry.stat(follow_symlinks=False).st_mode):
        return "is a device or pipe, not a file"
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        return "has a name that is no UTF-8"
    return "has a line break in its name" if "\n" in name or "\r" in name else ""


def tree_bytes(directory: Path) -> int:
    """Total size in bytes of the regular files below `directory` (0 where it does not exist)."""
    total = 0
    for root, _, names in os.walk(directory):
        for name in names:
            status = Path(root, name).lstat()
            total += status.st_size if stat.S_ISREG(status.st_mode) else 0
    return total

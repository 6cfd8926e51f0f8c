"""What lies in a file or below a folder, as a digest or a number of bytes."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path


def sha256_file(path: Path) -> str:
    """Hex SHA-256 of a file's bytes."""
    digest = hashlib.sha256()
    with Path(path).open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def tree_bytes(directory: Path) -> int:
    """Total size in bytes of the regular files below `directory` (0 where it does not exist)."""
    total = 0
    for root, _, names in os.walk(directory):
        for name in names:
            path = Path(root, name)
            total += 0 if path.is_symlink() else path.stat().st_size
    return total

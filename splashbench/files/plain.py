"""Opening what a stranger listed or left: a regular file of a bounded size, and never more bytes than it has.

Opening a pipe waits for its writer, reading a device may never end, and a few bytes of a sparse file claim terabytes.
So a file is looked at first, opened without waiting, looked at again, and read up to the size that it had then.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

from splashbench.errors import SplashbenchError

#: Of any one file, unless its reader says less.
MAX_FILE_BYTES = 8 << 30


@contextmanager
def open_plain(path: Path, max_bytes: int | None = None) -> Iterator[tuple[BinaryIO, int]]:
    """Yield `path` opened for reading, and its size in bytes: at most `max_bytes` (MAX_FILE_BYTES by default).

    Raises SplashbenchError for what is no regular file or is larger, and OSError as `open` does.
    """
    path = Path(path)
    _require_plain(path, path.stat(), max_bytes)
    # What is opened may have become a pipe meanwhile: without O_NONBLOCK that waits.
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    try:
        status = os.fstat(descriptor)
        _require_plain(path, status, max_bytes)
        stream = os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise
    with stream:
        yield stream, status.st_size


def read_plain(path: Path, max_bytes: int | None = None) -> bytes:
    """The content of `path`; errors are those of `open_plain`."""
    with open_plain(path, max_bytes) as (stream, size):
        return stream.read(size)


def require_plain_file(path: Path) -> None:
    """Raise SplashbenchError for a folder, a pipe or a device, whose reading would fail oddly or never end.

    A missing file passes: its reader reports it.
    """
    try:
        status = Path(path).stat()
    except OSError:
        return
    _require_plain(path, status, status.st_size)


def is_plain_file(path: Path) -> bool:
    """Whether `path` is a regular file with bytes of its own, or a link to one."""
    try:
        require_plain_file(path)
    except SplashbenchError:
        return False
    return Path(path).is_file()


def _require_plain(path: Path, status: os.stat_result, max_bytes: int | None) -> None:
    if not stat.S_ISREG(status.st_mode):
        what = "a folder" if stat.S_ISDIR(status.st_mode) else "a device or pipe"
        raise SplashbenchError(f"{path} is {what}, not a file; restore it")
    if status.st_dev in _kernel_devices():
        raise SplashbenchError(f"{path} leads to the system's own files (/proc, /sys); restore it")
    limit = MAX_FILE_BYTES if max_bytes is None else max_bytes
    if status.st_size > limit:
        shown = f"{limit >> 20} MiB" if limit >= 1 << 20 else f"{limit} bytes"
        raise SplashbenchError(f"{path} is larger than {shown}; check that it is the right file")


@lru_cache(maxsize=1)
def _kernel_devices() -> frozenset[int]:
    """Devices of the file systems whose regular files are the kernel's answers: of any size, and some never end."""
    devices = set()
    for place in ("/proc", "/sys", "/sys/kernel/debug", "/sys/kernel/tracing"):
        try:
            devices.add(os.stat(place).st_dev)  # noqa: PTH116
        except OSError:
            continue
    devices.discard(os.stat("/").st_dev)  # noqa: PTH116
    return frozenset(devices)

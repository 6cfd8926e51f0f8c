"""Which of a set of files are opened, by whatever process or native code: Linux's inotify."""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from pathlib import Path

_IN_OPEN, _IN_ISDIR, _IN_Q_OVERFLOW = 0x20, 0x40000000, 0x4000  # linux/inotify.h
_EVENT = struct.Struct("iIII")


class Opening:
    """Notices, from when it is entered, each opening of `files` and each listing of a folder of theirs.

    Attributes:
        seen: the paths opened or listed; filled in at the end.
        complete: whether nothing can have been missed; False where the system has no inotify or too few watches.
    """

    def __init__(self, files: list[Path]) -> None:
        self.seen: list[Path] = []
        self.complete = False
        self._files = set(files)
        self._folders: dict[int, Path] = {}
        self._descriptor = -1

    def __enter__(self) -> Opening:
        if not self._files or not sys.platform.startswith("linux"):
            return self
        library = ctypes.CDLL(None, use_errno=True)
        self._descriptor = library.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        if self._descriptor < 0:
            return self
        self.complete = True
        for folder in sorted({path.parent for path in self._files}):
            watch = library.inotify_add_watch(self._descriptor, os.fsencode(folder), _IN_OPEN)
            self.complete &= watch >= 0
            self._folders[watch] = folder
        return self

    def __exit__(self, *_: object) -> None:
        if self._descriptor < 0:
            return
        seen: dict[Path, None] = {}
        try:
            while data := os.read(self._descriptor, 1 << 16):
                self._collect(data, seen)
        except BlockingIOError:
            pass  # that was all
        finally:
            os.close(self._descriptor)
            self._descriptor = -1
        self.seen = sorted(seen)

    def _collect(self, data: bytes, seen: dict[Path, None]) -> None:
        offset = 0
        while offset < len(data):
            watch, mask, _, length = _EVENT.unpack_from(data, offset)
            name = os.fsdecode(data[offset + _EVENT.size : offset + _EVENT.size + length].rstrip(b"\0"))
            offset += _EVENT.size + length
            if mask & _IN_Q_OVERFLOW:
                self.complete = False
            elif watch in self._folders:
                path = self._folders[watch] / name
                if path in self._files or (mask & _IN_ISDIR and not name):
                    seen[path] = None

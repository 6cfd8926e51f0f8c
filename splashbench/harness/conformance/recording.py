"""Which files a method touches: by Python's audit events in its own process, by Linux's inotify in any.

Audit events show the calls of Python's own `open`, `os` and whatever is built on them, also in forked processes. They
do not show native code (cv2.imread), nor other programs and interpreters that a method starts. inotify shows those
too, for openings of the files that it watches.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
#: Audit events that change the file system -> which of their arguments are paths that change.
_CHANGES: dict[str, tuple[int, ...]] = {
    "os.mkdir": (0,), "os.rmdir": (0,), "os.remove": (0,), "os.rename": (0, 1), "os.link": (1,), "os.symlink": (1,),
    "os.truncate": (0,), "os.chmod": (0,), "os.chown": (0,), "sqlite3.connect": (0,),
}  # fmt: skip
_LISTS = ("os.listdir", "os.scandir")
#: Variables that name folders of caches.
_CACHES = (
    "XDG_CACHE_HOME", "NUMBA_CACHE_DIR", "TORCH_HOME", "TORCH_EXTENSIONS_DIR", "TORCHINDUCTOR_CACHE_DIR",
    "MPLCONFIGDIR", "TRITON_CACHE_DIR", "CUDA_CACHE_PATH", "HF_HOME", "PYTHONPYCACHEPREFIX",
)  # fmt: skip
_MAX_TOUCHES = 10_000
How = Literal["read", "listed", "written"]


class Touch(BaseModel):
    """A file or folder that was touched: one of the scene's that is no training view's, or one written elsewhere."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    how: How
    path: str


class TouchRecorder:
    """Appends to the file `log` what the method touches while `method()` is entered; one per process.

    Args:
        scene: the scene whose training copy the method was given, resolved.
        allowed: files of the scene that the training copy leads to, resolved.
        writable: folders that a method may write in, resolved.
    """

    def __init__(self, log: Path, scene: Path, allowed: set[str], writable: list[Path]) -> None:
        # Written without a stream: what a forked process records arrives as well.
        self._log = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        self._scene, self._allowed = os.fspath(scene), allowed
        caches = [Path(value) for name in _CACHES if (value := os.environ.get(name))]
        caches += [Path.home() / ".cache", Path.home() / ".nv", Path("/dev"), Path("/proc")]
        folders = [*writable, Path(tempfile.gettempdir()), *caches]
        self._writable = tuple(os.path.realpath(folder) for folder in folders)
        self._recorded: set[tuple[str, str]] = set()
        self._here = threading.local()
        self._active = False
        sys.addaudithook(self._hear)

    @contextmanager
    def method(self) -> Iterator[None]:
        """The method's code runs meanwhile."""
        self._active = True
        try:
            yield
        finally:
            self._active = False

    def _hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self._active or getattr(self._here, "busy", False):
            return
        if event == "open":
            flags = arguments[2] if isinstance(arguments[2], int) else 0
            self._record("written" if flags & _WRITES else "read", arguments[0])
        elif event in _LISTS:
            self._record("listed", "." if arguments[0] is None else arguments[0])
        elif event in _CHANGES:
            for index in _CHANGES[event]:
                self._record("written", arguments[index])

    def _record(self, how: How, name: Any) -> None:
        if not isinstance(name, (str, bytes, os.PathLike)) or len(self._recorded) >= _MAX_TOUCHES:
            return  # a file descriptor: it was opened by name before
        self._here.busy = True
        try:
            # At once: a link may be gone later.
            path = os.path.realpath(os.fsdecode(name))
            if (how, path) in self._recorded or not self._matters(how, path):
                return
            self._recorded.add((how, path))
            os.write(self._log, json.dumps({"how": how, "path": path}).encode() + b"\n")
        except (OSError, ValueError, TypeError):
            return  # a name that no file can have; the call itself will fail
        finally:
            self._here.busy = False

    def _matters(self, how: How, path: str) -> bool:
        if _within(path, self._scene):
            return how == "written" or path not in self._allowed
        if how != "written" or "__pycache__" in path:
            return False
        return not any(_within(path, folder) for folder in self._writable)


def _within(path: str, folder: str) -> bool:
    return path == folder or path.startswith(folder.rstrip("/") + "/")


def read_touches(log: Path) -> list[Touch]:
    """What a `TouchRecorder` wrote; empty where it wrote nothing."""
    if not log.is_file():
        return []
    return [Touch.model_validate_json(line) for line in log.read_text(encoding="utf-8").splitlines()]


class OpeningWatch:
    """Notices, from when it is entered, each opening of `files` and each listing of a folder of theirs.

    Attributes:
        opened: the paths opened or listed; filled in at the end.
        complete: whether nothing can have been missed; False where the system has no inotify or too few watches.
    """

    def __init__(self, files: list[Path]) -> None:
        self.opened: list[Path] = []
        self.complete = False
        self._files = set(files)
        self._folders: dict[int, Path] = {}
        self._inotify: Any = None

    def __enter__(self) -> OpeningWatch:
        if not self._files or not sys.platform.startswith("linux"):
            return self
        from inotify_simple import INotify, flags

        with suppress(OSError):
            self._inotify = INotify()
            self.complete = True
        for folder in sorted({path.parent for path in self._files}) if self._inotify else ():
            try:
                self._folders[self._inotify.add_watch(folder, flags.OPEN)] = folder
            except OSError:
                self.complete = False
        return self

    def __exit__(self, *_: object) -> None:
        if self._inotify is None:
            return
        from inotify_simple import flags

        opened: set[Path] = set()
        for event in self._inotify.read(timeout=0):
            if event.mask & flags.Q_OVERFLOW:
                self.complete = False
            elif event.wd in self._folders:
                path = self._folders[event.wd] / event.name
                if path in self._files or (event.mask & flags.ISDIR and not event.name):
                    opened.add(path)
        self._inotify.close()
        self._inotify = None
        self.opened = sorted(opened)

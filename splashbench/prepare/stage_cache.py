"""The results of a preparation's stages, cached on disk so that no work is done twice.

A result is stored with a key: the SHA-256 of everything that it was made from, files by their name, size and time of
modification. The next run takes a result whose key is still the same, and makes the others anew. So does a run after
one that was killed: a result appears whole (written beside its place, then renamed) or not at all. A stage that leaves
files fills a folder, and its result is written last. A folder without its result is rubbish, and is made anew.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import shutil
import stat
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import numpy as np
from filelock import FileLock, Timeout
from pydantic import BaseModel, TypeAdapter, ValidationError

from splashbench.arrays import plain
from splashbench.errors import SplashbenchError
from splashbench.files import atomic_path, is_plain_file, read_plain
from splashbench.version import __version__

Stage = Literal["sync", "motion", "intrinsics", "poses", "metric", "container", "masks", "scene"]
FileFacts = tuple[str, int, int]  # name, bytes, nanoseconds of modification
STAGES: tuple[Stage, ...] = get_args(Stage)

# Results depend on these as much as on the recordings.
_LIBRARIES = ("av", "numpy", "opencv-contrib-python-headless", "pillow", "pycolmap", "scipy", "trimesh")
_MARK = "This folder holds what `splashbench prepare` found out about the session beside it. It may be deleted.\n"
_MARK_NAME, _LOCK_NAME, _SCRATCH_NAME = "README.txt", ".lock", "scratch"

# Rooms of the package whose code makes results: see `_code_digest`.
_ROOMS = ("prepare", "container", "observe", "background", "scene", "native", "files", "pages")

T = TypeVar("T")


@dataclass
class StageRecord:
    """How long a stage took when it was made, how much of that in this run, in seconds; and whether this run took all
    of it as it was."""

    seconds: float = 0.0
    spent: float = 0.0
    reused: bool = True


class StageStore:
    """The results of a session's stages below one folder. Make it with `open_stages`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.records: dict[Stage, StageRecord] = {}
        self._versions = {name: importlib.metadata.version(name) for name in _LIBRARIES} | {"code": _code_digest()}

    def result(self, stage: Stage, kind: Any, inputs: Mapping[str, Any], make: Callable[[], T], part: str = "") -> T:
        """The stored result of `stage` where it was made from the same `inputs`, else what `make` returns, stored.

        kind: the result's type. part: what of the stage, such as a camera, where it has several parts.
        """
        return self._obtain(stage, kind, inputs, part, make, None)

    def files(
        self, stage: Stage, kind: Any, inputs: Mapping[str, Any], make: Callable[[Path], T], part: str = ""
    ) -> tuple[Path, T]:
        """As `result`, for a stage that leaves files as well: `make` fills the empty folder that it is given."""
        folder = self._path(stage, part).with_suffix("")
        return folder, self._obtain(stage, kind, inputs, part, lambda: make(folder), folder)

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """An empty folder for files that nobody needs afterwards."""
        folder = self.folder / _SCRATCH_NAME
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    @contextmanager
    def timed(self, stage: Stage) -> Iterator[None]:
        """Count what happens within towards the stage's time, as work that is never stored."""
        start = time.perf_counter()
        yield
        self._count(stage, time.perf_counter() - start)

    def forget(self, first: Stage) -> None:
        """Delete the results of `first` and of all stages after it."""
        for stage in STAGES[STAGES.index(first) :]:
            self._path(stage, "").unlink(missing_ok=True)
            shutil.rmtree(self.folder / stage, ignore_errors=True)

    def _obtain(
        self,
        stage: Stage,
        kind: Any,
        inputs: Mapping[str, Any],
        part: str,
        make: Callable[[], T],
        folder: Path | None,
    ) -> T:
        path = self._path(stage, part)
        key = self._key(stage, part, inputs)
        stored = _read(path, key, TypeAdapter(kind), folder)
        if stored is not None:
            self.records.setdefault(stage, StageRecord()).seconds += stored[0]
            value: T = stored[1]
            return value
        path.unlink(missing_ok=True)  # before its files go: a result without its files must not be found
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        start = time.perf_counter()
        result = make()
        seconds = time.perf_counter() - start
        self._count(stage, seconds)
        content = {"key": key, "seconds": round(seconds, 3), "files": _sizes(folder), "result": _plain(result)}
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(content))
        return result

    def _count(self, stage: Stage, seconds: float) -> None:
        record = self.records.setdefault(stage, StageRecord())
        record.seconds += seconds
        record.spent += seconds
        record.reused = False

    def _path(self, stage: Stage, part: str) -> Path:
        return self.folder / stage / f"{part}.json" if part else self.folder / f"{stage}.json"

    def _key(self, stage: Stage, part: str, inputs: Mapping[str, Any]) -> str:
        origin = {"stage": stage, "part": part, "splashbench": __version__, **self._versions, "inputs": inputs}
        return hashlib.sha256(json.dumps(_plain(origin), sort_keys=True).encode()).hexdigest()


def _code_digest() -> str:
    """SHA-256 of the source that makes results: a version alone does not tell an edited checkout from what it was.

    That is `prepare`, the rooms that it imports, those that these import, and the modules that all rooms share.
    """
    package = Path(__file__).parents[1]
    files = [*package.glob("*.py")]
    for room in _ROOMS:
        files += [path for kind in ("*.py", "*.cpp", "*.h") for path in (package / room).rglob(kind)]
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(f"{path.relative_to(package).as_posix()}\0".encode() + path.read_bytes())
    return digest.hexdigest()


@contextmanager
def open_stages(folder: Path, again_from: Stage | None = None) -> Iterator[StageStore]:
    """The store in `folder`, held for this process alone; `again_from` and what follows it are made anew.

    Raises SplashbenchError where the folder cannot be written, holds something else, or is held by another process.
    """
    folder = Path(folder)
    try:
        if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
            raise SplashbenchError(f"{folder} is a link or a file, not a folder; name another place with --work")
        # Whatever else is called README.txt: results are deleted here without asking.
        if folder.is_dir() and any(folder.iterdir()) and not _is_ours(folder):
            raise SplashbenchError(f"{folder} holds something else; name another folder with --work")
        _require_own_files(folder)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _MARK_NAME).write_text(_MARK, encoding="utf-8")
        lock = FileLock(folder / _LOCK_NAME).acquire(blocking=False)
    except Timeout:
        raise SplashbenchError(
            f"{folder} is in use by another `splashbench prepare`; wait for it, or name another folder with --work"
        ) from None
    except OSError as error:
        raise SplashbenchError(
            f"{folder} cannot be written ({error.strerror}); name another folder with --work"
        ) from None
    with lock:
        store = StageStore(folder)
        if again_from is not None:
            store.forget(again_from)
        yield store


def _require_own_files(folder: Path) -> None:
    """Raise SplashbenchError for a link or anything but files and folders among stored results: who made the session
    might have put it there, and it would be written through, deleted beyond, or read without end."""
    for root, folders, names in os.walk(folder):
        for name in (*folders, *names):
            mode = Path(root, name).lstat().st_mode
            if not (stat.S_ISDIR(mode) or stat.S_ISREG(mode)):
                raise SplashbenchError(
                    f"{Path(root, name)} is a link, pipe or device, which no stored result is; remove it, or name "
                    "another place with --work"
                )
        folders[:] = [name for name in folders if Path(root, name) != folder / _SCRATCH_NAME]  # emptied, never read


def _is_ours(folder: Path) -> bool:
    mark = folder / _MARK_NAME
    return is_plain_file(mark) and mark.stat().st_size == len(_MARK.encode()) and mark.read_bytes() == _MARK.encode()


def _sizes(folder: Path | None) -> dict[str, int]:
    """The files of a stage's folder and their sizes."""
    if folder is None or not folder.is_dir():
        return {}
    return {file.name: file.stat().st_size for file in sorted(folder.iterdir())}


def facts_of(paths: Iterable[Path]) -> list[FileFacts]:
    """The facts that tell files from their earlier selves.

    A folder stands for the files directly in it.
    """
    facts = []
    for path in paths:
        for file in sorted(path.iterdir()) if path.is_dir() else [path]:
            status = file.stat()
            facts.append((f"{path.name}/{file.name}", status.st_size, status.st_mtime_ns))
    return facts


def _plain(value: Any) -> Any:
    """`value` of dataclasses, models, containers and arrays as JSON has it."""
    if isinstance(value, np.ndarray):
        return plain(value)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if is_dataclass(value) and not isinstance(value, type):
        return {entry.name: _plain(getattr(value, entry.name)) for entry in fields(value)}
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{type(value).__name__} cannot be stored")


def _read(path: Path, key: str, adapter: TypeAdapter[Any], folder: Path | None) -> tuple[float, Any] | None:
    """(seconds, result) from a stored result with this key; None where there is none that can be read, or where the
    files in its `folder` are not those that it had."""
    try:
        stored = json.loads(read_plain(path))
        if stored["key"] != key or stored["files"] != _sizes(folder):
            return None
        return float(stored["seconds"]), adapter.validate_python(stored["result"])
    except (OSError, SplashbenchError, ValueError, KeyError, TypeError, RecursionError, ValidationError):
        return None

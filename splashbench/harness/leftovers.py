"""What a killed run leaves: its half-made submission and its scratch folder. The next run removes them, or names them.

A run marks both folders by a file that it holds locked. The kernel lets go of the lock when the run ends, however it
ends: so a marked folder that nobody holds was left behind.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from splashbench.errors import SplashbenchError
from splashbench.files import is_staged_for

#: The file that marks a folder of a run under way.
MARK = ".splashbench_run"
_PREFIX = "splashbench-run-"
#: Between making a folder and locking its mark a run needs far less.
_YOUNG_SECONDS = 60.0


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Mark `folder` as that of a run under way; the mark is gone afterwards."""
    path = Path(folder, MARK)
    with path.open("w", encoding="utf-8") as stream:
        with contextlib.suppress(OSError):  # a file system without locks: then nothing tells a leftover, and it stays
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A temporary folder of a run, marked; it goes afterwards, as far as the method lets it."""
    with tempfile.TemporaryDirectory(prefix=_PREFIX, ignore_cleanup_errors=True) as folder, held(Path(folder)):
        yield Path(folder).resolve()


def clear_leftovers(out: Path) -> list[str]:
    """Remove what killed runs left: scratch folders of this user, and half-made submissions for `out`.

    Returns a line for each that was removed, and for each beside `out` that may be one and is not marked.
    """
    out = Path(out).resolve()
    lines = []
    places = [path for path in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*") if _is_own_folder(path)]
    if out.parent.is_dir():
        beside = [path for path in out.parent.glob(".tmp-*") if is_staged_for(path, out) and _is_own_folder(path)]
        for path in beside:
            if (path / MARK).is_file():
                places.append(path)
            elif _age(path) > _YOUNG_SECONDS:
                lines.append(f"{path} may be left from a killed command; remove it if nothing writes {out} now")
    for path in places:
        if _is_left(path):
            shutil.rmtree(path, ignore_errors=True)
            lines.append(f"removed {path}, left from a run that was killed")
    return lines


def require_alone(out: Path) -> None:
    """Raise SplashbenchError where another run is writing `out`: one of the two would be thrown away at its end."""
    out = Path(out).resolve()
    for path in out.parent.glob(".tmp-*") if out.parent.is_dir() else ():
        if is_staged_for(path, out) and _is_held(path):
            raise SplashbenchError(f"another run is writing {out} now; wait for its end, or give another place")


def _is_held(folder: Path) -> bool:
    """Whether a run under way holds the mark of `folder`; False where nothing can tell."""
    try:
        with (folder / MARK).open("r+", encoding="utf-8") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def _is_own_folder(path: Path) -> bool:
    try:
        return path.is_dir() and not path.is_symlink() and path.stat().st_uid == os.getuid()
    except OSError:
        return False


def _age(path: Path) -> float:
    """Seconds since something was last added to the folder `path`; 0 where it has gone meanwhile."""
    try:
        return time.time() - path.stat().st_mtime
    except OSError:
        return 0.0


def _is_left(folder: Path) -> bool:
    """Whether the run that marked `folder` has ended."""
    try:
        with (folder / MARK).open("r+", encoding="utf-8") as stream:
            if time.time() - os.fstat(stream.fileno()).st_mtime < _YOUNG_SECONDS:
                return False
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True

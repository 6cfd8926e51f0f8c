"""Writing that leaves all or nothing: every output is written beside its place and renamed onto it."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import uuid
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from splashbench.errors import DiskFullError, SplashbenchError
from splashbench.files.places import require_file_place, require_folder_place, taken
from splashbench.files.plain import read_plain

#: What the system says where a file has no room: the disk, the user's quota or the limit of a file's size is reached.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# Of the file that marks an output: a video's has a time for each frame.
_MAX_MARKER_BYTES = 16_000_000
# Beside an output, or within its folder, where the name ends here and a place in it follows.
_STAGED = re.compile(r"\.tmp-[0-9a-f]{8}-/?")


def _staging_name() -> str:
    return f".tmp-{uuid.uuid4().hex[:8]}-"


def _sibling(path: Path) -> Path:
    return path.with_name(_staging_name() + path.name)


def is_staged_for(path: Path, output: Path) -> bool:
    """Whether `path` is named like a staging folder for `output`, such as a killed process may leave."""
    output = Path(output).resolve()
    staged = _STAGED.match(path.name)
    return path.parent == output.parent and staged is not None and path.name[staged.end() :] == output.name


def as_asked(path: Path | str) -> str:
    """`path` under the name that the user gave, not that of its staging place."""
    return _STAGED.sub("", str(path))


def remove_any(path: Path) -> None:
    """Remove a file, a link, or a folder with what it holds, as far as that is possible; links are not followed."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def atomic_path(path: Path, replace: bool = True) -> Iterator[Path]:
    """Yield a temporary sibling of `path`. Success renames it onto `path`; failure removes it.

    replace: whether what is at `path` may go, in the end too: another process may have written it meanwhile.
    """
    path = Path(path)
    require_file_place(path, replace)
    made_parent = not path.parent.exists()
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _sibling(path)
    done = False
    try:
        yield temporary
        _put(temporary, path, replace)
        done = True
    except (OSError, RuntimeError) as error:
        raise_if_disk_full(path, error)
        raise
    finally:
        temporary.unlink(missing_ok=True)
        if made_parent and not done:
            with suppress(OSError):  # others may have written into it meanwhile
                path.parent.rmdir()


def _put(temporary: Path, path: Path, replace: bool) -> None:
    """Give `temporary` the name `path`. Raises SplashbenchError where that is taken and not to `replace`."""
    require_file_place(path, replace)
    if not replace:
        try:
            os.link(temporary, path)  # unlike a rename it takes no name that another process has just taken
        except FileExistsError:
            raise taken(path) from None
        except OSError:
            pass  # a file system without links: what was checked has to do
        else:
            return  # the temporary name goes by itself
    temporary.replace(path)


def raise_if_disk_full(path: Path | str, error: Exception) -> None:
    """Raise DiskFullError where `error` says that the disk is full; libraries report it in several ways."""
    if isinstance(error, DiskFullError):
        raise error
    number, text = getattr(error, "errno", None), str(error)
    # Pillow's encoders and numpy's tofile drop the system's error number; only their messages tell of a failed write.
    # OpenEXR and OpenUSD raise a RuntimeError with the system's words.
    library_failed = number is None and (
        "when writing image file" in text
        or ("requested and" in text and "written" in text)
        or any(os.strerror(each) in text for each in NO_ROOM)
    )
    if number in NO_ROOM or library_failed:
        raise DiskFullError(
            f"{as_asked(path)} could not be written: the disk is full; free some space and run the command again"
        ) from None


@contextmanager
def atomic_directory(
    path: Path,
    replace: bool = False,
    *,
    holds: str | None = None,
    keys: Collection[str] = (),
    inputs: Sequence[Path] = (),
) -> Iterator[Path]:
    """Yield a temporary sibling directory. Success renames it to `path`; failure removes it.

    Args:
        replace: whether what is at `path` may go; an empty directory counts as absent.
        holds: a file that every output of this kind has; a directory without it is never replaced.
        keys: that `holds`, a JSON object, has in every output; for a name that other programs may use.
        inputs: what the output is made from; a place that holds one of them is never replaced.

    Raises SplashbenchError where there is something at `path` that may not be replaced.
    """
    path = Path(path).resolve()  # a link stays; its target is replaced
    _require_replaceable(path, replace, holds, keys, inputs)
    require_folder_place(path.parent if path.exists() else path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _sibling(path)
    retired = _sibling(path)
    try:
        temporary.mkdir()
        yield temporary
        # Checked again: another process may have written `path` meanwhile.
        _require_replaceable(path, replace, holds, keys, inputs)
        if path.exists():
            path.rename(retired)
        temporary.rename(path)
    except (OSError, RuntimeError) as error:
        raise_if_disk_full(path, error)
        raise
    finally:
        # A failed rename must not lose what was at `path` before.
        if retired.exists() and not path.exists():
            retired.rename(path)
        for leftover in (temporary, retired):
            shutil.rmtree(leftover, ignore_errors=True)


def _require_replaceable(
    path: Path, replace: bool, holds: str | None, keys: Collection[str], inputs: Sequence[Path]
) -> None:
    """Raise SplashbenchError unless an output may take the place `path`, resolved."""
    for source in inputs:
        if Path(source).resolve().is_relative_to(path):
            raise SplashbenchError(f"{path} holds the input {source}; give another place for the output")
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    if not replace:
        raise taken(path)
    if not path.is_dir():
        raise SplashbenchError(f"{path} is a file; give the name of a folder")
    if holds is not None and not (path / holds).is_file():
        raise SplashbenchError(f"{path} is no earlier output (it has no {holds}) and stays; give another place")
    if holds is not None and keys and not _has_keys(path / holds, keys):
        raise SplashbenchError(
            f"{path} is no earlier output (its {holds} is of something else) and stays; give another place"
        )


def _has_keys(path: Path, keys: Collection[str]) -> bool:
    """Whether `path` is a JSON object that has all of `keys`."""
    try:
        data = json.loads(read_plain(path, _MAX_MARKER_BYTES))
    except (SplashbenchError, OSError, ValueError, RecursionError):
        return False
    return isinstance(data, dict) and set(keys) <= set(data)


@contextmanager
def files_together(directory: Path) -> Iterator[Path]:
    """Yield a temporary folder in `directory`, or beside it where it does not exist. Success moves its files into
    `directory`; failure moves none.

    Unlike `atomic_directory` it leaves other files in `directory` where they are.
    """
    directory = Path(directory).resolve()  # "." has no name to put one beside, and a link may lead to another disk
    require_folder_place(directory)
    directory.parent.mkdir(parents=True, exist_ok=True)
    # Within it where that can be: the folder above may be another disk's, or be nobody's to write into.
    staging = directory / _staging_name() if directory.is_dir() else _sibling(directory)
    try:
        staging.mkdir()
        yield staging
        directory.mkdir(exist_ok=True)
        made = sorted(staging.iterdir())
        for path in made:
            # No file takes a folder's place: better found before the first one has moved.
            if path.is_file() and (directory / path.name).is_dir():
                raise SplashbenchError(f"{directory / path.name} is a folder; move it away, or write elsewhere")
        for path in made:
            path.replace(directory / path.name)
    except (OSError, RuntimeError) as error:
        raise_if_disk_full(directory, error)
        raise
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8, whole or not at all. Raises SplashbenchError for text that is none (a lone surrogate)."""
    try:
        content = text.encode("utf-8")
    except UnicodeEncodeError as error:
        raise SplashbenchError(f"{path} cannot be written as UTF-8 ({error}); change the text") from None
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)

"""NeuroFluid's scenes out of whatever they come in: folders, zip and tar archives, or several of them.

How the authors packed them is not documented. What is known is a scene's own layout, view_N/..., and that a folder or
an archive above it bears the scene's name. So both are looked for; everything else, pickles above all, is left out.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import IO, Any

from splashbench.download.archive import MAX_ARCHIVE_BYTES
from splashbench.download.unpacking import (
    MAX_ENTRIES,
    MAX_GROWTH,
    copy_entry,
    copy_stream,
    damaged,
    entry_fault,
    open_zip,
    require_growth,
    shown,
    size_fault,
)
from splashbench.errors import SplashbenchError, one_line
from splashbench.files import list_files, open_plain
from splashbench.manifest import load_neurofluid

#: Names that an archive may end in.
ARCHIVES = (".zip", ".tar", ".tar.gz", ".tgz", ".tar.bz2", ".tar.xz")
_WORD = r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}"
_IN_SCENE = re.compile(rf"view_\d{{1,6}}/(?:transforms_(?:train|test)\.json|(?:{_WORD}/){{0,4}}{_WORD}\.(?:png|npz))")
_VIEW = re.compile(r"view_\d{1,6}")
# A header of a tar archive that is read at once; real ones have some hundred bytes.
_MOST_AT_ONCE = 4 << 20
# What reading damaged bytes raises, and what then becomes of it.
_UNREADABLE = (zlib.error, lzma.LZMAError, EOFError, OSError, ValueError)
_DAMAGE = (tarfile.TarError, ValueError)
Seen = Callable[[int], None]


def scene_named(text: str) -> str | None:
    """The scene whose name is part of `text`, such as "WaterCube" for "water_cube_v2"; None for none."""
    letters = re.sub(r"[^a-z]", "", text.lower())
    return next((name for name in load_neurofluid().scenes if name.lower() in letters), None)


def is_archive(name: str) -> bool:
    """Whether a file's name is that of an archive which can be read."""
    return name.lower().endswith(ARCHIVES)


def place_in_scene(parts: Sequence[str]) -> tuple[str, str, str] | None:
    """What a path belongs to: the scene, the folder of that scene, and the path within it; None for nothing.

    parts: the path's names, those of archives without their ends included.
    """
    first = next((number for number, part in enumerate(parts) if _VIEW.fullmatch(part)), None)
    if first is None:
        return None
    inner = "/".join(parts[first:])
    scene = next((name for part in reversed(parts[:first]) if (name := scene_named(part))), None)
    if scene is None or _IN_SCENE.fullmatch(inner) is None or ".." in inner:
        return None
    return scene, "/".join(parts[:first]), inner


@dataclass
class Found:
    """The files of one scene. root: the folder they are in; paths: within the scene -> writes that file; bytes: sum."""

    root: str
    bytes: int = 0
    paths: dict[str, Callable[[Path, Seen], None]] = field(default_factory=dict)


class Gathered:
    """The files of scenes in several folders and archives, which stay open. Use `gathered`."""

    def __init__(self, wanted: Sequence[str]) -> None:
        self.scenes: dict[str, Found] = {}
        self._wanted = set(wanted)

    def belongs(self, parts: Sequence[str]) -> tuple[str, str, str] | None:
        """`place_in_scene` for the scenes that are wanted."""
        place = place_in_scene(parts)
        return place if place is not None and place[0] in self._wanted else None

    def add(
        self, place: tuple[str, str, str], size: int, write: Callable[[Path, Seen], None], source: Path, name: str
    ) -> None:
        """Take in a file. Raises SplashbenchError where the scene is there twice, or the file is too large."""
        scene, root, inner = place
        if fault := size_fault(inner, size):
            raise SplashbenchError(f"{source}: {shown(name)} {fault}; nothing was unpacked")
        found = self.scenes.setdefault(scene, Found(root))
        if found.root != root:
            raise SplashbenchError(
                f"{source} holds {scene} twice, as {shown(found.root)!r} and {shown(root)!r}; give the folder of one "
                "by --from"
            )
        if inner in found.paths:
            raise SplashbenchError(f"{source} holds {shown(name)} twice; fetch it again")
        found.paths[inner] = write
        found.bytes += size

    def write(self, scene: str, folder: Path, seen: Seen) -> None:
        """Write a scene's files into the empty `folder`. seen: is told the bytes of each block."""
        # In the order found: that of an archive, which is read forwards then.
        for inner, write in self.scenes[scene].paths.items():
            target = folder / inner
            target.parent.mkdir(parents=True, exist_ok=True)
            write(target, seen)


@contextmanager
def gathered(places: Sequence[Path], wanted: Sequence[str]) -> Iterator[Gathered]:
    """Yield what the folders and archives `places` hold of the scenes `wanted`; nothing is written.

    Raises SplashbenchError for what is no folder and no archive, is damaged, or is no release's.
    """
    result = Gathered(wanted)
    with ExitStack() as stack:
        for place in map(Path, places):
            if place.is_dir():
                # A scene's own folder may be given: its name counts.
                for name in list_files(place).names:
                    parts = (place.resolve().name, *PurePosixPath(name).parts)
                    if is_archive(name):
                        _add_archive(result, stack, place / name, (*parts[:-1], _stem(parts[-1])))
                    elif (found := result.belongs(parts)) is not None:
                        path = place / name
                        result.add(found, path.stat().st_size, _copier(path), place, name)
            elif place.is_file() and is_archive(place.name):
                _add_archive(result, stack, place, (_stem(place.name),))
            else:
                what = "neither a folder nor an archive" if place.exists() else "not there"
                raise SplashbenchError(f"{place} is {what}; give what was downloaded ({', '.join(ARCHIVES)})")
        yield result


def _stem(name: str) -> str:
    ending = max((each for each in ARCHIVES if name.lower().endswith(each)), key=len)
    return name[: -len(ending)]


def _parts(above: Sequence[str], name: str) -> tuple[str, ...]:
    """The path of an entry; above: of the archive. An archive that is a part of several counts for its name only."""
    inner = PurePosixPath(name).parts
    if any(scene_named(part) for part in inner if not _VIEW.fullmatch(part)):
        return inner
    return (*above, *inner)


def _copier(path: Path) -> Callable[[Path, Seen], None]:
    def write(target: Path, seen: Seen) -> None:
        with open_plain(path, MAX_ARCHIVE_BYTES) as (source, size):
            try:
                copy_stream(source, target, size, seen)
            except ValueError as error:
                raise SplashbenchError(f"{path} changed while it was read ({error}); run the command again") from None

    return write


def _add_archive(result: Gathered, stack: ExitStack, path: Path, above: Sequence[str]) -> None:
    if path.name.lower().endswith(".zip"):
        _add_zip(result, stack, path, above)
    else:
        _add_tar(result, stack, path, above)


def _add_zip(result: Gathered, stack: ExitStack, path: Path, above: Sequence[str]) -> None:
    archive, size = stack.enter_context(open_zip(path))
    total = 0
    for entry in archive.infolist():
        place = None if entry.is_dir() else result.belongs(_parts(above, entry.filename))
        if place is None:
            continue
        if fault := entry_fault(entry, size):
            raise SplashbenchError(f"{path}: {shown(entry.filename)} {fault}; nothing was unpacked")
        total += entry.file_size

        def write(target: Path, seen: Seen, entry: zipfile.ZipInfo = entry) -> None:
            copy_entry(path, archive, entry, target, seen)

        result.add(place, entry.file_size, write, path, entry.filename)
    require_growth(path, size, total)


class _Bounded:
    """An unpacked stream that gives no more than some bytes at once, and no more than `most` in all."""

    def __init__(self, stream: IO[bytes], most: int) -> None:
        self._stream, self._most = stream, most

    def read(self, count: int = -1) -> bytes:
        if not 0 <= count <= _MOST_AT_ONCE:
            raise tarfile.ReadError(f"one of its headers has {count} bytes")
        with _told():
            return self._stream.read(count)

    def tell(self) -> int:
        return self._stream.tell()

    def seek(self, position: int, whence: int = 0) -> int:
        if whence == 0 and position > self._most:
            raise tarfile.ReadError(f"it unpacks to more than {MAX_GROWTH} times its size, as no release does")
        with _told():
            return self._stream.seek(position, whence)


@contextmanager
def _told() -> Iterator[None]:
    try:
        yield
    except _UNREADABLE as error:
        raise tarfile.ReadError(str(error) or type(error).__name__) from None


def _add_tar(result: Gathered, stack: ExitStack, path: Path, above: Sequence[str]) -> None:
    packed, size = stack.enter_context(open_plain(path, MAX_ARCHIVE_BYTES))
    most = max(MAX_GROWTH * size, 8 << 20)
    unpacked = _unpacked(stack, packed)
    total = count = 0
    try:
        bounded: Any = _Bounded(unpacked, most)
        archive = stack.enter_context(tarfile.TarFile(fileobj=bounded))
        for member in archive:
            count += 1
            if count > MAX_ENTRIES:
                raise SplashbenchError(f"{path} lists more than {MAX_ENTRIES} files, as no release does")
            place = None if member.isdir() else result.belongs(_parts(above, member.name))
            if place is None:
                continue
            if not member.isreg():
                raise SplashbenchError(f"{path}: {shown(member.name)} is no file; nothing was unpacked")
            total += member.size
            require_growth(path, size, total)
            result.add(place, member.size, _tar_writer(path, archive, member), path, member.name)
    except _DAMAGE as error:
        raise SplashbenchError(f"{path} is no whole tar archive ({one_line(str(error))}); fetch it again") from None


def _unpacked(stack: ExitStack, packed: IO[bytes]) -> Any:
    begin = packed.read(6)
    packed.seek(0)
    if begin.startswith(b"\x1f\x8b"):
        return stack.enter_context(gzip.GzipFile(fileobj=packed))
    if begin.startswith(b"BZh"):
        return stack.enter_context(bz2.BZ2File(packed))
    if begin == b"\xfd7zXZ\x00":
        return stack.enter_context(lzma.LZMAFile(packed))
    return packed


def _tar_writer(path: Path, archive: tarfile.TarFile, member: tarfile.TarInfo) -> Callable[[Path, Seen], None]:
    def write(target: Path, seen: Seen) -> None:
        try:
            source = archive.extractfile(member)
            if source is None:
                raise ValueError("it is no file")
            copy_stream(source, target, member.size, seen)
        except _DAMAGE as error:
            raise damaged(path, member.name, str(error)) from None

    return write

"""Unpacking the archive of the released scenes without trusting it: what the known layout holds, and nothing else.

A name outside the layout is never written, wherever it would lead; it is counted and told. A file that claims to be in
the layout is refused as a link, encrypted, larger than its kind ever is, or packed more tightly than real files are.
Each scene is written beside its place and renamed onto it, so that a folder with a scene's name holds all of it.
"""

from __future__ import annotations

import re
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, BinaryIO

from splashbench.download.archive import MAX_ARCHIVE_BYTES
from splashbench.download.meter import megabytes
from splashbench.errors import SplashbenchError, one_line
from splashbench.files import atomic_directory, atomic_path, is_staged_for, open_plain, raise_if_disk_full, remove_any
from splashbench.manifest import load_scenes

#: The folders of the layout: photographs as recorded, and cut to the container.
VARIANTS = {"full": "real_scene", "crop": "real_scene_crop"}
MESHES = "meshes"
#: Entries of the archive at most, bytes of its list of them, and how much larger than the archive all of it may be.
MAX_ENTRIES, MAX_LIST_BYTES, MAX_GROWTH = 200_000, 64 << 20, 20
# Bytes of one file by its kind, and how tightly one that is larger than `_SMALL` may be packed: real ones are not.
_LARGEST = {".jpg": 64 << 20, ".jpeg": 64 << 20, ".png": 64 << 20, ".json": 64 << 20, ".npz": 1 << 30, ".glb": 1 << 30}
_SMALL, _TIGHTEST = 8 << 20, 200
_BLOCK = 1 << 20
_WORD = r"[A-Za-z0-9_][A-Za-z0-9_-]{0,63}"
_IN_SCENE = re.compile(
    rf"(?:ims/{_WORD}/{_WORD}\.(?:jpg|jpeg|png)|seg/{_WORD}/{_WORD}\.png|container_mask/{_WORD}\.png"
    r"|train_meta\.json|test_meta\.json|init_pt_cld\.npz)"
)
_ROOT = r"(?:[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}/){0,3}?"
_SCENE_FILE = re.compile(rf"{_ROOT}(real_scene|real_scene_crop)/({_WORD})/(.+)", re.DOTALL)
_MESH_FILE = re.compile(rf"{_ROOT}meshes/({_WORD})\.glb")
# The records at the end of a zip file that say where its list is (APPNOTE 6.3.10, 4.3.14 to 4.3.16).
_END, _END_BYTES, _LOCATOR, _LOCATOR_BYTES = b"PK\5\6", 22, b"PK\6\7", 20
_END64, _END64_BYTES = b"PK\6\6", 56


@dataclass
class Contents:
    """What an archive holds of the layout.

    Attributes:
        scenes: (folder, scene), such as ("real_scene_crop", "bowl_001") -> path in the scene -> entry.
        meshes: scene -> entry of its scanned container.
        others: names that are no part of the layout, in the archive's order.
    """

    scenes: dict[tuple[str, str], dict[str, zipfile.ZipInfo]] = field(default_factory=dict)
    meshes: dict[str, zipfile.ZipInfo] = field(default_factory=dict)
    others: list[str] = field(default_factory=list)

    def bytes_of(self, folder: str, scene: str) -> int:
        """Of all files of a scene, unpacked."""
        return sum(entry.file_size for entry in self.scenes[folder, scene].values())


class SceneArchive:
    """The archive, opened; `contents` are checked. Use `open_archive`."""

    def __init__(self, path: Path, archive: zipfile.ZipFile, contents: Contents) -> None:
        self.path, self._zip, self.contents = path, archive, contents

    def unpack_scene(self, folder: str, scene: str, out: Path, seen: Callable[[int], None]) -> None:
        """Write a scene to `out`/`folder`/`scene`, whole or not at all. seen: is told the bytes of each block."""
        place = Path(out, folder, scene)
        entries = self.contents.scenes[folder, scene]
        with atomic_directory(place) as staging:
            for name, entry in sorted(entries.items()):
                target = staging / name
                target.parent.mkdir(parents=True, exist_ok=True)
                self._copy(entry, target, seen)

    def unpack_mesh(self, scene: str, out: Path, seen: Callable[[int], None]) -> Path:
        """Write the scan of a scene's container to `out`/meshes; returns its path."""
        place = Path(out, MESHES, f"{scene}.glb")
        with atomic_path(place) as temporary:
            self._copy(self.contents.meshes[scene], temporary, seen)
        return place

    def _copy(self, entry: zipfile.ZipInfo, target: Path, seen: Callable[[int], None]) -> None:
        copy_entry(self.path, self._zip, entry, target, seen)


def copy_entry(
    path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path, seen: Callable[[int], None]
) -> None:
    """Write an entry of the zip archive `path` to `target`, which is new. seen: is told the bytes of each block.

    Raises SplashbenchError where the entry is damaged.
    """
    try:
        with archive.open(entry) as source:
            copy_stream(source, target, entry.file_size, seen)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        raise damaged(path, entry.filename, str(error) or type(error).__name__) from None


def copy_stream(source: IO[bytes], target: Path, size: int, seen: Callable[[int], None]) -> None:
    """Write `size` bytes of `source`, which has no more, to `target`, which is new.

    Raises ValueError for another length, and DiskFullError.
    """
    written = 0
    try:
        with target.open("xb") as stream:
            while block := source.read(_BLOCK):
                written += len(block)
                if written > size:
                    raise ValueError("it is longer than the archive says")
                stream.write(block)
                seen(len(block))
    except OSError as error:
        raise_if_disk_full(target, error)
        raise
    if written != size:
        raise ValueError(f"it has {written} of {size} bytes")


def damaged(path: Path, name: str, reason: str) -> SplashbenchError:
    """The error for a damaged file `name` of the archive `path`."""
    return SplashbenchError(
        f"{path}: {shown(name)} is damaged ({one_line(reason)}); remove the archive, and fetch it again"
    )


@contextmanager
def open_archive(path: Path) -> Iterator[SceneArchive]:
    """Yield the archive `path`, whose entries have been checked; nothing is written.

    Raises SplashbenchError for what is no zip archive, is damaged, or holds what no release would.
    """
    with open_zip(path) as (archive, size):
        yield SceneArchive(Path(path), archive, _contents(Path(path), archive.infolist(), size))


@contextmanager
def open_zip(path: Path) -> Iterator[tuple[zipfile.ZipFile, int]]:
    """Yield the zip archive `path` and its bytes. Its list of entries has been checked, the entries have not.

    Raises SplashbenchError for what is no zip archive or damaged, or lists more than a release does.
    """
    path = Path(path)
    with open_plain(path, MAX_ARCHIVE_BYTES) as (stream, size):
        _check_list(path, stream, size)
        try:
            archive = zipfile.ZipFile(stream)
        except (zipfile.BadZipFile, ValueError, NotImplementedError, OverflowError, OSError, struct.error) as error:
            raise SplashbenchError(f"{path} is no whole zip archive ({one_line(str(error))}); fetch it again") from None
        with archive:
            entries = archive.infolist()
            if len(entries) > MAX_ENTRIES:
                raise SplashbenchError(f"{path} lists {len(entries)} files; the release has no more than {MAX_ENTRIES}")
            if sum(entry.compress_size for entry in entries) > size:
                raise SplashbenchError(f"{path} holds files that lie over each other; fetch it again")
            yield archive, size


def _check_list(path: Path, stream: BinaryIO, size: int) -> None:
    """Raise SplashbenchError where the archive's list of entries, which is read whole, is not to be believed."""
    tail = min(size, _END_BYTES + 0xFFFF + _LOCATOR_BYTES)
    stream.seek(size - tail)
    end = stream.read(tail)
    position = end.rfind(_END)
    if position < 0 or len(end) - position < _END_BYTES:
        raise SplashbenchError(f"{path} is no whole zip archive (it has no end); fetch it again")
    short = struct.unpack_from("<HI", end, position + 10)
    pointed, adjacent = None, None
    before = position - _LOCATOR_BYTES
    if before >= 0 and end[before : before + 4] == _LOCATOR:
        (place,) = struct.unpack_from("<Q", end, before + 8)
        pointed = _long_record(stream, min(place, size))
        adjacent = _long_record(stream, max(0, size - tail + before - _END64_BYTES))
    stream.seek(0)
    # Python takes the adjacent one, wherever the locator points to, else the short one: all have to be small.
    entries, bytes_ = map(max, zip(adjacent or short, pointed or (0, 0)))
    if entries > MAX_ENTRIES or bytes_ > MAX_LIST_BYTES:
        raise SplashbenchError(
            f"{path} lists {entries} files in {bytes_} bytes; the release has no more than {MAX_ENTRIES} in "
            f"{MAX_LIST_BYTES}"
        )


def _long_record(stream: BinaryIO, place: int) -> tuple[int, ...] | None:
    """Entries and bytes of the list by the zip64 record at `place`; None where there is none."""
    stream.seek(place)
    record = stream.read(_END64_BYTES)
    if len(record) < _END64_BYTES or not record.startswith(_END64):
        return None
    return struct.unpack_from("<QQ", record, 32)


def _contents(path: Path, entries: Sequence[zipfile.ZipInfo], size: int) -> Contents:
    known, contents = load_scenes(), Contents()
    for entry in entries:
        if entry.is_dir():
            continue
        name = entry.filename
        if (match := _SCENE_FILE.fullmatch(name)) and match[2] in known and _IN_SCENE.fullmatch(match[3]):
            place = contents.scenes.setdefault((match[1], match[2]), {})
            taken = match[3] in place
            place.setdefault(match[3], entry)
        elif (match := _MESH_FILE.fullmatch(name)) and match[1] in known:
            taken = match[1] in contents.meshes
            contents.meshes.setdefault(match[1], entry)
        else:
            contents.others.append(name)
            continue
        if taken:
            raise SplashbenchError(f"{path} holds {shown(name)} twice; fetch it again")
        fault = entry_fault(entry, size)
        if fault:
            raise SplashbenchError(f"{path}: {shown(name)} {fault}; nothing was unpacked")
    listed = [*(entry for scene in contents.scenes.values() for entry in scene.values()), *contents.meshes.values()]
    require_growth(path, size, sum(entry.file_size for entry in listed))
    if not contents.scenes:
        raise SplashbenchError(f"{path} holds no scene of the release ({', '.join(VARIANTS.values())}); give another")
    return contents


def require_growth(path: Path, size: int, total: int) -> None:
    """Raise SplashbenchError where the archive `path` of `size` bytes unpacks to more than a release does."""
    if total > max(MAX_GROWTH * size, _SMALL):
        raise SplashbenchError(
            f"{path} has {megabytes(size)} and unpacks to {megabytes(total)}, as no release does; nothing was unpacked"
        )


def entry_fault(entry: zipfile.ZipInfo, archive_bytes: int) -> str:
    """Why an entry whose name is in the layout is not unpacked; empty where it is."""
    kind = stat.S_IFMT(entry.external_attr >> 16)
    if kind not in (0, stat.S_IFREG):
        return "is a link" if kind == stat.S_IFLNK else "is no file"
    if entry.flag_bits & 0x1:
        return "is encrypted"
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        return "is packed in a way that the release does not use"
    if not 0 <= entry.header_offset < archive_bytes:
        return "lies outside the archive"
    if fault := size_fault(entry.filename, entry.file_size):
        return fault
    if entry.file_size > _SMALL and entry.file_size > _TIGHTEST * max(1, entry.compress_size):
        return f"is packed {entry.file_size // max(1, entry.compress_size)} times, more than {_TIGHTEST}"
    return ""


def size_fault(name: str, size: int) -> str:
    """Why a file of a scene is larger than its kind ever is; empty where it is not."""
    largest = _LARGEST[Path(name).suffix]
    return f"has {size} bytes, more than {largest}" if size > largest else ""


def shown(name: str) -> str:
    """A name of a stranger's archive as a line shows it."""
    return one_line(name)[:120]


def remove_leftovers(places: Iterable[Path]) -> None:
    """Remove what a killed process left half-made beside `places`. Only while nobody else unpacks there."""
    for place in (Path(each).absolute() for each in places):  # as the names within a half-made one are told
        for path in place.parent.resolve().glob(".tmp-*"):
            if is_staged_for(path, place):
                remove_any(path)

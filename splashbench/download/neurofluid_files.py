"""NeuroFluid's scenes out of whatever they come in: folders, zip archives, or several of them.

How the authors packed them is not documented. What is known is a scene's own layout, view_N/..., and that a folder or
an archive above it bears the scene's name. So both are looked for; everything else, pickles above all, is left out.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from splashbench.download.archive import MAX_ARCHIVE_BYTES
from splashbench.download.unpacking import (
    copy_entry,
    copy_stream,
    entry_fault,
    open_zip,
    require_growth,
    shown,
    size_fault,
)
from splashbench.errors import SplashbenchError, one_line
from splashbench.files import list_files, open_plain
from splashbench.manifest import load_neurofluid

ARCHIVE = ".zip"
# Archives that are not read here.
_OTHERS = (".tar", ".tgz", ".7z", ".rar", ".gz", ".bz2", ".xz")
_WORD = r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}"
_IN_SCENE = re.compile(
    rf"view_[0-9]{{1,6}}/(?:transforms_(?:train|test)\.json|(?:{_WORD}/){{0,4}}{_WORD}\.(?:png|npz))"
)
_VIEW = re.compile(r"view_[0-9]{1,6}")
Seen = Callable[[int], None]


class _Stem(str):
    """The name of an archive without its end: it may say which scene, and is no folder."""

    __slots__ = ()


@dataclass(frozen=True)
class Source:
    """A file that is or may hold files of scenes. parts: the names that lead to it, those that tell the scene first.

    named: whether the user named this very file.
    """

    path: Path
    parts: tuple[str, ...]
    named: bool = False


def scene_named(text: str) -> str | None:
    """The scene whose name is part of `text`, such as "WaterCube" for "water_cube_v2"; None for none."""
    letters = re.sub(r"[^a-z]", "", text.lower())
    return next((name for name in load_neurofluid().scenes if name.lower() in letters), None)


def is_archive(name: str) -> bool:
    """Whether a file's name is that of an archive which can be read."""
    return name.lower().endswith(ARCHIVE)


def is_other_archive(name: str) -> bool:
    """Whether a file's name is that of an archive which cannot be read here."""
    return name.lower().endswith(_OTHERS)


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
    return scene, "/".join(part for part in parts[:first] if not isinstance(part, _Stem)), inner


@dataclass
class Found:
    """The files of one scene. root: the folder they are in; paths: within the scene -> writes that file; bytes: sum."""

    root: str
    bytes: int = 0
    paths: dict[str, Callable[[Path, Seen], None]] = field(default_factory=dict)
    taken: dict[str, str] = field(default_factory=dict)  # files and folders, in small letters, and what they are


class Gathered:
    """The files of scenes in several folders and archives, which stay open. Use `gathered`."""

    def __init__(self, wanted: Sequence[str]) -> None:
        self.scenes: dict[str, Found] = {}
        self.nested: list[str] = []  # archives within archives, and such as are not read
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
        folders = [inner[:at] for at, letter in enumerate(inner) if letter == "/"]
        clash = [each for each in folders if found.taken.setdefault(each.lower(), "folder") != "folder"]
        if clash or inner.lower() in found.taken:
            raise SplashbenchError(f"{source}: {shown(name)} of {scene} is there twice; give one of both by --from")
        found.taken[inner.lower()] = "file"
        found.paths[inner] = write
        found.bytes += size

    def write(self, scene: str, folder: Path, seen: Seen) -> None:
        """Write a scene's files into the empty `folder`. seen: is told the bytes of each block."""
        # In the order found: that of an archive, which is read forwards then.
        for inner, write in self.scenes[scene].paths.items():
            target = folder / inner
            target.parent.mkdir(parents=True, exist_ok=True)
            write(target, seen)


def sources_in(places: Sequence[Path], tell: Callable[[str], None]) -> list[Source]:
    """The files of the folders and archives `places`, as somebody fetched them.

    Raises SplashbenchError for what is no folder and no zip archive.
    """
    found: list[Source] = []
    for place in {Path(each).resolve(): Path(each) for each in places}.values():
        if place.is_dir():
            # A scene's own folder may be given: its name counts, by whichever name.
            name = place.absolute().name
            name = name if scene_named(name) else place.resolve().name
            listing = list_files(place)
            if listing.faults:
                tell(f"left out: {len(listing.faults)} of {place}, such as: {one_line(listing.faults[0])}")
            found += [Source(place / each, (name, *PurePosixPath(each).parts)) for each in listing.names]
        elif place.is_file() and is_archive(place.name):
            found.append(Source(place, (place.name,), named=True))
        else:
            what = "neither a folder nor a zip archive" if place.exists() else "not there"
            raise SplashbenchError(f"{place} is {what}; give zip archives, or the folder of what you unpacked")
    return found


@contextmanager
def gathered(sources: Sequence[Source], wanted: Sequence[str], tell: Callable[[str], None]) -> Iterator[Gathered]:
    """Yield what `sources` hold of the scenes `wanted`; nothing is written.

    Archives that cannot be read are told and left out, unless they were named. Raises SplashbenchError for those, and
    for files that no release has.
    """
    result = Gathered(wanted)
    with ExitStack() as stack:
        for source in sources:
            if is_archive(source.path.name):
                _add_zip(result, stack, source, tell)
            elif (found := result.belongs(source.parts)) is not None:
                result.add(found, source.path.stat().st_size, _copier(source.path), source.path, "/".join(source.parts))
            elif is_other_archive(source.path.name):
                result.nested.append(str(source.path))
        yield result


def _parts(source: Source, name: str) -> tuple[str, ...]:
    """The path of an archive's entry, that of the archive before it."""
    inner = PurePosixPath(name.replace("\\", "/")).parts
    stem = _Stem(source.parts[-1][: -len(ARCHIVE)])
    if inner and inner[0] == stem:  # it holds a folder of its own name
        return (*source.parts[:-1], *inner)
    return (*source.parts[:-1], stem, *inner)


def _copier(path: Path) -> Callable[[Path, Seen], None]:
    def write(target: Path, seen: Seen) -> None:
        with open_plain(path, MAX_ARCHIVE_BYTES) as (source, size):
            try:
                copy_stream(source, target, size, seen)
            except ValueError as error:
                raise SplashbenchError(f"{path} changed while it was read ({error}); run the command again") from None

    return write


def _add_zip(result: Gathered, stack: ExitStack, source: Source, tell: Callable[[str], None]) -> None:
    path = source.path
    with ExitStack() as own:
        try:
            archive, size = own.enter_context(open_zip(path))
        except SplashbenchError as error:
            if source.named:
                raise
            tell(f"left out: {one_line(str(error))}")
            return
        total = 0
        for entry in archive.infolist():
            place = None if entry.is_dir() else result.belongs(_parts(source, entry.filename))
            if place is None:
                if is_archive(entry.filename) or is_other_archive(entry.filename):
                    result.nested.append(f"{path}: {shown(entry.filename)}")
                continue
            if fault := entry_fault(entry, size):
                raise SplashbenchError(f"{path}: {shown(entry.filename)} {fault}; nothing was unpacked")
            total += entry.file_size

            def write(target: Path, seen: Seen, entry: zipfile.ZipInfo = entry) -> None:
                copy_entry(path, archive, entry, target, seen)

            result.add(place, entry.file_size, write, path, entry.filename)
        require_growth(path, size, total)
        if total:  # it is read from later
            stack.enter_context(own.pop_all())

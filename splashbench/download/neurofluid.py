"""NeuroFluid's synthetic scenes in a folder: fetched from the authors' drive or given by hand, unpacked and checked.

The drive shares a folder, of which neither a list of files nor checksums are published. So every file that may belong
to a scene is fetched into DIR/neurofluid/, size and SHA-256 are noted in DIR/neurofluid.json when it first comes, and
both are held against it later. The scenes are made from what lies there (`splashbench.download.neurofluid_files`).
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Sequence
from contextlib import closing
from http.cookiejar import CookieJar
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from splashbench.download.archive import MAX_ARCHIVE_BYTES, patiently_located
from splashbench.download.connection import LostError, RefusedError
from splashbench.download.drive import Located, locate
from splashbench.download.drive_folder import DriveFile, DriveFolder, list_drive_folder
from splashbench.download.fetch import PATIENT, Patience, RemoteFile, alone, fetch, require_room
from splashbench.download.meter import Meter, megabytes
from splashbench.download.neurofluid_files import (
    Gathered,
    Source,
    gathered,
    is_archive,
    is_other_archive,
    place_in_scene,
    scene_named,
    sources_in,
)
from splashbench.download.scenes import SceneReport, check_downloaded
from splashbench.download.unpacking import open_zip, remove_leftovers
from splashbench.errors import SplashbenchError, one_line
from splashbench.files import atomic_directory, read_model, require_folder_place, sha256_file, write_model, write_text
from splashbench.manifest import load_neurofluid
from splashbench.progress import track

#: In the folder of the scenes: what was fetched, and the note of it.
FETCHED, NOTE_FILE = "neurofluid", "neurofluid.json"
_ATTRIBUTION = "ATTRIBUTION_neurofluid.txt"
# Archives that bear one of these names hold networks, not scenes.
_NO_SCENE = re.compile(r"model|checkpoint|ckpt|pretrain|weights", re.IGNORECASE)
_PART = re.compile(r"[^A-Za-z0-9_.-]")


class FileNote(BaseModel):
    """A file of the drive since it was first asked for. sha256: null until it has come whole."""

    model_config = ConfigDict(extra="forbid")
    file_id: str
    bytes: int = Field(gt=0)
    sha256: str | None = Field(default=None, pattern=r"^[0-9a-f]{64}$")


class _Notes(BaseModel):
    model_config = ConfigDict(extra="forbid")
    schema_version: Literal[1] = 1
    url: str
    files: dict[str, FileNote] = Field(default_factory=dict)


def require_neurofluid_names(names: Sequence[str]) -> list[str]:
    """The scenes called `names`, however they are written; all for none. Raises SplashbenchError for other names."""
    known = load_neurofluid().scenes
    chosen = set()
    for name in names:
        found = next((each for each in known if each.lower() == name.lower()), None)
        if found is None:
            near = difflib.get_close_matches(name.lower(), [each.lower() for each in known], n=1)
            hint = f", did you mean {scene_named(near[0])!r}?" if near else f"; there are {', '.join(known)}"
            raise SplashbenchError(f"NeuroFluid has no scene {name!r}{hint}")
        chosen.add(found)
    return [name for name in known if not names or name in chosen]


def download_neurofluid(
    out: Path,
    names: Sequence[str] = (),
    by_hand: Sequence[Path] = (),
    *,
    tell: Callable[[str], None],
    folder: DriveFolder | None = None,
    patience: Patience = PATIENT,
    check_again: bool = False,
) -> list[SceneReport]:
    """Fetch NeuroFluid's scenes `names` (all three for none) and unpack them to `out`/NAME; what is there stays.

    Args:
        by_hand: folders and archives as somebody fetched them; nothing is fetched then.
        folder: the drive's, the authors' own where it is not given.
        check_again: read scenes again that were checked before.

    Raises SplashbenchError where a scene cannot be had. Faults of scenes are reported.
    """
    out, folder = Path(out), folder or DriveFolder(load_neurofluid().drive_folder_id)
    chosen = require_neurofluid_names(names)
    require_folder_place(out)
    given = sources_in(by_hand, tell)
    with alone(out / NOTE_FILE, tell):
        remove_leftovers([*(out / name for name in chosen), out / NOTE_FILE, out / _ATTRIBUTION])
        for name in chosen:
            if (out / name).exists() and not (out / name).is_dir():
                raise SplashbenchError(f"{out / name} is a file, where a scene belongs; move it away")
        missing = [name for name in chosen if not _is_filled(out / name)]
        if missing:
            place = ", ".join(map(str, by_hand)) or folder.page
            sources = given if by_hand else _fetched(out, folder, missing, tell, patience)
            with gathered(sources, missing, tell) as files:
                _unpack(files, missing, place, out, folder, tell)
        _write_attribution(out)
        return [
            check_downloaded(
                out, name, made=name in missing, again=check_again, tell=lambda key: tell(f"checking {key}")
            )
            for name in chosen
        ]


def _is_filled(path: Path) -> bool:
    return path.is_dir() and any(path.iterdir())


def by_hand_text(folder: DriveFolder) -> str:
    """What a user can do where the drive refuses, as the end of an error's line."""
    return f"open {folder.page} in a browser, download the scenes, and give the zip archives, or the folder, by --from"


def may_hold_scene(file: DriveFile, wanted: Sequence[str]) -> bool:
    """Whether a file of the drive, by its path, is or may hold files of a scene that is wanted."""
    place = place_in_scene(file.path)
    if place is not None:
        return place[0] in wanted
    if not is_archive(file.path[-1]) or _NO_SCENE.search(file.name):
        return False
    scene = next((name for part in reversed(file.path) if (name := scene_named(part))), None)
    return scene is None or scene in wanted


def _fetched(
    out: Path, folder: DriveFolder, wanted: Sequence[str], tell: Callable[[str], None], patience: Patience
) -> list[Source]:
    """Fetch what may hold the scenes `wanted`."""
    remedy = by_hand_text(folder)
    tell(f"looking for {', '.join(wanted)} at {folder.page}")
    listed = list_drive_folder(folder, remedy=remedy, tell=tell, patience=patience)
    files = [file for file in listed if may_hold_scene(file, wanted)]
    if not files:
        held = ", ".join(one_line(file.name)[:80] for file in listed[:3]) or "nothing"
        raise SplashbenchError(
            f"{folder.page} holds no file that could be of {', '.join(wanted)}, but {held}"
            f"{f' and {len(listed) - 3} more' if len(listed) > 3 else ''}; {remedy}"
        )
    for file in listed:
        if is_other_archive(file.path[-1]) and not _NO_SCENE.search(file.name):
            tell(f"left out: {one_line(file.name)[:120]} is no zip archive; unpack it, and give the folder by --from")
    left = len(listed) - len(files)
    tell(f"{len(files)} files to fetch{f', {left} that are of no wanted scene left out' if left else ''}")
    fetcher = _Fetcher(out, folder, tell, patience)
    taken: set[str] = set()
    sources: list[Source] = []
    for file in track(files, "files"):  # a large one has its own bar
        name = "/".join(_PART.sub("_", part) for part in file.path)
        if any(part.startswith(".") for part in name.split("/")) or name.lower() in taken:
            tell(f"left out: {one_line(file.name)[:120]}, whose name no file here can have")
            continue
        taken.add(name.lower())
        sources.append(Source(fetcher.fetch(file, name), file.path))
    return sources


class _Fetcher:
    """Fetches files of the drive's `folder` into `out`/neurofluid, and keeps the note of them."""

    def __init__(self, out: Path, folder: DriveFolder, tell: Callable[[str], None], patience: Patience) -> None:
        self._out, self._folder, self._tell, self._patience = out, folder, tell, patience
        self._path = out / NOTE_FILE
        self._notes = read_model(self._path, _Notes) if self._path.is_file() else _Notes(url=folder.page)
        self._cookies = CookieJar()

    def fetch(self, file: DriveFile, name: str) -> Path:
        """Bring `file` to `out`/neurofluid/`name`, whole and the one that it always was; returns its path."""
        target, known = self._out / FETCHED / name, self._notes.files.get(name)
        part = target.with_name(f"{target.name}.part")
        if known is None or known.file_id != file.file_id:  # none yet, or the authors put another one there
            known = None
            part.unlink(missing_ok=True)  # whatever it was the beginning of
        elif known.sha256 is not None and target.is_file() and self._is_noted(target, known):
            return target
        page, title = self._folder.file_page(file), one_line(file.path[-1])
        located = self._located(file, title, page)
        size, again = located.size or 0, f"remove {self._path} and run the command again"
        if known is not None and size != known.bytes:
            raise SplashbenchError(
                f"{page} has {size} bytes, and {title} had {known.bytes} when it first came; if the authors have "
                f"replaced it, {again}"
            )
        if known is None and target.is_file() and target.stat().st_size != size:
            raise SplashbenchError(
                f"{target} has {target.stat().st_size} bytes, and {page} {size}; move it away, or give it by --from"
            )
        was_there = target.is_file()
        sha256, first = None if known is None else known.sha256, [located.url]
        self._note(name, FileNote(file_id=file.file_id, bytes=size, sha256=sha256))

        def where() -> str:  # for the first try it was just asked for
            address = self._folder.file_address(file)
            return first.pop() if first else locate(address, self._patience.timeout_seconds, self._cookies).url

        fetch(
            RemoteFile(page, size, sha256, title),
            target,
            remedy=f"if the authors have replaced it, {again}; else {by_hand_text(self._folder)}",
            patience=self._patience,
            locate=where,
            cookies=self._cookies,
        )
        if sha256 is None:
            self._require_kind(target, name, title, page, was_there)
            digest = sha256_file(target, MAX_ARCHIVE_BYTES)
            self._note(name, FileNote(file_id=file.file_id, bytes=size, sha256=digest))
        return target

    def _located(self, file: DriveFile, title: str, page: str) -> Located:
        try:
            address = self._folder.file_address(file)
            located = patiently_located(address, self._patience, self._cookies, self._tell)
        except (RefusedError, LostError) as error:
            fault = str(error)
        else:
            if located.size is not None and 0 < located.size <= MAX_ARCHIVE_BYTES:
                return located
            fault = (
                "the server does not say how large it is" if located.size is None else f"it has {located.size} bytes"
            )
        raise SplashbenchError(
            f"{title} could not be fetched from {page}: {fault}; {by_hand_text(self._folder)}"
        ) from None

    def _note(self, name: str, note: FileNote) -> None:
        self._notes.files[name] = note
        write_model(self._path, self._notes)

    def _require_kind(self, path: Path, name: str, title: str, page: str, was_there: bool) -> None:
        """Raise SplashbenchError where an archive that came is none, before its checksum counts."""
        if not is_archive(path.name):
            return
        try:
            with open_zip(path):
                return
        except SplashbenchError as error:
            fault = str(error)
        del self._notes.files[name]
        write_model(self._path, self._notes)
        if was_there:
            raise SplashbenchError(fault)
        path.unlink()
        raise SplashbenchError(
            f"{title} came from {page}, and is no whole zip archive; nothing was kept; {by_hand_text(self._folder)}"
        )

    @staticmethod
    def _is_noted(path: Path, known: FileNote) -> bool:
        return path.stat().st_size == known.bytes and sha256_file(path, MAX_ARCHIVE_BYTES) == known.sha256


def _unpack(
    files: Gathered,
    missing: Sequence[str],
    place: str,
    out: Path,
    folder: DriveFolder,
    tell: Callable[[str], None],
) -> None:
    lacking = [name for name in missing if name not in files.scenes]
    if lacking:
        raise SplashbenchError(
            f"{place}: no file of {', '.join(lacking)} (NAME/view_1/transforms_train.json and images) is in it"
            + (f", but archives are, such as {files.nested[0]}: unpack them" if files.nested else "")
            + f"; name the scenes that are there, or {by_hand_text(folder)}"
        )
    total = sum(files.scenes[name].bytes for name in missing)
    require_room(out, total, "the scenes take", "free some space, or name fewer scenes")
    tell(f"unpacking {', '.join(missing)} into {out} ({megabytes(total)})")
    with closing(Meter("unpacking", max(1, total), 0)) as meter:
        for name in missing:
            with atomic_directory(out / name) as staging:
                files.write(name, staging, meter.add)


def _write_attribution(out: Path) -> None:
    source = load_neurofluid()
    licence = f"Licence: {source.license or 'none stated'}"
    lines = (source.attribution, licence, f"From: {source.url}", source.repository)
    if not (out / _ATTRIBUTION).is_file():
        write_text(out / _ATTRIBUTION, "".join(f"{line}\n" for line in lines))

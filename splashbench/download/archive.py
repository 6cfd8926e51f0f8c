"""The archive of the released scenes: fetched from its drive or given by hand, and the same one every time.

Its authors publish neither size nor checksum. So both are noted when the archive first comes, in `real_scene.zip.json`
beside it, and held against every later one. What data_manifest/ states goes before the note.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from http.cookiejar import CookieJar
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from splashbench.download.connection import LostError, RefusedError
from splashbench.download.drive import Located, drive_address, locate
from splashbench.download.fetch import PATIENT, Patience, RemoteFile, fetch, patiently
from splashbench.download.meter import megabytes
from splashbench.errors import SplashbenchError
from splashbench.files import read_model, sha256_file, write_model
from splashbench.manifest import Archive, load_archive

#: Of the archive; the released one holds 14 000 photographs of 8 megapixels and as many cropped ones.
MAX_ARCHIVE_BYTES = 1 << 40
_MAX_NOTE_BYTES = 1 << 16
_NOTE_SUFFIX = ".json"


class ArchiveNote(BaseModel):
    """What is known of the archive since it first came. sha256: null until it has come whole."""

    model_config = ConfigDict(extra="forbid")
    schema_version: Literal[1] = 1
    url: str
    bytes: int | None = Field(default=None, gt=0)
    sha256: str | None = Field(default=None, pattern=r"^[0-9a-f]{64}$")


@dataclass(frozen=True)
class ArchiveSource:
    """Where the archive comes from. url: the address that is asked; page: the one that a user opens in a browser."""

    url: str
    page: str
    name: str
    bytes: int | None = None
    sha256: str | None = None

    @classmethod
    def official(cls, archive: Archive | None = None) -> ArchiveSource:
        """The authors' drive, with size and checksum where data_manifest/ states them."""
        archive = archive or load_archive()
        return cls(drive_address(archive.drive_file_id), archive.url, archive.name, archive.bytes, archive.sha256)

    def mirrored(self, url: str) -> ArchiveSource:
        """A copy of the same file at another address."""
        return replace(self, url=url, page=url)


def note_path(folder: Path, source: ArchiveSource) -> Path:
    """Where size and checksum of the archive are noted."""
    return Path(folder, source.name + _NOTE_SUFFIX)


def read_note(folder: Path, source: ArchiveSource) -> ArchiveNote:
    """What is known of the archive: the note in `folder`, and before it what `source` states."""
    path = note_path(folder, source)
    noted = read_model(path, ArchiveNote) if path.is_file() else ArchiveNote(url=source.page)
    stated = {"bytes": source.bytes, "sha256": source.sha256}
    return noted.model_copy(update={key: value for key, value in stated.items() if value is not None})


def obtain_archive(
    folder: Path,
    by_hand: Path | None,
    source: ArchiveSource,
    *,
    tell: Callable[[str], None],
    patience: Patience = PATIENT,
) -> Path:
    """The archive, whole and the one that it always was. Hold `alone(folder / source.name)` meanwhile.

    Args:
        folder: where it is fetched to, and where its size and checksum are noted.
        by_hand: the archive as somebody fetched it by other means; it stays where it is, and nothing is fetched.

    Raises SplashbenchError with what to do where it cannot be had, or is another one.
    """
    known = read_note(folder, source)
    if by_hand is not None:
        path = _given(by_hand)
    else:
        path = Path(folder, source.name)
        if path.is_file():
            _given(path)
        else:
            known = _fetched(path, source, known, tell, patience)
    size = path.stat().st_size
    again = f"if the authors have replaced the archive, remove {note_path(folder, source)} and run the command again"
    if known.bytes is not None and size != known.bytes:
        raise SplashbenchError(
            f"{path} has {size} bytes, and the archive had {known.bytes} when it first came; {again}"
        )
    tell(f"{path}: {megabytes(size)}, {'verifying' if known.sha256 else 'noting'} its SHA-256")
    digest = sha256_file(path, MAX_ARCHIVE_BYTES)
    if known.sha256 is not None and digest != known.sha256:
        place = "" if by_hand is not None else f" remove {path} to fetch it again;"
        raise SplashbenchError(
            f"{path} has not the SHA-256 {known.sha256} of the archive that first came;{place} {again}"
        )
    note = ArchiveNote(url=known.url, bytes=size, sha256=digest)
    if note != known or not note_path(folder, source).is_file():
        write_model(note_path(folder, source), note)
    return path


def _given(path: Path) -> Path:
    if not Path(path).is_file():
        raise SplashbenchError(f"{path} is no file; give the archive as it was downloaded")
    with Path(path).open("rb") as stream:
        begin = stream.read(1024)
    if not begin.startswith(b"PK"):
        page = b"<html" in begin.lower() or b"<!doctype" in begin.lower()
        what = "a web page that was saved in place of the archive" if page else "no zip archive"
        raise SplashbenchError(f"{path} is {what}; download it again in a browser, and wait until it has come whole")
    return Path(path)


def _fetched(
    path: Path, source: ArchiveSource, known: ArchiveNote, tell: Callable[[str], None], patience: Patience
) -> ArchiveNote:
    """Fetch the archive to `path`; returns what is known of it then."""
    remedy = by_hand_text(path, source)
    cookies = CookieJar()
    tell(f"looking for {source.name} at {source.page}")
    try:
        located = patiently_located(source.url, patience, cookies, tell)
    except (RefusedError, LostError) as error:
        raise SplashbenchError(f"{source.name} could not be fetched from {source.page}: {error}; {remedy}") from None
    found = located.size
    size = found if known.bytes is None else known.bytes
    if size is None:
        raise SplashbenchError(
            f"{source.name} could not be fetched from {source.page}: the server does not say how large it is; {remedy}"
        )
    if size > MAX_ARCHIVE_BYTES:
        raise SplashbenchError(f"{source.page} has {size} bytes, more than {MAX_ARCHIVE_BYTES}; {remedy}")
    if found is not None and found != size:
        raise SplashbenchError(
            f"{source.page} has {found} bytes, and the archive had {size} when it first came; if the authors have "
            f"replaced it, remove {path.name}.part and {path.name}{_NOTE_SUFFIX} in {path.parent}, and run the command "
            "again"
        )
    known = known.model_copy(update={"bytes": size})
    write_model(Path(f"{path}{_NOTE_SUFFIX}"), known)
    tell(f"fetching {source.name} ({megabytes(size)})")
    file = RemoteFile(source.page, size, known.sha256, source.name)
    first = [located.url]

    def address() -> str:  # for the first try it was just asked for
        return first.pop() if first else locate(source.url, patience.timeout_seconds, cookies).url

    fetch(file, path, remedy=remedy, patience=patience, locate=address, cookies=cookies)
    with path.open("rb") as stream:
        begin = stream.read(2)
    if begin != b"PK":
        path.unlink()
        if known.sha256 is None:  # its size is not the archive's
            Path(f"{path}{_NOTE_SUFFIX}").unlink(missing_ok=True)
        raise SplashbenchError(f"{source.page} is no zip archive, nothing was kept; {remedy}")
    return known


def patiently_located(url: str, patience: Patience, cookies: CookieJar, tell: Callable[[str], None]) -> Located:
    """`locate`, tried as often as `patience` has it. Raises RefusedError or LostError."""
    return patiently(lambda: locate(url, patience.timeout_seconds, cookies), patience, tell)


def by_hand_text(path: Path, source: ArchiveSource) -> str:
    """What a user can do where the archive cannot be fetched, as the end of an error's line."""
    return (
        f"open {source.page} in a browser, save it as {path}, and run the same command again, or give the file from "
        f"wherever it is by --from {source.name}"
    )

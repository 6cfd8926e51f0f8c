"""A shared folder of Google Drive: which files lie in it and below it.

The drive has a page for each folder that other sites may show within their own. It needs no login and no script, and
links every entry: a file's link leads to /file/d/ID, a folder's to /drive/folders/ID. Nothing else on it is believed.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from html.parser import HTMLParser
from http.cookiejar import CookieJar
from urllib.parse import urlencode, urlsplit

from splashbench.download.connection import BROWSER_AGENT, LostError, RefusedError, ask
from splashbench.download.drive import DRIVE, drive_address, parse, read_page, refusal
from splashbench.download.fetch import PATIENT, Patience, patiently
from splashbench.errors import SplashbenchError, one_line

#: Folders below each other, folders, and files of all of them.
MAX_DEEP, MAX_FOLDERS, MAX_FILES = 8, 500, 50_000
_ID = r"([A-Za-z0-9_-]{10,100})"
_FILE, _FOLDER = re.compile(rf"/file/d/{_ID}(?:/.*)?"), re.compile(rf"/drive/(?:u/\d{{1,2}}/)?folders/{_ID}(?:/.*)?")
_TITLE = "flip-entry-title"
_MAX_NAME = 200


@dataclass(frozen=True)
class DriveFile:
    """A file of a shared folder. path: names from the folder down to the file, as the drive shows them."""

    path: tuple[str, ...]
    file_id: str

    @property
    def name(self) -> str:
        """The path as people read it."""
        return "/".join(self.path)


@dataclass(frozen=True)
class DriveFolder:
    """A shared folder. drive: the address of the server."""

    folder_id: str
    drive: str = DRIVE

    @property
    def page(self) -> str:
        """The address that a user opens in a browser."""
        return f"{self.drive}/drive/folders/{self.folder_id}"

    def listing_address(self, folder_id: str) -> str:
        """The page that lists a folder."""
        return f"{self.drive}/embeddedfolderview?{urlencode({'id': folder_id})}"

    def file_address(self, file: DriveFile) -> str:
        """The address of a file, for `splashbench.download.drive.locate`."""
        return drive_address(file.file_id, self.drive)

    def file_page(self, file: DriveFile) -> str:
        """The address of a file that a user opens in a browser."""
        return f"{self.drive}/file/d/{file.file_id}/view"


def list_drive_folder(
    folder: DriveFolder, *, remedy: str, tell: Callable[[str], None], patience: Patience = PATIENT
) -> list[DriveFile]:
    """All files below `folder`, by their paths. remedy: what a user can do where it fails, the end of an error's line.

    Raises SplashbenchError where a folder cannot be read, or there is more than any release has.
    """
    files: list[DriveFile] = []
    cookies = CookieJar()
    open_folders: list[tuple[tuple[str, ...], str]] = [((), folder.folder_id)]
    seen = {folder.folder_id}
    while open_folders:
        path, folder_id = open_folders.pop()
        try:
            address = folder.listing_address(folder_id)
            entries = patiently(partial(_listed, address, patience.timeout_seconds, cookies), patience, tell)
        except (RefusedError, LostError) as error:
            place = f"has the folder {one_line('/'.join(path))}, which " if path else ""
            raise SplashbenchError(f"{folder.page} {place}could not be listed: {error}; {remedy}") from None
        for entry in entries:
            below = (*path, entry.name)
            if not entry.is_folder:
                files.append(DriveFile(below, entry.entry_id))
            elif entry.entry_id not in seen:  # a link to a folder above would lead round in a circle
                seen.add(entry.entry_id)
                open_folders.append((below, entry.entry_id))
            if len(files) > MAX_FILES or len(seen) > MAX_FOLDERS or len(below) > MAX_DEEP:
                raise SplashbenchError(
                    f"{folder.page} holds more than {MAX_FILES} files, {MAX_FOLDERS} folders or {MAX_DEEP} folders "
                    f"within each other, as no release does; {remedy}"
                )
    return sorted(files, key=lambda file: file.path)


@dataclass(frozen=True)
class _Entry:
    name: str
    entry_id: str
    is_folder: bool


def _listed(url: str, timeout_seconds: float, cookies: CookieJar) -> list[_Entry]:
    with ask(url, 0, timeout_seconds, cookies, BROWSER_AGENT) as answer:
        text, shown = (read_page(answer) if answer.is_page else ""), answer.url
    listing = _Listing()
    parse(listing, text)
    if not listing.entries and not listing.is_listing:
        raise RefusedError(refusal(text, shown))
    return listing.entries


class _Listing(HTMLParser):
    """The entries of a folder's page. is_listing: whether it is such a page at all, as that of an empty folder is."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.entries: list[_Entry] = []
        self.is_listing = False
        self._found: tuple[str, bool] | None = None  # id of the link that is open, and whether it is a folder's
        self._text = self._title = ""
        self._in_title = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        classes = values.get("class", "").split()
        self.is_listing |= any(each.startswith("flip-") for each in classes)
        if tag == "a":
            self._end()
            self._found = _linked(values.get("href", ""))
        elif _TITLE in classes:
            self._in_title = True

    def handle_endtag(self, tag: str) -> None:
        if tag == "a":
            self._end()
        elif tag == "div":
            self._in_title = False

    def handle_data(self, data: str) -> None:
        if self._found is None:
            return
        self._text += data
        if self._in_title:
            self._title += data

    def close(self) -> None:
        super().close()
        self._end()

    def _end(self) -> None:
        name = " ".join((self._title or self._text).split())
        if len(name) > _MAX_NAME:  # the end tells the kind
            name = name[: _MAX_NAME - 20] + name[-20:]
        if self._found is not None and name:
            self.entries.append(_Entry(name, *self._found))
        self._found, self._text, self._title, self._in_title = None, "", "", False


def _linked(address: str) -> tuple[str, bool] | None:
    """The identifier that a link leads to, and whether it is a folder's; None for a link to something else."""
    try:
        path = urlsplit(address).path
    except ValueError:
        return None
    if match := _FILE.fullmatch(path):
        return match[1], False
    if match := _FOLDER.fullmatch(path):
        return match[1], True
    return None

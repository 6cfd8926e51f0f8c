"""One public file of known size, fetched whole and verified, or not at all.

What has arrived lies in `<name>.part` and survives an interruption: the next call asks for the rest (HTTP Range). A
server that cannot give the rest sends all of it again. A lost connection is tried anew, after longer and longer waits.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from http.cookiejar import CookieJar
from pathlib import Path
from typing import TypeVar

from filelock import FileLock, Timeout

from splashbench.download.connection import LostError, OutOfRangeError, RefusedError, ask
from splashbench.download.meter import Meter, megabytes
from splashbench.errors import DiskFullError, SplashbenchError
from splashbench.files import raise_if_disk_full, require_file_place, sha256_file

# Slower than this for a timeout's length is as good as standing still.
_SLOWEST_BYTES_PER_SECOND = 1000


@dataclass(frozen=True)
class RemoteFile:
    """A public file.

    size: of the whole file, bytes. sha256: of all its bytes, hex, or None where nobody knows it. title: its name, where
    that is not the last part of the address.
    """

    url: str
    size: int
    sha256: str | None
    title: str = ""

    @property
    def name(self) -> str:
        """What users call it."""
        return self.title or self.url.rpartition("/")[2]


#: Gives the address of a file anew before each try: those of some servers hold for a while only. It may raise
#: RefusedError or LostError.
Locate = Callable[[], str]


@dataclass(frozen=True)
class Patience:
    """How long a download is tried.

    Attributes:
        tries: how many in a row may bring less than `step_bytes` that were not there before.
        wait_seconds: before the second try; twice as long before each after it.
        timeout_seconds: for connecting, and for every wait for more bytes.
    """

    tries: int = 5
    step_bytes: int = 1 << 20
    wait_seconds: float = 1.0
    timeout_seconds: float = 30.0


PATIENT = Patience()
Found = TypeVar("Found")


def patiently(ask_once: Callable[[], Found], patience: Patience, tell: Callable[[str], None]) -> Found:
    """What `ask_once` returns; where the connection is lost, after longer and longer waits, of which `tell` says.

    Raises LostError after as many tries as `patience` has, and what else `ask_once` raises.
    """
    wait = patience.wait_seconds
    for left in range(patience.tries - 1, -1, -1):
        try:
            return ask_once()
        except LostError as lost:
            if not left:
                raise
            pause = max(wait, lost.wait_seconds)
            tell(f"again in {pause:.0f} s: {lost}")
            time.sleep(pause)
            wait *= 2
    raise LostError("it was not tried")


def fetch(
    file: RemoteFile,
    target: Path,
    *,
    remedy: str,
    patience: Patience = PATIENT,
    locate: Locate | None = None,
    cookies: CookieJar | None = None,
) -> None:
    """Fetch `file` to `target`, unless it is there. One process at a time: hold `alone` meanwhile.

    Args:
        remedy: what a user can do where it fails, as the end of the error's line.
        locate: gives the address of each try, where `file.url` is only the place where users look.
        cookies: of this download, sent back to the server that set them.

    Raises SplashbenchError with the address and the reason, or where the disk has no room.
    """
    target = Path(target)
    if target.is_file() and _is_whole(file, target):
        return
    require_file_place(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f"{target.name}.part")
    if part.is_symlink():  # what it leads to is not this download's
        part.unlink()
    while True:
        try:
            continued = _Download(file, part, patience, locate, cookies).run()
        except (RefusedError, LostError) as error:
            raise SplashbenchError(f"{file.url} could not be fetched: {error}; {remedy}") from None
        if _is_whole(file, part):
            part.replace(target)
            return
        part.unlink()
        if not continued:
            raise SplashbenchError(f"{file.url} has not the SHA-256 {file.sha256}, nothing was kept; {remedy}")
        # The bytes of an earlier call may have been damaged: once more, from the start.


def _is_whole(file: RemoteFile, path: Path) -> bool:
    if path.stat().st_size != file.size:
        return False
    return file.sha256 is None or sha256_file(path, file.size) == file.sha256


@contextmanager
def alone(target: Path, tell: Callable[[str], None]) -> Iterator[None]:
    """Hold `target` for this process. Another process that holds it is waited for, and `tell` says so."""
    target = Path(target)
    require_file_place(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(target.with_name(f".{target.name}.lock"))
    try:
        lock.acquire(blocking=False)
    except Timeout:
        tell(f"another process is making {target}; waiting for it")
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def require_room(folder: Path, needed: int, what: str, remedy: str) -> None:
    """Raise SplashbenchError where the disk of `folder`, which exists, has less than `needed` bytes for `what`."""
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise SplashbenchError(f"{folder} has room for {megabytes(free)}, and {what} {megabytes(needed)}; {remedy}")


class _Download:
    """Brings the file `part` to its full size."""

    def __init__(
        self, file: RemoteFile, part: Path, patience: Patience, locate: Locate | None, cookies: CookieJar | None
    ) -> None:
        self._file, self._part, self._patience = file, part, patience
        self._locate, self._cookies = locate, cookies
        self._continued = 0 < self._have() <= file.size  # whether bytes of an earlier call are in it
        if not self._continued:
            part.unlink(missing_ok=True)

    def run(self) -> bool:
        """Whether bytes of an earlier call are in the file. Raises RefusedError, LostError or SplashbenchError."""
        missing = self._file.size - self._have()
        require_room(
            self._part.parent, missing, f"{self._file.name} takes", "free some space and run the command again"
        )
        wait, tries, best = self._patience.wait_seconds, 0, self._have()
        with closing(Meter(self._file.name, self._file.size, best)) as meter:
            while self._have() < self._file.size:
                try:
                    self._try(meter)
                except LostError as lost:
                    if self._have() >= best + self._patience.step_bytes:
                        wait, tries, best = self._patience.wait_seconds, 0, self._have()
                    else:
                        tries += 1
                    if tries >= self._patience.tries:
                        raise
                    pause = max(wait, lost.wait_seconds)
                    meter.wait(str(lost), pause)
                    time.sleep(pause)
                    wait *= 2
        return self._continued

    def _have(self) -> int:
        return self._part.stat().st_size if self._part.is_file() else 0

    def _try(self, meter: Meter) -> None:
        """One request. Returns with a file of full size, else raises."""
        have = self._have()
        url = self._file.url if self._locate is None else self._locate()
        try:
            with ask(url, have, self._patience.timeout_seconds, self._cookies) as answer:
                if self._locate is not None and answer.is_page:  # the address has run out: once more, with a new one
                    raise LostError("a web page came instead of the file")
                if answer.total not in (None, self._file.size):
                    self._refuse_size(f"{answer.total}")
                if answer.start not in (0, have):
                    self._start_over()
                    raise LostError("the server sent another part than the one that was asked for")
                self._append(answer.blocks(), answer.start, meter)
        except OutOfRangeError as error:  # though bytes are missing
            if error.total not in (None, self._file.size):
                self._refuse_size(f"{error.total}")
            self._start_over()
            raise LostError("the server cannot continue the file") from None
        if self._have() < self._file.size:
            raise LostError(f"the connection ended after {self._have()} of {self._file.size} bytes")

    def _append(self, blocks: Iterator[bytes], start: int, meter: Meter) -> None:
        if start == 0:
            self._continued = False
        have = start
        mark, marked_bytes = time.monotonic(), 0
        try:
            with self._part.open("ab" if start else "wb") as stream:
                for block in blocks:
                    if have + len(block) > self._file.size:
                        self._refuse_size(f"more than {self._file.size}")
                    stream.write(block)
                    have += len(block)
                    meter.show(have)
                    marked_bytes += len(block)
                    seconds = time.monotonic() - mark
                    if seconds > self._patience.timeout_seconds:
                        if marked_bytes < seconds * _SLOWEST_BYTES_PER_SECOND:
                            raise LostError("too slow")
                        mark, marked_bytes = time.monotonic(), 0
        except OSError as error:  # those of the network are LostError
            try:
                raise_if_disk_full(self._part, error)
            except DiskFullError:
                self._part.unlink(missing_ok=True)
                raise
            raise

    def _start_over(self) -> None:
        self._part.unlink(missing_ok=True)
        self._continued = False

    def _refuse_size(self, found: str) -> None:
        self._part.unlink(missing_ok=True)
        raise RefusedError(
            f"it has {found} bytes instead of {self._file.size}: it was changed, or a login page or proxy answered"
        )

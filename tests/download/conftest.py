"""A server on this machine that serves made-up files, well or badly, and remembers what it was asked."""

from __future__ import annotations

import hashlib
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from splashbench.download.fetch import RemoteFile


@dataclass
class Served:
    """A file and how it is served. Lists hold what the next requests get, one entry each.

    Attributes:
        ranges: whether the server knows Range. length: whether it says how long the file is.
        cuts: bytes after which the connection breaks. statuses: answered instead of the file.
        shifts: by how much the part that comes begins elsewhere than the one that was asked for.
        kind: Content-Type, where it is said. cookie: set by the answer.
        location: of a redirect. pause: seconds after each block of `block` bytes.
        asked: the Range header of each request, "" for none.
    """

    content: bytes
    ranges: bool = True
    length: bool = True
    cuts: list[int] = field(default_factory=list)
    statuses: list[int] = field(default_factory=list)
    shifts: list[int] = field(default_factory=list)
    location: str = ""
    pause: float = 0.0
    block: int = 1 << 14
    asked: list[str] = field(default_factory=list)
    kind: str = ""
    cookie: str = ""
    cookies_asked: list[str] = field(default_factory=list)


class FileServer:
    """Serves `files` (name -> Served) at `url`."""

    def __init__(self) -> None:
        self.files: dict[str, Served] = {}
        self.stopped = threading.Event()
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                with suppress(BrokenPipeError, ConnectionResetError):
                    outer.answer(self)

            def log_message(self, *words: object) -> None:
                pass

        self._http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._thread = threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.01})
        self._thread.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._http.server_port}"

    def add(self, name: str, content: bytes, **how: object) -> tuple[RemoteFile, Served]:
        """Serve `content`; returns its true description and how it is served."""
        self.files[name] = Served(content, **how)  # type: ignore[arg-type]
        return RemoteFile(f"{self.url}/{name}", len(content), hashlib.sha256(content).hexdigest()), self.files[name]

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        file = self.files[request.path[1:]]
        file.asked.append(request.headers.get("Range", ""))
        file.cookies_asked.append(request.headers.get("Cookie", ""))
        if file.statuses and (status := file.statuses.pop(0)) != 200:
            request.send_response(status)
            request.send_header("Retry-After", "0")
            request.end_headers()
            return
        if file.location:
            request.send_response(302)
            request.send_header("Location", file.location)
            request.end_headers()
            return
        wanted = re.fullmatch(r"bytes=(\d+)-", file.asked[-1])
        start = int(wanted[1]) if wanted and file.ranges else 0
        size = len(file.content)
        if start and file.shifts:
            start += file.shifts.pop(0)
        if start >= size > 0:
            request.send_response(416)
            request.send_header("Content-Range", f"bytes */{size}")
            request.end_headers()
            return
        # taken before a header goes out: who has the header may ask anew, on another thread, before this one goes on
        end = min(size, start + file.cuts.pop(0)) if file.cuts else size
        request.send_response(206 if start else 200)
        if start:
            request.send_header("Content-Range", f"bytes {start}-{size - 1}/{size}")
        if file.length:
            request.send_header("Content-Length", str(size - start))
        if file.kind:
            request.send_header("Content-Type", file.kind)
        if file.cookie:
            request.send_header("Set-Cookie", file.cookie)
        request.end_headers()
        for position in range(start, end, file.block):
            request.wfile.write(file.content[position : min(end, position + file.block)])
            if file.pause and self.stopped.wait(file.pause):
                return

    def close(self) -> None:
        self.stopped.set()
        self._http.shutdown()
        self._http.server_close()
        self._thread.join()


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[FileServer]:
    for name in ("no_proxy", "NO_PROXY"):  # a proxy of the developer's knows nothing of this server
        monkeypatch.setenv(name, "127.0.0.1,localhost")
    files = FileServer()
    yield files
    files.close()


@pytest.fixture
def wait_for() -> Callable[[Callable[[], bool]], None]:
    """Wait until something is true, for 60 seconds at most."""

    def wait(condition: Callable[[], bool]) -> None:
        end = time.monotonic() + 60
        while not condition():
            assert time.monotonic() < end, "it never came true"
            time.sleep(0.01)

    return wait

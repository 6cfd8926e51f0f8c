"""One request for a file over the network: where it may lead, and in words why it failed.

urllib of the standard library takes proxies and certificates from the usual environment variables (https_proxy,
SSL_CERT_FILE). Its handlers of file://, ftp:// and data: are left out.
"""

from __future__ import annotations

import http.client
import re
import socket
import ssl
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from email.message import Message
from http import HTTPStatus
from http.cookiejar import CookieJar
from typing import IO, Any
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit

from splashbench.version import __version__

#: What requests call the program, and what they call it where pages are meant for browsers.
AGENT = f"splashbench/{__version__}"
BROWSER_AGENT = f"Mozilla/5.0 (compatible; {AGENT})"
_BLOCK_BYTES = 1 << 18
_LONGEST_WAIT_SECONDS = 60.0
_PAGES = ("text/html", "application/xhtml+xml")
# Of the statuses below 500 these may pass (RFC 9110, RFC 6585, RFC 8470).
_PASSING = (HTTPStatus.REQUEST_TIMEOUT, HTTPStatus.TOO_EARLY, HTTPStatus.TOO_MANY_REQUESTS)


class RefusedError(Exception):
    """The answer is final: another try would give the same. The message says what is wrong."""


class LostError(Exception):
    """The connection failed, and another try may succeed. wait_seconds: what the server asks to wait."""

    def __init__(self, reason: str, wait_seconds: float = 0.0) -> None:
        super().__init__(reason)
        self.wait_seconds = wait_seconds


class OutOfRangeError(Exception):
    """The server has no bytes from the offset on (status 416). total: bytes of the whole file, if it says so."""

    def __init__(self, total: int | None) -> None:
        super().__init__(total)
        self.total = total


@dataclass(frozen=True)
class Answer:
    """A server's answer. start: offset in bytes of its first byte; total: bytes of the whole file, if it says so."""

    start: int
    total: int | None
    response: http.client.HTTPResponse

    @property
    def is_page(self) -> bool:
        """Whether the server says that this is a web page."""
        return self.response.headers.get_content_type() in _PAGES

    @property
    def url(self) -> str:
        """The address that answered in the end, after all redirects."""
        return self.response.url

    def blocks(self) -> Iterator[bytes]:
        """The bytes as they arrive. Raises LostError where the connection breaks; a short answer just ends."""
        while True:
            try:
                block = self.response.read1(_BLOCK_BYTES)  # returns what there is: `read` waits for a full block
            except (OSError, http.client.HTTPException) as error:
                raise _fault(error) from None
            if not block:
                return
            yield block


@contextmanager
def ask(
    url: str, offset: int, timeout_seconds: float, cookies: CookieJar | None = None, agent: str = AGENT
) -> Iterator[Answer]:
    """Ask for the bytes of `url` from `offset` on; the server may answer with the whole file.

    cookies: those of earlier answers, which this one may add to; none are sent or taken where there is no jar.
    agent: what the program calls itself.

    Raises RefusedError, LostError or OutOfRangeError.
    """
    headers = {"User-Agent": agent, "Accept-Encoding": "identity"}
    if offset:
        headers["Range"] = f"bytes={offset}-"
    try:
        response = _opener(cookies).open(urllib.request.Request(url, headers=headers), timeout=timeout_seconds)
    except HTTPError as error:
        with error:
            raise _status_fault(error, offset) from None
    except (OSError, http.client.HTTPException) as error:
        raise _fault(error) from None
    except ValueError:  # what it leads to cannot be read as an address
        raise RefusedError("it leads to what is no address") from None
    with response:
        yield _answer(response, offset)


def _answer(response: http.client.HTTPResponse, offset: int) -> Answer:
    if response.status == HTTPStatus.PARTIAL_CONTENT:
        found = re.fullmatch(r"bytes (\d{1,18})-\d{1,18}/(\d{1,18}|\*)", response.headers.get("Content-Range", ""))
        if not offset or found is None:
            raise RefusedError("the server sent a part of the file that was not asked for")
        return Answer(int(found[1]), None if found[2] == "*" else int(found[2]), response)
    if response.status != HTTPStatus.OK:
        raise RefusedError(f"the server answered with status {response.status}")
    return Answer(0, response.length, response)


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Redirects stay within HTTP, and where the address is https within https."""

    def redirect_request(
        self, req: urllib.request.Request, fp: IO[bytes], code: int, msg: str, headers: Any, newurl: str
    ) -> urllib.request.Request | None:
        if not may_lead(req.full_url, newurl):
            fp.close()
            raise RefusedError(f"it leads to {newurl}, which may not be followed")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def may_lead(url: str, target: str) -> bool:
    """Whether a redirect from `url` to `target` is followed."""
    allowed = ("https",) if urlsplit(url).scheme == "https" else ("http", "https")
    return urlsplit(target).scheme in allowed


def _opener(cookies: CookieJar | None) -> urllib.request.OpenerDirector:
    opener = urllib.request.OpenerDirector()
    if cookies is not None:
        opener.add_handler(urllib.request.HTTPCookieProcessor(cookies))
    for handler in (
        *(urllib.request.ProxyHandler(), urllib.request.UnknownHandler(), urllib.request.HTTPHandler()),
        *(urllib.request.HTTPSHandler(), urllib.request.HTTPDefaultErrorHandler(), _Redirects()),
        urllib.request.HTTPErrorProcessor(),
    ):
        opener.add_handler(handler)
    return opener


def _status_fault(error: HTTPError, offset: int) -> Exception:
    if error.code == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and offset:
        found = re.fullmatch(r"bytes \*/(\d{1,18})", error.headers.get("Content-Range", ""))
        return OutOfRangeError(int(found[1]) if found else None)
    if 300 <= error.code < 400:  # to another scheme, or in a circle
        return RefusedError(f"it leads to {error.headers.get('Location', 'nowhere')}, which may not be followed")
    text = f"the server answered {error.code} {error.reason}"
    if error.code < 500 and error.code not in _PASSING:
        return RefusedError(text)
    return LostError(text, _asked_wait(error.headers))


def _asked_wait(headers: Message) -> float:
    asked = headers.get("Retry-After", "")
    return min(float(asked), _LONGEST_WAIT_SECONDS) if asked.isdecimal() else 0.0


def _fault(error: Exception) -> Exception:
    """What an error of the network means, in words."""
    reason = error.reason if isinstance(error, URLError) else error
    if isinstance(reason, ssl.SSLCertVerificationError):
        return RefusedError(f"its certificate is not trusted: {reason.verify_message}")
    if isinstance(reason, socket.gaierror):
        return LostError("the host's name cannot be resolved")
    if isinstance(reason, TimeoutError):
        return LostError("no answer in time")
    if isinstance(reason, http.client.IncompleteRead):
        return LostError("the connection broke")
    if isinstance(reason, OSError) and reason.strerror:
        return LostError(reason.strerror)
    return LostError(str(reason) or type(reason).__name__)

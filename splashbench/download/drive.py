"""A file on a public drive, whose server answers with a page first: where the file itself is, or why it cannot be had.

Google Drive asks before it sends a large file that it has not searched for viruses. Its page holds a form, and the
form's address with its hidden fields is the file. It holds for a while only, so it is asked for anew before each try.
Where too many have fetched a file, or it is not shared, a page says so; what that page says is what the user reads.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass, field
from html.parser import HTMLParser
from http.cookiejar import CookieJar
from urllib.parse import urlencode, urljoin, urlsplit

from splashbench.download.connection import Answer, RefusedError, ask, may_lead
from splashbench.errors import one_line

_MAX_PAGE_BYTES = 1 << 20
_MAX_WORDS = 300
# A page may lead to the next one; more than this is a circle.
_MOST_PAGES = 3
# Signs "<" of a page without ">".
_MOST_OPEN = 1000
_FORM = "download-form"
# Classes of the paragraphs in which the drive says what is wrong.
_FAULTS = ("uc-error-subcaption", "uc-error-caption")
_LOGIN = re.compile(r"^accounts\.", re.IGNORECASE)


#: Google Drive's own address.
DRIVE = "https://drive.google.com"


def drive_address(file_id: str, drive: str = DRIVE) -> str:
    """The address of a file of Google Drive, which answers with the file or with a page."""
    return f"{drive}/uc?{urlencode({'export': 'download', 'id': file_id})}"


@dataclass(frozen=True)
class Located:
    """Where a file is for now. size: of the whole file in bytes, or None where the server does not say."""

    url: str
    size: int | None


def locate(url: str, timeout_seconds: float, cookies: CookieJar | None = None) -> Located:
    """Where the file of the address `url` is, through pages that ask whether it is really wanted.

    Raises RefusedError where a page says that there is no such file, or is none that is known, and LostError.
    """
    for _ in range(_MOST_PAGES):
        with ask(url, 0, timeout_seconds, cookies) as answer:
            if not answer.is_page:
                return Located(url, answer.total)
            page, shown = _parsed(read_page(answer)), answer.url
        try:
            target = page.target()
            following = None if target is None else urljoin(shown, target)
            allowed = following is not None and may_lead(shown, following)
        except ValueError:
            raise RefusedError("its page leads to what is no address") from None
        if following is None:
            raise RefusedError(_reason(page, shown))
        if not allowed:
            raise RefusedError(f"it leads to {one_line(following)[:_MAX_WORDS]}, which may not be followed")
        url = following
    raise RefusedError("one page led to another, and none to the file")


def read_page(answer: Answer) -> str:
    """The text of the page that answered. Raises RefusedError for a very long one, and LostError."""
    content = b""
    for block in answer.blocks():
        content += block
        if len(content) > _MAX_PAGE_BYTES:
            raise RefusedError("a very long web page came instead of the file")
    return content.decode("utf-8", errors="replace")


def parse(page: HTMLParser, text: str) -> None:
    """Let `page` take in a page's text. Raises RefusedError for one that no browser would make sense of."""
    if text.count("<") > text.count(">") + _MOST_OPEN:  # the parser goes back to each that is not closed
        raise RefusedError("what came is no web page")
    with suppress(AssertionError):  # the parser's, at "<![" without a name: what came before it counts
        page.feed(text)
        page.close()


def _parsed(text: str) -> _Page:
    page = _Page()
    parse(page, text)
    return page


def refusal(text: str, url: str) -> str:
    """Why the page `text`, which came from `url`, is not what was asked for: in its own words where it has some."""
    return _reason(_parsed(text), url)


def _reason(page: _Page, url: str) -> str:
    if _LOGIN.match(urlsplit(url).hostname or ""):
        return "it asks for a login: the file is not shared with everybody, or no longer"
    said = one_line(" ".join(page.fault.split()))[:_MAX_WORDS].rstrip(". ")
    if said:
        return f"the drive answered: {said}"
    title = one_line(" ".join(page.title.split()))[:_MAX_WORDS]
    return f"a web page came instead of the file{f' ({title})' if title else ''}: a login, a proxy or a limit answered"


@dataclass
class _Form:
    action: str
    fields: list[tuple[str, str]] = field(default_factory=list)


class _Page(HTMLParser):
    """What a page of the drive tells: its form, its title, and what it says is wrong."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.form: _Form | None = None
        self.title = self.fault = ""
        self._in_form = False
        self._into = ""  # of title and fault, what the text goes to

    def target(self) -> str | None:
        """The address that the form leads to, relative to the page's; None without a form."""
        if self.form is None or not self.form.action:
            return None
        parts = urlsplit(self.form.action)
        query = "&".join(filter(None, (parts.query, urlencode(self.form.fields))))
        return parts._replace(query=query, fragment="").geturl()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        if tag == "form" and values.get("id") == _FORM:
            self.form, self._in_form = _Form(values.get("action", "")), True
        elif tag == "input" and self._in_form and self.form is not None:
            if values.get("type", "").lower() == "hidden" and values.get("name"):
                self.form.fields.append((values["name"], values.get("value", "")))
        elif tag == "title":
            self._into = "title"
        elif tag == "p" and set(values.get("class", "").split()) & set(_FAULTS):
            self._into = "fault"

    def handle_endtag(self, tag: str) -> None:
        if tag == "form":
            self._in_form = False
        elif tag in ("p", "title"):
            self._into = ""

    def handle_data(self, data: str) -> None:
        if self._into == "title":
            self.title += data
        elif self._into == "fault":
            self.fault += f"{data} "

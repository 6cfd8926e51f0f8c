"""Parts of a page: tables, notes, lists and pictures, as data; `blocks.html.j2` says how each looks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class Table:
    """A table of text cells; `classes` of its rows colour them."""

    kind: ClassVar[str] = "table"
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    classes: Sequence[str] = ()


@dataclass(frozen=True)
class Note:
    """A paragraph of small print."""

    kind: ClassVar[str] = "note"
    text: str


@dataclass(frozen=True)
class Bullets:
    """A list of lines."""

    kind: ClassVar[str] = "bullets"
    lines: Sequence[str]


@dataclass(frozen=True)
class Picture:
    """An embedded picture: its address, and what it shows. caption: below it, in a sheet."""

    kind: ClassVar[str] = "picture"
    uri: str
    alt: str
    caption: str = ""


@dataclass(frozen=True)
class Sheet:
    """Pictures side by side."""

    kind: ClassVar[str] = "sheet"
    pictures: Sequence[Picture]


Block = Table | Note | Bullets | Picture | Sheet

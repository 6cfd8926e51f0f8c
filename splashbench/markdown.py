"""Markdown: tables, lists, and text from strangers' files made safe for both."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping

from splashbench.errors import one_line as plain_line

# Markup anywhere in a line; an underscore within a word is none, and method names are full of them.
_MARKUP = re.compile(r"[\\`*\[\]~&$]|(?<![A-Za-z0-9_])_+|_+(?![A-Za-z0-9_])")
# What GitHub makes a link of without any markup: addresses, and names of hosts and mailboxes.
_ADDRESS = re.compile(r"(?<=[A-Za-z])(?=:(?://|[^\s:]+@))|(?<=www)(?=\.)|(?<=\w)(?=@\w)", re.IGNORECASE)
# What begins a heading, a list, a quotation, a rule or a block of code where it stands first.
_OPENING = re.compile(r"^(#|[-+=>](?=\s|[-+=>]|$)|\d{1,9}(?=[.)](?:\s|$)))")


def one_line(text: str) -> str:
    """`text` as one line without control characters, that cannot open an HTML tag. Markdown in it stays Markdown."""
    return plain_line(text).replace("<", "&lt;")


def escaped(text: str) -> str:
    """`text` of a stranger as one line in which nothing is markup: no link, picture, heading, HTML or code."""
    line = _MARKUP.sub(lambda found: "".join(f"\\{letter}" for letter in found[0]), plain_line(text))
    line = _ADDRESS.sub("\\\\", line)
    opening = _OPENING.match(line)
    if opening:
        end = opening.end() if opening[0].isdigit() else 0
        line = f"{line[:end]}\\{line[end:]}"
    return line.replace("<", "&lt;")


def bullets(lines: Iterable[str]) -> str:
    """A list with an item for each of `lines`, which are taken as they are."""
    return "\n".join(f"- {line}" for line in lines)


def table(columns: Mapping[str, Iterable[str]], right: Collection[str] = ()) -> str:
    """A table of cells by column title; every cell becomes one line.

    Args:
        columns: title -> the column's cells, as many in each.
        right: titles of the columns that are aligned to the right, as numbers are.
    """
    rule = ["---:" if title in right else "---" for title in columns]
    rows = [list(columns), rule, *zip(*columns.values(), strict=True)]
    return "\n".join("| " + " | ".join(one_line(cell).replace("|", "\\|") for cell in row) + " |" for row in rows)

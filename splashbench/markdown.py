"""Markdown: tables, lists, and text from strangers' files made safe for both."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping


def one_line(text: str) -> str:
    """`text` as one line that cannot open an HTML tag."""
    return " ".join(text.split()).replace("<", "&lt;")


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

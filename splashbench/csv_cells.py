"""Cells of CSV files from strangers' text: no spreadsheet takes one for a formula, and none breaks its line."""

from __future__ import annotations

from splashbench.errors import one_line

_FORMULA = ("=", "+", "-", "@")


def csv_text(text: str) -> str:
    """`text` as one line without control characters, with an apostrophe before what a spreadsheet would compute.

    It is for text alone: a negative number is one and stays.
    """
    line = one_line(text)
    return f"'{line}" if line.startswith(_FORMULA) else line

"""Printing: text for people on standard error, one JSON object on standard output."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from splashbench.errors import one_line


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add the `--json` flag."""
    parser.add_argument("--json", action="store_true", help="print one JSON object on standard output")


def say(text: str = "") -> None:
    """Print for people, on standard error. Control characters are replaced: text may come from strangers' files."""
    shown = "".join(letter if letter.isprintable() or letter == "\n" else "?" for letter in text)
    print(shown, file=sys.stderr, flush=True)


def emit(data: dict[str, Any]) -> None:
    """Print the one JSON object of a command run with `--json`. NaN and infinity raise ValueError: JSON has neither."""
    print(json.dumps(data, indent=1, allow_nan=False))


def report_faults(noun: str, place: Path, faults: Sequence[str], as_json: bool) -> int:
    """Print every fault of the `noun` (scene, submission) at `place` on a line of its own; returns the exit status."""
    if as_json:
        emit({noun: str(place), "ok": not faults, "faults": list(faults)})
    for fault in faults:
        say(f"error: {one_line(fault)}")
    if not faults:
        say(f"{place}: no fault found")
    return 1 if faults else 0


def table(header: list[str], rows: list[list[str]]) -> str:
    """Plain text in columns: the first left-aligned, the others right-aligned."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = []
    for row in [header, *rows]:
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:]))]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)

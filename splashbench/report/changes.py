"""What a new leaderboard says that the one it replaces did not: rows that came, went, or have other figures."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable

from splashbench.report.table import METHOD_COLUMNS, SCENE_COLUMNS
from splashbench.score.metrics import METRICS

#: What names a row: two with the same of all of these are one row at two times.
_NAMES = (*SCENE_COLUMNS, *(name for name in METHOD_COLUMNS if name != "settings_digest"))
_SHOWN = 20


def changes(before: str, after: str) -> list[str]:
    """A line per row that differs between two leaderboards as CSV text; none where they say the same.

    A method whose version or settings changed is the same row with other figures.
    """
    old, new = (_rows(text) for text in (before, after))
    lines = [f"gone: {_name(key)}" for key in old if key not in new]
    lines += [f"new: {_name(key)}" for key in new if key not in old]
    for key in new:
        if key in old:
            lines += _differences(_name(key), old[key], new[key])
    return lines


def shortened(lines: Iterable[str]) -> list[str]:
    """The first of `lines`, and how many more there are."""
    lines = list(lines)
    more = len(lines) - _SHOWN
    return lines if more <= 0 else [*lines[:_SHOWN], f"and {more} more"]


def _rows(text: str) -> dict[tuple[str, ...], dict[str, str]]:
    """Rows by their names; of several with one name, the n-th has n behind it."""
    found: dict[tuple[str, ...], dict[str, str]] = {}
    for row in csv.DictReader(io.StringIO(text)):
        key = tuple(row.get(name) or "" for name in _NAMES)
        number = 1
        while (*key, str(number)) in found:
            number += 1
        found[(*key, str(number))] = row
    return found


def _name(key: tuple[str, ...]) -> str:
    fields = dict(zip(_NAMES, key))
    return f"{fields['method']} [{fields['preset']}] on {fields['scene']}, {fields['hardware']}"


def _differences(name: str, old: dict[str, str], new: dict[str, str]) -> list[str]:
    figures = [
        f"{metric} {old.get(metric) or 'none'} -> {new.get(metric) or 'none'}"
        for metric in ("status", "seed", "method_version", *METRICS)
        if (old.get(metric) or "") != (new.get(metric) or "")
    ]
    return [f"changed: {name}: {', '.join(figures)}"] if figures else []

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

    Of rows with one name, those with the same settings are one row; of the others, one after the other. So a method
    whose version or settings changed is the same row with other figures. A `before` that is no CSV has no rows.
    """
    try:
        old = _rows(before)
    except csv.Error:
        old = {}
    new = _rows(after)
    gone, came, changed = [], [], []
    for key in [*old, *(key for key in new if key not in old)]:
        was, now = list(old.get(key, [])), list(new.get(key, []))
        partners: dict[str | None, list[dict[str, str]]] = {}
        for b in now:
            partners.setdefault(b.get("settings_digest"), []).append(b)
        alone, taken = [], set()
        for a in was:
            same = partners.get(a.get("settings_digest"))
            if same:
                b = same.pop(0)
                taken.add(id(b))
                changed += _differences(_name(key), a, b)
            else:
                alone.append(a)
        was, now = alone, [b for b in now if id(b) not in taken]
        for a, b in zip(was, now):
            changed += _differences(_name(key), a, b)
        gone += [f"gone: {_name(key)}" for _ in was[len(now) :]]
        came += [f"new: {_name(key)}" for _ in now[len(was) :]]
    return [*gone, *came, *changed]


def shortened(lines: Iterable[str]) -> list[str]:
    """The first of `lines`, and how many more there are."""
    lines = list(lines)
    more = len(lines) - _SHOWN
    return lines if more <= 0 else [*lines[:_SHOWN], f"and {more} more"]


def _rows(text: str) -> dict[tuple[str, ...], list[dict[str, str]]]:
    """Rows by their names."""
    found: dict[tuple[str, ...], list[dict[str, str]]] = {}
    csv.field_size_limit(1 << 24)  # a failed run's reason may be long
    for row in csv.DictReader(io.StringIO(text)):
        found.setdefault(tuple(row.get(name) or "" for name in _NAMES), []).append(row)
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

"""The chapters of one recording: whether the files that are listed follow each other without a gap.

Cameras split a long recording into files. Listed in the wrong order, or with one left out, they would still be read one
after another, and everything behind the seam would lie at a wrong time. Three witnesses are asked, each only as far as
it speaks: the camera's own file names (GX010003, GX020003: chapters 1 and 2 of recording 3; GoPro's "Camera File
Chaptering Information"), the timecodes, and the times of creation.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Protocol

from splashbench.errors import SplashbenchError

_DAY_S = 86400.0
# A timecode counts whole frames, and at 29.97 frames a second may run a thousandth slow.
_SEAM_S, _SEAM_SHARE = 1.0, 0.002
_TIMECODE = re.compile(r"(\d{2}):(\d{2}):(\d{2})[:;](\d{2,3})")
_NAMES = (
    re.compile(r"^(?P<before>.*?)[ _.-]*(?:G[HXLS](?P<chapter>\d{2})(?P<number>\d{4}))$", re.IGNORECASE),
    re.compile(r"^(?P<before>.*?)[ _.-]*GOPR(?P<number>\d{4})$", re.IGNORECASE),
    re.compile(r"^(?P<before>.*?)[ _.-]*GP(?P<chapter>\d{2})(?P<number>\d{4})$", re.IGNORECASE),
)


class ChapterFacts(Protocol):
    """What a file says of itself (`VideoInfo`)."""

    @property
    def fps(self) -> float:
        """Frames per second."""

    @property
    def duration(self) -> float:
        """Seconds."""

    @property
    def timecode(self) -> str | None:
        """Hours, minutes, seconds and frames at the first frame."""

    @property
    def created(self) -> str | None:
        """Time of creation, ISO 8601."""


def split_name(stem: str) -> tuple[str, str, int]:
    """What stands before a camera's own name, the recording's number in it ("" without one) and the chapter."""
    for pattern in _NAMES:
        match = pattern.match(stem)
        if match:
            groups = match.groupdict()
            return groups["before"], groups["number"], int(groups.get("chapter") or 0)
    return stem, "", 0


def check_chapters(paths: Sequence[Path], facts: Sequence[ChapterFacts]) -> None:
    """Raise SplashbenchError, naming the files and the remedy, where a chapter does not follow the one before it."""
    for index, (before, after) in enumerate(pairwise(paths)):
        fault = _by_name(before, after) or _by_timecode(facts[index], facts[index + 1])
        if fault is None and not _are_named(before, after):  # a copy that names its chapter may be dated anyhow
            fault = _by_creation(facts[index], facts[index + 1])
        if fault is not None:
            raise SplashbenchError(f"{after} cannot follow {before.name}: {fault}; {_remedy(paths, facts)}")


def _are_named(*paths: Path) -> bool:
    """Whether all have a camera's own names, which tell recording and chapter."""
    return all(split_name(path.stem)[1] for path in paths)


def _by_name(before: Path, after: Path) -> str | None:
    if not _are_named(before, after):
        return None
    (_, first, earlier), (_, second, later) = split_name(before.stem), split_name(after.stem)
    if first != second:
        return f"it is of recording {second}, not {first}"
    if later <= earlier:
        return f"it is chapter {later}, the other {earlier}"
    if later > earlier + 1:
        missing = ", ".join(str(chapter) for chapter in range(earlier + 1, later))
        return f"chapter {missing} of recording {first} is missing between them"
    return None


def _by_timecode(before: ChapterFacts, after: ChapterFacts) -> str | None:
    first, second = _seconds(before.timecode, before.fps), _seconds(after.timecode, after.fps)
    if first is None or second is None or first == second:  # a converter gives all chapters the first one's
        return None
    gap = (second - first - before.duration + _DAY_S / 2) % _DAY_S - _DAY_S / 2  # over midnight
    if abs(gap) <= _SEAM_S + _SEAM_SHARE * before.duration:
        return None
    side = "after" if gap > 0 else "before"
    return f"its timecode {after.timecode} is {abs(gap):.1f} s {side} the other's end"


def _by_creation(before: ChapterFacts, after: ChapterFacts) -> str | None:
    first, second = _instant(before.created), _instant(after.created)
    if first is None or second is None or second >= first:
        return None
    return f"it was created {first - second:.0f} s before the other"


def _remedy(paths: Sequence[Path], facts: Sequence[ChapterFacts]) -> str:
    """The order that the files' own names, else their timecodes, else their creation suggest; or what to copy."""
    keys: list[list[float | None]] = [
        [float(chapter) if number else None for _, number, chapter in (split_name(path.stem) for path in paths)],
        [_seconds(fact.timecode, fact.fps) for fact in facts],
        [_instant(fact.created) for fact in facts],
    ]
    for values in keys:
        known = [value for value in values if value is not None]
        if len(known) == len(paths) and len(set(known)) == len(paths):
            ordered = [path for _, path in sorted(zip(known, paths))]
            if ordered != list(paths):
                return f"list them in order in session.toml: {', '.join(path.name for path in ordered)}"
    return "copy the chapters between them from the camera and list them in session.toml, or list one recording only"


def _seconds(timecode: str | None, fps: float) -> float | None:
    """Seconds of the day."""
    match = _TIMECODE.fullmatch(timecode.strip()) if timecode else None
    if match is None:
        return None
    hours, minutes, seconds, frames = (int(part) for part in match.groups())
    return 3600.0 * hours + 60.0 * minutes + seconds + frames / max(round(fps), 1)


def _instant(created: str | None) -> float | None:
    """Seconds since 1970; None where the camera's clock was never set."""
    if not created:
        return None
    try:
        seconds = datetime.fromisoformat(created).timestamp()
    except (ValueError, OverflowError):
        return None
    return seconds if seconds > 0 else None

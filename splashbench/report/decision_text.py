"""How the decisions of a fit are written: human units, a gain with its error, and a table of what was tried.

Decisions come from strangers' files. All text here is on one line, without control characters, and bounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import floor, log10

from splashbench.errors import one_line
from splashbench.score.notation import NO_FIGURE
from splashbench.submission import Decision, Rung

#: Basis of a decision -> what answered it, in words.
BASES = {
    "scene": "what the scene lets one see",
    "withheld": "withheld photographs",
    "tolerance": "a stated tolerance",
    "budget": "the user's budget",
}
#: Units by size, largest first. Bytes are decimal, as megabytes are elsewhere.
BYTE_UNITS = ((1e15, "PB"), (1e12, "TB"), (1e9, "GB"), (1e6, "MB"), (1e3, "kB"), (1.0, "B"))
SECOND_UNITS = ((3600.0, "h"), (60.0, "min"), (1.0, "s"))
# 999.6 kB would be rounded to 1000 kB.
_ROUNDS_UP = 0.9995


@dataclass(frozen=True)
class RungTable:
    """A decision's rungs as text.

    Attributes:
        header, rows: `value`, then the figures that any rung has.
        verdicts: per row "bought" or "refused", and the reason.
    """

    header: list[str]
    rows: list[list[str]]
    verdicts: list[str]


def shortened(text: str, length: int) -> str:
    """`text` on one line, without control characters, of at most `length` letters."""
    line = one_line(text)
    return line if len(line) <= length else line[: length - 1].rstrip() + "…"


def in_unit(value: float, units: Sequence[tuple[float, str]]) -> tuple[float, str]:
    """The largest of `units` (size, name) that is not above `value`, else the smallest."""
    return next((unit for unit in units if abs(value) >= _ROUNDS_UP * unit[0]), units[-1])


def bytes_text(value: float | None, *, sign: bool = False) -> str:
    """Bytes in three digits, as "1.21 MB"; a dash for None."""
    return _with_unit(value, BYTE_UNITS, sign)


def seconds_text(value: float | None, *, sign: bool = False) -> str:
    """Seconds in three digits, as "4.2 min"; a dash for None."""
    return _with_unit(value, SECOND_UNITS, sign)


def _with_unit(value: float | None, units: Sequence[tuple[float, str]], sign: bool) -> str:
    if value is None:
        return NO_FIGURE
    size, name = in_unit(value, units)
    return f"{value / size:{'+' if sign and value else ''}.3g} {name}"


def gain_text(gain: float | None, standard_error: float | None) -> str:
    """ "+0.31 ± 0.04", as many decimals as the error supports; a dash for a gain of None."""
    if gain is None:
        return NO_FIGURE
    if not standard_error:
        return f"{gain:+.3g}"
    if not 1e-6 < standard_error < 1e6:
        return f"{gain:+.3g} ± {standard_error:.2g}"
    decimals = max(0, 1 - floor(log10(standard_error)))
    return f"{gain:+.{decimals}f} ± {standard_error:.{decimals}f}"


def quality_text(value: float | None, largest: float) -> str:
    """A quality with the decimals that suit a column whose largest figure is `largest`; a dash for None."""
    if value is None:
        return NO_FIGURE
    decimals = 4 if largest < 1 else max(0, 3 - floor(log10(largest)))
    return f"{value:.{decimals}f}"


def chosen_rung(decision: Decision) -> int | None:
    """Index of the rung that was chosen: the one of that value, else the last that was bought; None without either."""
    named = [i for i, rung in enumerate(decision.rungs) if rung.value == decision.chosen]
    bought = [i for i, rung in enumerate(decision.rungs) if rung.bought]
    return (named or bought)[-1] if named or bought else None


def rung_table(decision: Decision, length: int = 120) -> RungTable:
    """The rungs in the order tried; columns without any figure are left out.

    Args:
        length: letters of a measure or a reason, at most.
    """
    rungs = decision.rungs
    largest = max((abs(rung.quality) for rung in rungs if rung.quality is not None), default=0.0)
    columns = [("value", [shortened(rung.value, 40) for rung in rungs])]
    if any(rung.quality is not None for rung in rungs):
        name = shortened(decision.measure, min(40, length)) or "quality"
        columns.append((name, [quality_text(rung.quality, largest) for rung in rungs]))
    if any(rung.gain is not None for rung in rungs):
        columns.append(("gain ± s.e.", [gain_text(rung.gain, rung.standard_error) for rung in rungs]))
    if any(rung.seconds is not None for rung in rungs):
        columns.append(("time", [seconds_text(rung.seconds, sign=True) for rung in rungs]))
    if any(rung.bytes is not None for rung in rungs):
        columns.append(("size", [bytes_text(rung.bytes, sign=True) for rung in rungs]))
    return RungTable(
        header=[name for name, _ in columns],
        rows=[list(cells) for cells in zip(*(cells for _, cells in columns))],
        verdicts=[_verdict(rung, length) for rung in rungs],
    )


def _verdict(rung: Rung, length: int) -> str:
    word = "bought" if rung.bought else "refused"
    reason = shortened(rung.reason, length)
    return f"{word}: {reason}" if reason else word

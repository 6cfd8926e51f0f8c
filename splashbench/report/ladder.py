"""Where the rungs of a decision stand in its chart: cost across, quality up. decision_chart.py draws them.

A rung states what it costs and gains over the rung held before it. So both add up along the rungs that were bought.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from splashbench.report.decision_text import BYTE_UNITS, SECOND_UNITS, in_unit, shortened
from splashbench.submission import Decision, Rung

_NUMBER = re.compile(r"\s*([-+]?\d{1,15}(?:\.\d{1,15})?(?:e[-+]?\d{1,2})?)\s*([^\d\s(),;:=]*)", re.IGNORECASE)

_Cost = Literal["bytes", "seconds"]


@dataclass(frozen=True)
class Ladder:
    """A decision with figures.

    Attributes:
        x: per rung the cost added up in the unit of `x_label`, or its place in the order.
        y: per rung its quality, or the gain added up; None for what has neither.
        errors: per rung the standard error of its gain, 0 where none is stated.
        names: per rung its value, without what all values end in, such as " iterations".
        before: per rung the one that was held when it was tried; None for the first.
        ordered: whether x is the place in the order alone.
    """

    x: list[float]
    y: list[float | None]
    errors: list[float]
    names: list[str]
    before: list[int | None]
    x_label: str
    y_label: str
    ordered: bool


@dataclass(frozen=True)
class Scale:
    """A decision without quality: a length per rung, in the unit of `label`."""

    lengths: list[float]
    label: str


def ladder(decision: Decision) -> Ladder | None:
    """The rungs of `decision` as points; None where none has a quality or a gain."""
    rungs = decision.rungs
    by_quality = any(rung.quality is not None for rung in rungs)
    if not by_quality and all(rung.gain is None for rung in rungs):
        return None
    before = _held_before(rungs)
    gains: list[float | None] = list(_added_up([rung.gain for rung in rungs], before))
    if not by_quality:
        # The first rung is what the others are compared with; a later one without a gain is not known.
        gains = [gain if i == 0 or rung.gain is not None else None for i, (rung, gain) in enumerate(zip(rungs, gains))]
    measure = shortened(decision.measure, 40)
    costs = _costs(rungs, before)
    places, label = costs or ([float(i) for i in range(len(rungs))], "in the order tried")
    return Ladder(
        x=places,
        y=[rung.quality for rung in rungs] if by_quality else gains,
        errors=[rung.standard_error or 0.0 for rung in rungs],
        names=_names(rungs),
        before=before,
        x_label=label,
        y_label=(measure or "quality") if by_quality else f"gain added up{f', {measure}' if measure else ''}",
        ordered=costs is None,
    )


def scale(decision: Decision) -> Scale | None:
    """The rungs of `decision` as lengths: of their costs, else of the numbers their values begin with.

    None where there is neither, or where the values have different units.
    """
    rungs = decision.rungs
    costs = _costs(rungs, _held_before(rungs))
    if costs is not None:
        return Scale(*costs)
    found = [_NUMBER.match(rung.value) for rung in rungs]
    numbers = [match for match in found if match is not None]
    units = {match[2] for match in numbers}
    if not rungs or len(numbers) < len(rungs) or len(units) > 1:
        return None
    return Scale([float(match[1]) for match in numbers], units.pop())


def _names(rungs: list[Rung]) -> list[str]:
    parts = [rung.value.partition(" ") for rung in rungs]
    shared = len({end for _, _, end in parts}) == 1 and len({start for start, _, _ in parts}) == len(parts) > 1
    return [start if shared else rung.value for rung, (start, _, _) in zip(rungs, parts)]


def _held_before(rungs: list[Rung]) -> list[int | None]:
    held: int | None = None
    before = []
    for i, rung in enumerate(rungs):
        before.append(held)
        if rung.bought:
            held = i
    return before


def _added_up(steps: list[float | None], before: list[int | None]) -> list[float]:
    levels: list[float] = []
    for step, held in zip(steps, before):
        levels.append((step or 0.0) + (0.0 if held is None else levels[held]))
    return levels


def _costs(rungs: list[Rung], before: list[int | None]) -> tuple[list[float], str] | None:
    """Bytes or seconds of each rung, added up, and their label; None where rungs after the first lack both."""
    names: tuple[_Cost, _Cost] = ("bytes", "seconds")
    for name in names:
        steps = [getattr(rung, name) for rung in rungs]
        levels = _added_up(steps, before)
        if any(step is None for step in steps[1:]) or not levels or min(levels) == max(levels):
            continue
        saves = max(levels) <= 0
        size, unit = in_unit(max(map(abs, levels)), BYTE_UNITS if name == "bytes" else SECOND_UNITS)
        label = f"{'saving' if saves else 'cost'}, added up ({unit})"
        return [(-level if saves else level) / size for level in levels], label
    return None

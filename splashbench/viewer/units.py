"""Lengths, speeds and times in words: in scene units, and in metres where their size is known."""

from __future__ import annotations

import math


def round_down(number: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above `number`, which is above 0."""
    power = 10.0 ** math.floor(math.log10(number))
    return max(step for step in (1, 2, 5) if step * power <= number * (1 + 1e-9)) * power


def length_text(length: float, metres_per_unit: float | None) -> str:
    """`length` in scene units, such as "0.1 units = 5 cm"."""
    text = f"{length:.3g} unit{'' if length == 1 else 's'}"
    if metres_per_unit is None:
        return text
    metres = length * metres_per_unit
    for factor, unit in ((1, "m"), (100, "cm"), (1000, "mm")):
        if metres * factor >= 1:
            return f"{text} = {metres * factor:.3g} {unit}"
    return f"{text} = {metres * 1000:.3g} mm"


def measure_text(measure: str, value: float, metres_per_unit: float | None) -> str:
    """A `value` of "speed" (scene units per second), "age" (seconds) or "height" (scene units), with its unit."""
    if measure == "age":
        return f"{value:.2g} s"
    scaled, unit = (value, "units") if metres_per_unit is None else (value * metres_per_unit, "m")
    return f"{scaled:.2g} {unit}{'/s' if measure == 'speed' else ''}"

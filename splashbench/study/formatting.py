"""How a study's figures are written for people: labels, decimals, and bytes as megabytes."""

from __future__ import annotations

from splashbench.study.spec import metric_of

NONE = "–"
_UNITS = {
    "storage_bytes": ("MB", 1e6, 2),
    "dynamic_bytes": ("MB", 1e6, 2),
    "peak_memory_bytes": ("MiB", 2.0**20, 0),
    "peak_device_memory_bytes": ("MiB", 2.0**20, 0),
}


def scaled(name: str, value: float) -> float:
    """`value` of metric `name` in the unit it is shown in."""
    return value / _UNITS[name][1] if name in _UNITS else value


def label(name: str, arrow: bool = True) -> str:
    """Title, unit and, with `arrow`, the direction of better."""
    metric = metric_of(name)
    unit = _UNITS[name][0] if name in _UNITS else metric.unit
    mark = {"higher": " ↑", "lower": " ↓", None: ""}[metric.better] if arrow else ""
    return f"{metric.title}{f' ({unit})' if unit else ''}{mark}"


def number(name: str, value: float | None, sign: bool = False) -> str:
    """`value` of metric `name` with its decimals; a dash for None."""
    if value is None:
        return NONE
    decimals = _UNITS[name][2] if name in _UNITS else metric_of(name).decimals
    text = f"{scaled(name, value):{'+' if sign else ''}.{decimals}f}"
    return text if any(digit in "123456789" for digit in text) else text.lstrip("+-")


def with_spread(name: str, value: float | None, spread: float | None, sign: bool = False) -> str:
    """ "20.13 ± 0.05", without the second part where there is one seed."""
    text = number(name, value, sign)
    return text if value is None or spread is None else f"{text} ± {number(name, spread)}"

"""How a metric's figure is written: its label, unit and decimals, and the mark of the liquid filter.

Results and CSV hold stored units, such as bytes. People read shown units, such as megabytes.
"""

from __future__ import annotations

import math

from splashbench.score.metrics import METRICS, Metric

#: Stands for a figure that is missing.
NO_FIGURE = "–"
#: Metric -> shown unit, its size in stored units, decimals; all others are shown as they are stored.
_SHOWN_UNITS = {
    "storage_bytes": ("MB", 1e6, 2),
    "dynamic_bytes": ("MB", 1e6, 2),
    "peak_memory_bytes": ("MiB", 2.0**20, 0),
    "peak_device_memory_bytes": ("MiB", 2.0**20, 0),
}
#: Stands behind figures of mixed methods that rest on the filter, or behind the methods' names in a chart's legend.
FILTER_MARK = "†"
FILTER_NOTE = (
    f"{FILTER_MARK} One set of primitives is background and liquid. The figure is of those alone that lie inside the "
    "silhouettes of all training views: a filter, no part of the method. It loses liquid that only some views see."
)


def filter_mark(metric: Metric, mixed: bool, value: float | None) -> str:
    """What stands behind `value` of `metric`; mixed: whether the method is."""
    return FILTER_MARK if mixed and metric.filtered and not _is_missing(value) else ""


def label(metric: Metric, arrow: bool = True) -> str:
    """Title, shown unit and, with `arrow`, the direction of better."""
    unit = _SHOWN_UNITS[metric.name][0] if metric.name in _SHOWN_UNITS else metric.unit
    direction = {"higher": " ↑", "lower": " ↓", None: ""}[metric.better] if arrow else ""
    return f"{metric.title}{f' ({unit})' if unit else ''}{direction}"


def in_shown_unit(metric: Metric, value: float) -> float:
    """A stored `value` in the unit that people read."""
    return value / _SHOWN_UNITS[metric.name][1] if metric.name in _SHOWN_UNITS else value


def shown(metric: Metric, value: float | None, *, sign: bool = False) -> str:
    """A stored `value` in the shown unit with its decimals; a dash for None and NaN. Zero never has a sign."""
    if value is None or math.isnan(value):
        return NO_FIGURE
    decimals = _SHOWN_UNITS[metric.name][2] if metric.name in _SHOWN_UNITS else metric.decimals
    text = f"{in_shown_unit(metric, value):{'+' if sign else ''}.{decimals}f}"
    return text if any(digit in "123456789" for digit in text) else text.lstrip("+-")


def shown_with_spread(metric: Metric, value: float | None, spread: float | None, *, sign: bool = False) -> str:
    """ "20.13 ± 0.05"; the value alone where there is no spread."""
    text = shown(metric, value, sign=sign)
    return text if _is_missing(value) or _is_missing(spread) else f"{text} ± {shown(metric, spread)}"


def stored(name: str, value: float | None, missing: str = "") -> str:
    """`value` of metric `name` in stored units with the registry's decimals; `missing` for None and NaN."""
    return missing if value is None or math.isnan(value) else f"{value:.{METRICS[name].decimals}f}"


def _is_missing(value: float | None) -> bool:
    return value is None or math.isnan(value)

"""A gate: a figure beside its limit, and what a failure does.

An essential gate that fails stops `prepare`; any other is a warning in the report. `gates` has the figures.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from splashbench.errors import SplashbenchError


@dataclass(frozen=True)
class Gate:
    """One figure and its limit. `value` is None where the figure could not be had, which fails."""

    name: str
    value: float | None
    limit: float
    side: Literal["at most", "at least"]
    detail: str
    essential: bool = False
    remedy: str = "film it again"

    @property
    def finite(self) -> float | None:
        """The value, None where there is none or it has no bound."""
        return float(self.value) if self.value is not None and np.isfinite(self.value) else None

    @property
    def figure(self) -> str:
        """The value as people read it."""
        return "unknown" if self.finite is None else f"{self.finite:.4g}"

    @property
    def outcome(self) -> str:
        """The figure beside its limit, and what it is."""
        return f"{self.name} is {self.figure}, {self.side} {self.limit:.4g} is needed ({self.detail})"

    @property
    def passed(self) -> bool:
        """Whether the value is on the right side of the limit."""
        if self.finite is None:
            return False
        return self.finite <= self.limit if self.side == "at most" else self.finite >= self.limit

    def as_json(self) -> dict[str, Any]:
        """The gate as it stands in prepare_report.json."""
        return {
            "name": self.name,
            "value": self.finite,
            "limit": self.limit,
            "side": self.side,
            "passed": self.passed,
            "essential": self.essential,
            "detail": self.detail,
            "remedy": self.remedy,
        }


def require(gates: Collection[Gate], source: str) -> None:
    """Raise SplashbenchError where an essential gate failed; it tells of all gates that failed, with their remedies.

    Whoever has to film again wants to do it once.
    """
    told = failures(gates)
    if any(gate.essential and not gate.passed for gate in gates):
        raise SplashbenchError(f"{source}: {told}")


@contextmanager
def told_with(gates: Iterable[Gate]) -> Iterator[None]:
    """Where a stage within raises SplashbenchError, add the gates that have failed so far: they may be its reason."""
    try:
        yield
    except SplashbenchError as error:
        told = failures(gates)
        raise SplashbenchError(f"{error}. Besides: {told}" if told else str(error)) from error


def failures(gates: Iterable[Gate]) -> str:
    """One line of all gates that failed, those that stop a preparation first; empty where none did."""
    failed = sorted((gate for gate in gates if not gate.passed), key=lambda gate: not gate.essential)
    lines: list[str] = []
    told: set[str] = set()
    for gate in failed:
        # A figure with two limits has one remedy.
        lines.append(f"{gate.outcome}; {'likewise' if gate.remedy in told else gate.remedy.rstrip('.')}")
        told.add(gate.remedy)
    return ". ".join(lines)

"""What a check finds: a verdict, what it is about, and what to do."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any


class Verdict(str, Enum):
    """`warning`: allowed, and worth a look. `not_tested`: something that failed before makes it impossible to tell."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"
    NOT_TESTED = "not_tested"


#: A verdict, and what was found.
Found = tuple[Verdict, str]
_SHOWN = 3


def found(faults: list[str], ok: str = "", wrong: Verdict = Verdict.FAILED) -> Found:
    """`wrong` with the first of `faults`, or, where there is none, ok with the text `ok`."""
    if not faults:
        return Verdict.OK, ok
    more = f" (and {len(faults) - _SHOWN} more)" if len(faults) > _SHOWN else ""
    return wrong, "; ".join(faults[:_SHOWN]) + more


class NotTested(Exception):
    """A check cannot be made; the text says why."""


@dataclass(frozen=True)
class Finding:
    """One check's line.

    Attributes:
        about: what the check asks for. detail: what was found. remedy: what to do where it is not ok.
    """

    name: str
    verdict: Verdict
    about: str
    detail: str
    remedy: str

    def as_json(self) -> dict[str, Any]:
        """For `--json`; the remedy only where there is something to remedy."""
        told = self.verdict in (Verdict.FAILED, Verdict.WARNING)
        return {
            "name": self.name,
            "verdict": self.verdict.value,
            "about": self.about,
            "detail": self.detail,
            "remedy": self.remedy if told else "",
        }

"""What a conformance test is made of and reports: checks, and a finding for each with a verdict and a remedy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

_MAX_FAULTS = 3


class Verdict(str, Enum):
    """`warning`: allowed, and worth a look. `not_tested`: an earlier failure makes it impossible to tell."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"
    NOT_TESTED = "not_tested"


#: A verdict, and the detail that it rests on.
Judgement = tuple[Verdict, str]


def judge(faults: list[str], detail: str = "", verdict: Verdict = Verdict.FAILED) -> Judgement:
    """`verdict` with the first of `faults`; where there is none, ok with `detail`."""
    if not faults:
        return Verdict.OK, detail
    more = f" (and {len(faults) - _MAX_FAULTS} more)" if len(faults) > _MAX_FAULTS else ""
    return verdict, "; ".join(faults[:_MAX_FAULTS]) + more


class NotTested(Exception):
    """A check cannot be made; the text says why."""


@dataclass(frozen=True)
class Check:
    """One line of the test: its name, what it asks for, what to do where it fails, and how the evidence is judged."""

    name: str
    about: str
    remedy: str
    judgement: Callable[[Any], Judgement]

    def finding(self, evidence: Any) -> Finding:
        """What the check finds in `evidence`."""
        try:
            verdict, detail = self.judgement(evidence)
        except NotTested as reason:
            verdict, detail = Verdict.NOT_TESTED, str(reason)
        return Finding(self.name, verdict, self.about, detail, self.remedy)


def check(about: str, remedy: str) -> Callable[[Callable[[Any], Judgement]], Check]:
    """Make a function that judges the evidence a `Check` of its name."""
    return lambda judgement: Check(judgement.__name__, about, remedy, judgement)


@dataclass(frozen=True)
class Finding:
    """One check's line.

    Attributes:
        about: what the check asks for. detail: what was seen. remedy: what to do where it is not ok.
    """

    name: str
    verdict: Verdict
    about: str
    detail: str
    remedy: str

    def as_json(self) -> dict[str, Any]:
        """For `--json`; the remedy only where there is something to remedy."""
        needs_remedy = self.verdict in (Verdict.FAILED, Verdict.WARNING)
        return vars(self) | {"verdict": self.verdict.value, "remedy": self.remedy if needs_remedy else ""}


@dataclass
class Report:
    """All findings of a conformance test.

    Attributes:
        method, preset, settings: what was tested. scene: "balls", the built-in one, or the folder given.
        findings: one per check, in order. fit_seconds: of the ordinary run, None where there was none or it failed.
        seconds: of the whole test.
    """

    method: str
    preset: str
    settings: dict[str, Any]
    scene: str
    findings: list[Finding] = field(default_factory=list)
    fit_seconds: float | None = None
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether nothing failed, and nothing was left out because something failed."""
        return all(finding.verdict in (Verdict.OK, Verdict.WARNING) for finding in self.findings)

    def as_json(self) -> dict[str, Any]:
        """For `--json`."""
        return {
            "method": self.method,
            "preset": self.preset,
            "settings": self.settings,
            "scene": self.scene,
            "passed": self.passed,
            "fit_seconds": self.fit_seconds,
            "seconds": self.seconds,
            "checks": [finding.as_json() for finding in self.findings],
        }

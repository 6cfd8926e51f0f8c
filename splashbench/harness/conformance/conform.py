"""The conformance test of a method: every check in order, a finding for each."""

from __future__ import annotations

import difflib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splashbench.errors import SplashbenchError
from splashbench.harness.conformance.checks import CHECKS, Check
from splashbench.harness.conformance.findings import Finding, NotTested, Verdict
from splashbench.harness.conformance.trial import Trial, trial

__all__ = ["TIMEOUT_SECONDS", "Finding", "Report", "Verdict", "conform"]

#: Default limit of each single step.
TIMEOUT_SECONDS = 600.0
# What follows the first run: fits, those that are stopped half way and those of small scenes counted as parts; and
# starts of processes, which are what a run spends besides its fit.
_FITS, _STARTS = 4.0, 6.0
#: From here on it is worth telling how long it will take.
_LONG_SECONDS = 30.0


@dataclass
class Report:
    """What a conformance test found.

    Attributes:
        method, preset, settings: what was tested. scene: "balls", the built-in one, or the folder given.
        findings: one per check, in order. fit_seconds: of the ordinary run, None where it was not asked for or failed.
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


def conform(
    name: str,
    *,
    scene: Path | None = None,
    preset: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    device: str = "cpu",
    timeout_seconds: float = TIMEOUT_SECONDS,
    only: Sequence[str] | None = None,
    tell: Callable[[Finding], None] | None = None,
    estimate: Callable[[float, float], None] | None = None,
) -> Report:
    """Test whether method `name` (registered, or FILE.py:CLASS) keeps the contract.

    Args:
        scene: a scene to test on, copied before; the small made-up scene of balls when None.
        preset: `quick` where the method has it, else its default, when None.
        overrides: single settings on top of the preset.
        timeout_seconds: limit of each single step.
        only: names of the checks to make; all when None.
        tell: hears each finding as soon as it is there.
        estimate: hears, once, the seconds of a fit and of what is still to come, where that is long.

    Raises SplashbenchError where there is no such method, preset, setting or scene.
    """
    checks = _chosen(only)
    start = time.monotonic()
    with trial(
        name,
        scene=scene,
        preset=preset,
        overrides=overrides or {},
        device=device,
        timeout_seconds=timeout_seconds,
    ) as evidence:
        report = Report(
            evidence.method.id,
            evidence.preset,
            evidence.config.model_dump(mode="json", fallback=str),
            str(scene) if scene else "balls",
        )
        for check in checks:
            finding = _find(check, evidence)
            report.findings.append(finding)
            if tell:
                tell(finding)
            ran = evidence.known()
            if ran is not None and report.fit_seconds is None:
                report.fit_seconds = ran.fit_seconds
                rest = _FITS * ran.fit_seconds + _STARTS * (ran.seconds - ran.fit_seconds)
                if estimate and only is None and rest > _LONG_SECONDS:
                    estimate(ran.fit_seconds, rest)
    report.seconds = time.monotonic() - start
    return report


def _find(check: Check, evidence: Trial) -> Finding:
    try:
        verdict, detail = check.look(evidence)
    except NotTested as reason:
        verdict, detail = Verdict.NOT_TESTED, str(reason)
    return Finding(check.name, verdict, check.about, detail, check.remedy)


def _chosen(only: Sequence[str] | None) -> list[Check]:
    if only is None:
        return list(CHECKS)
    names = [check.name for check in CHECKS]
    for name in only:
        if name not in names:
            near = difflib.get_close_matches(name, names, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(names)}"
            raise SplashbenchError(f"there is no check {name!r}; {hint}")
    return [check for check in CHECKS if check.name in only]

"""The conformance test: every check, in the order in which a method's author can fix what they find."""

from __future__ import annotations

import difflib
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from splashbench.errors import SplashbenchError
from splashbench.harness.conformance import costs, model, scene_access, stopping
from splashbench.harness.conformance.evidence import Evidence
from splashbench.harness.conformance.report import Check, Finding, Report

#: Default limit of each single step.
TIMEOUT_SECONDS = 600.0
# What follows the first run, counted in fits (those stopped half way and those of small scenes are parts of one) and
# in starts of processes (what a run spends besides its fit).
_FITS, _STARTS = 5.0, 10.0
# And those of a run with a budget, where the method takes any.
_BUDGETED_FITS, _BUDGETED_STARTS = 1.0, 1.0
#: From here on it is worth telling how long it will take.
_LONG_SECONDS = 30.0
CHECKS: tuple[Check, ...] = (
    *(model.metadata, model.fit, model.progress, model.files, model.load, model.again),
    *(model.views, model.between, model.size, model.principal_point, model.particles, model.signed_distance),
    *(
        scene_access.same_seed,
        scene_access.checkpoints,
        costs.budgets,
        scene_access.other_seed,
        scene_access.hidden_test_views,
        scene_access.unread_test_views,
    ),
    *(scene_access.unchanged_scene, scene_access.writes),
    *(stopping.time_limit, stopping.signals, stopping.processes),
    *(model.one_frame, model.no_liquid),
)


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
        scene: a scene to test on, copied before; the small synthetic scene of balls when None.
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
    with tempfile.TemporaryDirectory(prefix="splashbench-conformance-") as work:
        evidence = Evidence(Path(work).resolve(), name, scene, preset, overrides or {}, device, timeout_seconds)
        report = Report(
            evidence.method.id,
            evidence.preset,
            evidence.config.model_dump(mode="json", fallback=str),
            str(scene) if scene else "balls",
        )
        for check in checks:
            finding = check.finding(evidence)
            report.findings.append(finding)
            if tell:
                tell(finding)
            run = evidence.good_run()
            if run is not None and report.fit_seconds is None:
                report.fit_seconds = run.fit_seconds
                budgeted = bool(evidence.method.budgets)
                fits, starts = _FITS + budgeted * _BUDGETED_FITS, _STARTS + budgeted * _BUDGETED_STARTS
                rest = fits * run.fit_seconds + starts * (run.seconds - run.fit_seconds)
                if estimate and only is None and rest > _LONG_SECONDS:
                    estimate(run.fit_seconds, rest)
    report.seconds = time.monotonic() - start
    return report


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

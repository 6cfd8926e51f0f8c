"""`splashbench methods test METHOD`: test whether a method keeps the contract."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from splashbench.cli.arguments import add_device, add_method, add_settings, add_timeout
from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say

if TYPE_CHECKING:
    from splashbench.harness.conformance import Finding

_EPILOG = """\
examples:
  splashbench methods test my_method.py:MyMethod
  splashbench methods test splashsplat --set iterations=50 --set background_preset=quick
  splashbench methods test my_method.py:MyMethod --only load same_seed
  splashbench methods test my_method.py:MyMethod --scene scenes/bowl_001 --preset best

Makes a small scene, fits it about six times, and prints a line for each check: ok; warning (allowed, worth a look);
FAILED with a remedy; not tested, where an earlier fault hides the answer. docs/conformance.md explains the checks.
The test finds mistakes, not malice. A method is a program with your rights: run a stranger's in a container.
"""


def register(actions: argparse._SubParsersAction) -> None:
    """Add the action to those of `splashbench methods`."""
    parser = add_command(
        actions,
        "test",
        run,
        summary="test whether a method keeps the contract",
        description="Test whether METHOD keeps the contract of CONTRIBUTING.md. Exit status 1 where a check fails.",
        epilog=_EPILOG,
    )
    add_method(parser)
    parser.add_argument("--scene", type=Path, help="test on a copy of this scene (default: a small synthetic one)")
    parser.add_argument("--preset", help="default: `quick` where the method has it, else its first one")
    add_settings(parser, "a single setting on top of the preset; may be given several times")
    add_device(parser)
    parser.add_argument("--only", nargs="+", action="extend", metavar="CHECK", help="run these checks alone")
    add_timeout(parser, "limit of each single step (default: 600)")


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench methods test`."""
    from splashbench.harness.conformance import TIMEOUT_SECONDS, conform
    from splashbench.harness.runner import parse_overrides

    report = conform(
        arguments.method,
        scene=arguments.scene,
        preset=arguments.preset,
        overrides=parse_overrides(arguments.overrides),
        device=arguments.device,
        timeout_seconds=arguments.timeout or TIMEOUT_SECONDS,
        only=arguments.only,
        tell=_tell,
        estimate=_estimate,
    )
    if arguments.json:
        emit(report.as_json())
    if report.passed:
        say(f"{report.method}: keeps the contract, preset {report.preset}; {report.seconds:.0f} s")
        return 0
    count = sum(finding.verdict.value == "failed" for finding in report.findings)
    say(f"error: {report.method}: {count} of {len(report.findings)} checks failed; fix the first one first")
    return 1


def _tell(finding: Finding) -> None:
    from splashbench.errors import one_line

    shown = {"ok": "ok", "warning": "warning", "failed": "FAILED", "not_tested": "not tested"}[finding.verdict.value]
    text, detail = finding.about, one_line(finding.detail)
    if finding.verdict.value in ("failed", "warning"):
        text += f": {detail}. Remedy: {finding.remedy}"
    elif detail:
        text += f" ({detail})"
    say(f"{shown:<10}  {finding.name:<17}  {text}")


def _estimate(fit_seconds: float, rest_seconds: float) -> None:
    amount = f"{rest_seconds / 60:.0f} minutes" if rest_seconds > 90 else f"{rest_seconds:.0f} s"
    say(f"A fit takes {fit_seconds:.0f} s here: about {amount} for the rest. --set makes it smaller, --only shorter.")

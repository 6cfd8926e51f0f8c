"""`splashbench score --verify RESULT...`: score the submissions of results again, and say what they state otherwise."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splashbench.cli.output import emit, say

if TYPE_CHECKING:
    from splashbench.score.verification import Verification


def verify_results(arguments: argparse.Namespace) -> int:
    """Verify each of `arguments.submissions`, which are results here; exit status 1 unless all are confirmed."""
    from splashbench.report.results import shown_differences
    from splashbench.score import Result
    from splashbench.score.verification import Evidence

    results = [(path, Result.load(path)) for path in arguments.submissions]
    look_in = [*arguments.look_in, *([arguments.reference] if arguments.reference else [])]
    evidence = Evidence(look_in, [arguments.scene], arguments.lpips_weights)
    found = []
    for path, result in results:
        say(f"scoring again: {path}: {result.method} on {result.scene}, seed {result.seed}")
        verification = evidence.verify(result, path.parent)
        found.append((path, verification))
        words = shown_differences(verification.differences) or verification.reason
        say(f"{path}: {verification.verdict}{f': {words}' if words else ''}")
        if verification.unchecked:
            say(f"{path}: not recomputed, for want of weights or of the reference: {', '.join(verification.unchecked)}")
    if arguments.json:
        emit({"results": [verification_facts(path, verification) for path, verification in found]})
    bad = sum(verification.verdict != "confirmed" for _, verification in found)
    if bad:
        say(f"error: {bad} of {len(found)} results are not confirmed; score these submissions again, or leave them out")
    return 1 if bad else 0


def verification_facts(path: Path | str, verification: Verification) -> dict[str, Any]:
    """What became of the result in the file `path`, for JSON."""
    return {
        "file": str(path),
        "verdict": verification.verdict,
        "reason": verification.reason,
        "differences": [asdict(different) for different in verification.differences],
        "unchecked": list(verification.unchecked),
    }

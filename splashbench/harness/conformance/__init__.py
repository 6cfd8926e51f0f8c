"""Does a method keep the contract? Its conformance test, `splashbench methods test` (docs/conformance.md).

`suite` has the checks in order. They are in `model`, `scene_access` and `stopping`, and look at the runs of `evidence`.
"""

from splashbench.harness.conformance.report import Finding, Report, Verdict
from splashbench.harness.conformance.suite import TIMEOUT_SECONDS, conform

__all__ = ["TIMEOUT_SECONDS", "Finding", "Report", "Verdict", "conform"]

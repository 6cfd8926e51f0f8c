"""Does a method keep the contract? Its conformance test, `splashbench methods test` (docs/conformance.md)."""

from splashbench.harness.conformance.conform import Finding, Report, Verdict, conform

__all__ = ["Finding", "Report", "Verdict", "conform"]

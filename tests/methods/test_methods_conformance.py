"""Every method of this project keeps the contract, by the test that strangers are given."""

from pathlib import Path

import pytest

from splashbench import toml
from splashbench.harness.conformance import Report, conform
from splashbench.harness.discovery import registered

SETTINGS = toml.load(Path(__file__).with_name("small_fits.toml"))


def faults(report: Report) -> dict[str, str]:
    """Whatever is not ok, warnings as well."""
    return {finding.name: finding.detail for finding in report.findings if finding.verdict.value != "ok"}


def test_no_method_of_this_project_is_left_out() -> None:
    ours = {name for name, point in registered().items() if point.value.startswith("splashbench_methods.")}
    assert ours == set(SETTINGS)


def test_hull_points_keeps_the_contract() -> None:
    assert faults(conform("hull_points")) == {}


# A dozen starts of PyTorch for each, three of them to be stopped, are for `make test-all`.
@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(SETTINGS) - {"hull_points"}))
def test_every_method_keeps_all_of_the_contract(name: str) -> None:
    assert faults(conform(name, overrides=SETTINGS[name])) == {}

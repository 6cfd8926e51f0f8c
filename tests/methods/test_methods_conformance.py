"""Every method of this project keeps the contract, by the test that strangers are given."""

import pytest

from splashbench.adapter.discovery import registered
from splashbench.conformance import Report, conform

_SPARSE = {"iterations": 20, "static_points": 300}
#: Small enough for a test; on top of preset quick.
SETTINGS: dict[str, dict[str, object]] = {
    "hull_points": {},
    "nearest_camera": {},
    "nothing": {"iterations": 20, "anchors": 300},
    "scaffold_gs": {"iterations": 20, "anchors": 300},
    "splashsplat": {"hull_cells": 48, "transport_cells": 32, "control_cells": 8, "iterations": 20},
    "deformable_3dgs": {
        "iterations": 20,
        "static_points": 300,
        "hull_points": 200,
        "most": 700,
        "width": 16,
        "depth": 4,
    },
    "scaffold_4d": {**_SPARSE, "hull_points": 400, "most": 1500},
    "spacetime_gaussians": {**_SPARSE, "hull_points": 400, "most": 1500},
    "spacetime_gaussians_lite": {**_SPARSE, "hull_points": 400, "most": 1500},
}


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

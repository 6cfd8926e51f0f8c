"""The report's tables: units, what is unknown, and what to do about every gate that failed."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from splashbench.pages.blocks import Bullets, Table
from splashbench.prepare.gate import Gate
from splashbench.prepare.report.gates import gates_section
from splashbench.prepare.report.page import recorded_on


def preparation(*gates: Gate) -> SimpleNamespace:
    return SimpleNamespace(gates=list(gates), warnings=[gate for gate in gates if not gate.passed])


def test_gates_have_units_and_remedies() -> None:
    shift = Gate("camera_shift", 0.03, 0.5, "at most", "px that moved", True, "film it again with camera 2")
    sigma = Gate("centre_sigma", 0.02, 0.005, "at most", "m, camera 3", False, "film the board again with camera 3")
    empty = Gate("masks_empty", None, 0.2, "at most", "share", False, "set motion_interval")
    undetermined = Gate("focal_sigma", float("inf"), 0.005, "at most", "share", False, "tilt the board")
    table, _, remedies = gates_section(preparation(shift, sigma, empty, undetermined))  # type: ignore[arg-type]
    assert isinstance(table, Table)
    assert isinstance(remedies, Bullets)
    assert [row[1] for row in table.rows] == ["0.03 px", "0.02 m", "unknown", "unknown"]
    assert [row[2] for row in table.rows] == ["at most 0.5 px", "at most 0.005 m", "at most 0.2", "at most 0.005"]
    assert [row[4] for row in table.rows] == ["stops", "warns", "warns", "warns"]
    assert remedies.lines == [
        "centre sigma: film the board again with camera 3",
        "masks empty: set motion_interval",
        "focal sigma: tilt the board",
    ]
    assert len(gates_section(preparation(shift))) == 1  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("created", "day"),
    [("2024-05-04T10:00:00.000000Z", "2024-05-04"), (None, "on a day that its files do not tell")],
)
def test_the_date_is_that_of_the_recordings(created: str | None, day: str) -> None:
    """The page's bytes do not depend on when it was made."""
    videos = {"1": SimpleNamespace(created=created)}
    told = recorded_on(
        SimpleNamespace(session=SimpleNamespace(reference="1"), synced=SimpleNamespace(videos=videos))  # type: ignore[arg-type]
    )
    assert told == day

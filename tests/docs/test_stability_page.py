"""docs/results/stability.md: its tables are what data/stability_runs.csv says."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
import pytest

RESULTS = Path(__file__).parents[2] / "docs" / "results"
PAGE = (RESULTS / "stability.md").read_text(encoding="utf-8")
RUNS = pd.read_csv(RESULTS / "data" / "stability_runs.csv")
BEFORE = "splashsplat without self-calibration"


def rows(header: str) -> list[list[str]]:
    """The cells of the table whose first line begins with `header`."""
    table = PAGE[PAGE.index(header) :].split("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table]


def test_what_methods_keep_is_what_was_run() -> None:
    kept = RUNS[RUNS.severity == 3].set_index(["method", "kind", "metric"]).retention
    table = rows("| severity 3: kept of mIoU / of PSNR")
    assert {cells[0].strip("`") for cells in table} == set(RUNS.kind)
    for kind, _, *cells in table:
        for method, cell in zip(("splashsplat", "spacetime_gaussians", "hull_points"), cells, strict=True):
            if cell == "–":
                assert (method, kind.strip("`"), "miou") not in kept.index
                continue
            for metric, figure in zip(("miou", "psnr"), cell.split("/"), strict=True):
                assert float(figure) == pytest.approx(kept[method, kind.strip("`"), metric], abs=0.0051)


def test_what_self_calibration_gains_is_what_was_run() -> None:
    values = RUNS.set_index(["method", "kind", "amount", "metric"]).value
    table = rows("| harm to all cameras")
    assert len(table) >= 10
    for kind, amount, *cells in table:
        size = float(re.match(r"[\d.]+", amount)[0])  # type: ignore[index]
        for method, cell in zip((BEFORE, "splashsplat"), cells, strict=True):
            for metric, figure in zip(("psnr", "miou"), cell.split("/"), strict=True):
                assert float(figure) == pytest.approx(values[method, kind.strip("`"), size, metric], abs=0.0051)


def test_the_means_are_those_of_the_runs() -> None:
    two = r"(\.\d+) and (\.\d+)"
    said = re.search(
        rf"keeps (\.\d+) of mIoU and (\.\d+) of PSNR, spacetime_gaussians {two}, hull_points {two}",
        " ".join(PAGE.split()),
    )
    assert said is not None
    means = RUNS[RUNS.severity == 3].groupby(["method", "metric"]).retention.mean()
    names = [(m, k) for m in ("splashsplat", "spacetime_gaussians", "hull_points") for k in ("miou", "psnr")]
    assert [float(figure) for figure in said.groups()] == pytest.approx([means[name] for name in names], abs=0.0051)

"""docs/results/stability.md: its tables are what data/stability_runs.csv says."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
import pytest

from splashbench.study.stability import StressRun, stability

RESULTS = Path(__file__).parents[2] / "docs" / "results"
PAGE = (RESULTS / "stability.md").read_text(encoding="utf-8")
EVERY = pd.read_csv(RESULTS / "data" / "stability_runs.csv")
BOWL, TANK = "synthetic_opaque_bowl", "synthetic_glass_tank"
RUNS = EVERY[EVERY.scene == BOWL]
BEFORE = "splashsplat without self-calibration"


def rows(header: str) -> list[list[str]]:
    """The cells of the table whose first line begins with `header`."""
    table = PAGE[PAGE.index(header) :].split("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table]


def holds(cell: str, runs: pd.DataFrame, *row: object) -> None:
    """That `cell` has what `row` of `runs` kept of mIoU and PSNR."""
    if cell == "–":
        assert (*row, "miou") not in runs.index
        return
    for metric, figure in zip(("miou", "psnr"), cell.split("/"), strict=True):
        assert float(figure) == pytest.approx(runs[(*row, metric)], abs=0.0051)


def test_what_methods_keep_is_what_was_run() -> None:
    kept = EVERY[EVERY.severity == 3].set_index(["scene", "method", "kind", "metric"]).retention
    table = rows("| severity 3: kept of mIoU / of PSNR")
    assert {cells[0].strip("`") for cells in table} == set(RUNS[RUNS.severity == 3].kind)
    methods = [(BOWL, name) for name in ("splashsplat", "spacetime_gaussians", "hull_points")]
    methods += [(TANK, name) for name in ("splashsplat", "hull_points")]
    for kind, _, *cells in table:
        for (scene, method), cell in zip(methods, cells, strict=True):
            holds(cell, kept, scene, method, kind.strip("`"))


def test_what_mended_masks_keep_is_what_was_run() -> None:
    kept = RUNS.set_index(["method", "kind", "severity", "metric"]).retention
    for kind, *cells in rows("| masks | severity 2"):
        for severity, cell in zip((2, 3, 4), cells):
            holds(cell.split(":")[1].strip(), kept, "splashsplat", kind.strip("`"), severity)
        holds(cells[-1], kept, "splashsplat with masks as told", kind.strip("`"), 3)


def test_the_scores_are_those_of_the_runs() -> None:
    found = {
        StressRun(method, BOWL, 0, kind, 3, value): kept
        for method, kind, value, kept in RUNS[(RUNS.severity == 3) & (RUNS.metric == "miou")][
            ["method", "kind", "value", "retention"]
        ].itertuples(index=False)
    }
    table = rows("| by mIoU, 34 kinds at severity 3")
    assert len(table) == 3
    for method, *cells in table:
        scores = stability({run: kept for run, kept in found.items() if run.method == method.rstrip("†")})
        assert scores.runs == 34
        for estimate, cell in zip((scores.score, scores.worst), cells, strict=True):
            figures = [float(figure) for figure in re.findall(r"[\d.]+", cell)]
            assert figures == pytest.approx([estimate.value, *estimate.interval], abs=0.0051)


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

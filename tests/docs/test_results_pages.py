"""The results pages say what the committed tables say, and show the charts that are drawn from them."""

from __future__ import annotations

import csv
import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"


def rows(name: str) -> dict[tuple[str, str], dict[str, str]]:
    with (RESULTS / "data" / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return {(row["variant"], row["metric"]): row for row in csv.DictReader(file)}


def first_table(page: str) -> list[list[str]]:
    """Cells of the first table of a page, without marks for bold, code and the filter."""
    lines = (RESULTS / page).read_text(encoding="utf-8").splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("|"))
    end = next(i for i in range(start, len(lines)) if not lines[i].startswith("|"))
    return [[cell.strip(" *†`") for cell in line.strip("|").split("|")] for line in lines[start:end]]


def test_every_chart_is_drawn_by_the_script_and_shown_on_a_page() -> None:
    drawn = set(runpy.run_path(str(RESULTS / "charts.py"))["CHARTS"])
    committed = {path.stem for path in (RESULTS / "charts").glob("*.png")}
    pages = " ".join(page.read_text(encoding="utf-8") for page in RESULTS.glob("*.md"))
    shown = set(re.findall(r"\(charts/(\w+)\.png\)", pages))
    assert drawn == committed == shown


def test_the_index_names_every_page() -> None:
    index = (RESULTS / "README.md").read_text(encoding="utf-8")
    pages = {page.name for page in RESULTS.glob("*.md")} - {"README.md"}
    assert [page for page in sorted(pages) if f"({page})" not in index] == []


def test_the_switches_are_the_studys() -> None:
    table, study = first_table("switches.md"), rows("best")
    assert len(table) > 20
    for name, _, psnr, miou, *_ in table[2:]:
        for cell, metric, places in ((psnr, "psnr", 2), (miou, "miou", 4)):
            row = study[name, metric]
            mean, sd = (row["mean"], row["sd"]) if name == "best" else (row["difference"], row["difference_sd"])
            assert [float(part) for part in cell.split("±")] == pytest.approx(
                [float(mean), float(sd)], abs=10**-places / 2
            )


def test_told_nothing_is_what_was_measured() -> None:
    with (RESULTS / "data" / "told_nothing.csv").open(encoding="utf-8", newline="") as file:
        measured = {(row["scene"], row["row"], row["metric"]): float(row["value"]) for row in csv.DictReader(file)}
    table = first_table("told_nothing.md")
    metrics = ("psnr", "lpips", "miou", "spill", "jitter_error")
    places = (2, 4, 3, 3, 4)
    names = ("splashsplat", "scaffold_4d", "splashsplat version 4")
    scenes = [line[0] for line in table[2:-1]]
    assert sorted(scenes) == sorted({scene for scene, _, _ in measured})
    for scene, *cells in [[scene, *line[1:]] for scene, line in zip(scenes, table[2:-1])]:
        for name, cell in zip(names, cells):
            found = [float(part.strip(" *†")) for part in cell.split("/")]
            assert found == [pytest.approx(measured[scene, name, metric], abs=1e-9) for metric in metrics]
    for name, cell in zip(names, table[-1][1:]):
        for part, metric, digits in zip(cell.split("/"), metrics, places):
            mean = sum(measured[scene, name, metric] for scene in scenes) / len(scenes)
            assert float(part.strip(" *†")) == pytest.approx(mean, abs=0.51 * 10**-digits)


@pytest.mark.parametrize(
    ("label", "metric", "scale"),
    [
        ("PSNR, dB", "psnr", 0.005),
        ("LPIPS", "lpips", 5e-5),
        ("mIoU", "miou", 5e-4),
        ("jitter error", "jitter_error", 5e-5),
    ],
)
def test_the_baselines_are_the_studys(label: str, metric: str, scale: float) -> None:
    table, study = first_table("baselines.md"), rows("baselines")
    names = ["splashsplat", "splashsplat_masks_alone", *table[0][3:]]
    names[names.index("lite")] = "spacetime_gaussians_lite"
    cells = next(row for row in table if row[0] == label)[1:]
    for name, cell in zip(names, cells, strict=True):
        assert float(cell.split("±")[0].strip(" *")) == pytest.approx(
            float(study[name, metric]["mean"]), abs=scale * 1.001
        )

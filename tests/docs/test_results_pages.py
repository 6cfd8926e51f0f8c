"""The results pages say what the committed tables say, and show the charts that are drawn from them."""

from __future__ import annotations

import csv
import json
import re
import runpy
import statistics
from pathlib import Path
from typing import Any

import pytest

from splashbench.report import anytime
from splashbench.report.groups import groups
from splashbench.report.results import load_results

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"


def rows(name: str) -> dict[tuple[str, str], dict[str, str]]:
    with (RESULTS / "data" / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return {(row["variant"], row["metric"]): row for row in csv.DictReader(file)}


def tables(page: str) -> list[list[list[str]]]:
    """Cells of each table of a page, without marks for bold, code and the filter."""
    lines = (RESULTS / page).read_text(encoding="utf-8").splitlines()
    found: list[list[list[str]]] = []
    for before, line in zip(["", *lines], lines):
        if line.startswith("|"):
            if not before.startswith("|"):
                found.append([])
            found[-1].append([cell.strip(" *†`") for cell in line.strip("|").split("|")])
    return found


def first_table(page: str) -> list[list[str]]:
    return tables(page)[0]


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


TOLD_NOTHING = ("psnr", "lpips", "miou", "spill", "jitter_error")


def told_nothing() -> dict[tuple[str, str, str, str], float]:
    with (RESULTS / "data" / "told_nothing.csv").open(encoding="utf-8", newline="") as file:
        read = csv.DictReader(file)
        return {(row["set"], row["scene"], row["row"], row["metric"]): float(row["value"]) for row in read}


def test_told_nothing_is_what_was_measured() -> None:
    measured, table = told_nothing(), tables("told_nothing.md")[0]
    names = table[0][1:]
    assert names == ["splashsplat", "scaffold_4d", "spacetime_gaussians"]
    scenes = [line[0] for line in table[2:-1]]
    assert sorted(scenes) == sorted({scene for kind, scene, *_ in measured if kind == "240x160"})
    for scene, *cells in table[2:-1]:
        for name, cell in zip(names, cells, strict=True):
            found = [float(part.strip(" *†")) for part in cell.split("/")]
            assert found == [
                pytest.approx(measured["240x160", scene, name, metric], abs=1e-9) for metric in TOLD_NOTHING
            ]
    places = (2, 4, 3, 3, 4)
    for name, cell in zip(names, table[-1][1:], strict=True):
        for part, metric, digits in zip(cell.split("/"), TOLD_NOTHING, places, strict=True):
            mean = sum(measured["240x160", scene, name, metric] for scene in scenes) / len(scenes)
            assert float(part.strip(" *†")) == pytest.approx(mean, abs=0.51 * 10**-digits)


def test_told_nothing_is_the_mean_of_its_seeds() -> None:
    with (RESULTS / "data" / "told_nothing_seeds.csv").open(encoding="utf-8", newline="") as file:
        runs = list(csv.DictReader(file))
    measured, digits = told_nothing(), dict(zip(TOLD_NOTHING, (2, 4, 3, 3, 4), strict=True))
    seeds: dict[tuple[str, str, str], list[float]] = {}
    for run in runs:
        seeds.setdefault((run["scene"], run["row"], run["metric"]), []).append(float(run["value"]))
    assert {row for _, row, _ in seeds} == {"splashsplat", "scaffold_4d", "spacetime_gaussians", "deformable_3dgs"}
    for (scene, row, metric), values in seeds.items():
        assert measured["240x160", scene, row, metric] == pytest.approx(
            sum(values) / len(values), abs=0.51 * 10.0 ** -digits[metric]
        )
    for seed in ("0", "1", "2"):
        committed = scored("told_nothing", "told_nothing_earlier", seed=seed)
        for run in runs:
            if (run["row"], run["seed"]) == ("splashsplat", seed):
                value = committed[run["scene"], "splashsplat", "best", "33", False][run["metric"]]
                assert float(run["value"]) == pytest.approx(value, abs=0.51 * 10.0 ** -digits[run["metric"]])
    header, _, *lines = tables("told_nothing.md")[5]
    for scene, *cells in lines:
        for row, cell in zip(header[1:4], cells, strict=False):
            mean, sd, count = re.fullmatch(r"([\d.]+)(?: ± ([\d.]+))? \((\d)\)", cell).groups()  # type: ignore[union-attr]
            values = seeds[scene, row, "psnr"]
            assert (float(mean), int(count)) == (pytest.approx(sum(values) / len(values), abs=0.0051), len(values))
            if sd is not None:
                assert float(sd) == pytest.approx(statistics.stdev(values), abs=0.0051)


def test_the_first_page_has_the_means() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    table = [[cell.strip(" *†`") for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    start = next(n for n, row in enumerate(table) if row[0] == "method")
    measured = told_nothing()
    scenes = {scene for kind, scene, *_ in measured if kind == "240x160"}
    names = []
    for name, *cells in table[start + 2 : start + 7]:
        names.append(name)
        for cell, metric, digits in zip(cells, TOLD_NOTHING, (2, 4, 3, 3, 4), strict=True):
            mean = sum(measured["240x160", scene, name, metric] for scene in scenes) / len(scenes)
            assert float(cell) == pytest.approx(mean, abs=0.51 * 10**-digits)
    assert names == ["splashsplat", "scaffold_4d", "spacetime_gaussians", "deformable_3dgs", "hull_points"]


@pytest.mark.parametrize(("number", "kind"), [(1, "600x400"), (2, "new poses"), (3, "240x160")])
def test_told_nothing_elsewhere_is_what_was_measured(number: int, kind: str) -> None:
    measured, table = told_nothing(), tables("told_nothing.md")[number]
    names, lines = table[0][1:], [line for line in table[2:] if line[0] != "mean"]
    assert {scene for scene, *_ in lines} == {scene for of, scene, *_ in measured if of == kind}
    for scene, *cells in lines:
        for name, cell in zip(names, cells, strict=True):
            if cell == "–":
                assert (kind, scene, name, "psnr") not in measured
                continue
            found = [float(part.strip(" *†")) for part in cell.split("/")]
            assert found == [pytest.approx(measured[kind, scene, name, metric], abs=1e-9) for metric in TOLD_NOTHING]
    for line in table[2 + len(lines) :]:
        for name, cell in zip(names, line[1:], strict=True):
            for part, metric, digits in zip(cell.split("/"), TOLD_NOTHING, (2, 4, 3, 3, 4), strict=True):
                mean = sum(measured[kind, scene, name, metric] for scene, *_ in lines) / len(lines)
                assert float(part.strip(" *†")) == pytest.approx(mean, abs=0.51 * 10**-digits)


def quality_over_time(name: str) -> list[tuple[str, ...]]:
    """The rows of data/quality_over_time*.csv: row, metric, seconds, value."""
    with (RESULTS / "data" / f"quality_over_time{name}.csv").open(encoding="utf-8", newline="") as file:
        return [tuple(line) for line in csv.reader(file)][1:]


@pytest.mark.parametrize(
    ("name", "number", "times"),
    [
        ("", 0, (10, 30, 60, 120, 300)),
        ("_transparent", 4, (10, 30, 60, 120, 300)),
        ("_600x400", 6, (30, 60, 120, 300, 600)),
    ],
)
def test_quality_over_time_is_that_of_the_committed_results(name: str, number: int, times: tuple[int, ...]) -> None:
    lines = quality_over_time(name)
    made = runpy.run_path(str(ROOT / "docs" / "tools" / "quality_over_time.py"))["table"](name)
    assert lines == made
    measured = {(row, metric, seconds): float(value) for row, metric, seconds, value in lines}
    header, _, *table = tables("speed.md")[number]
    names = header[1:]
    assert [line[0] for line in table] == [f"{seconds} s" for seconds in times]
    for seconds, *cells in table:
        for method, cell in zip(names, cells, strict=True):
            for part, metric, digits in zip(cell.split("/"), ("psnr", "lpips", "miou"), (2, 4, 3), strict=True):
                value = measured[method, metric, seconds.removesuffix(" s")]
                assert float(part.strip(" *†")) == pytest.approx(value, abs=0.51 * 10**-digits)


def test_scenes_over_time_are_those_of_the_committed_results() -> None:
    made = runpy.run_path(str(ROOT / "docs" / "tools" / "quality_over_time.py"))
    results = load_results(ROOT / "leaderboards" / "told_nothing" / "results")
    (group,) = groups(results)
    nothing, entries = anytime.before(group, "psnr"), made["entries_of"](group)
    runs = {name: anytime.trajectories(group, entry, "psnr") for name, entry in entries.items()}
    digests = {each.result.scene.removeprefix("synthetic_"): each.result.digests.scene for each in results}

    def shown(method: str, scene: str, seconds: float) -> float:
        of = [run for (digest, _), run in runs[method].items() if digest == digests[scene]]
        return statistics.mean(run.at(seconds, nothing[digests[scene]]) for run in of)

    _, _, *table = tables("speed.md")[2]
    assert {line[0] for line in table} == set(digests)
    for scene, *cells, fits in table:
        for cell, seconds in zip(cells, (10, 30, 60, 120, 300), strict=True):
            own, rival = (float(part.strip(" *")) for part in cell.split("/"))
            best = max(shown(name, scene, seconds) for name in ("scaffold_4d", "spacetime_gaussians"))
            assert (own, rival) == (
                pytest.approx(shown("splashsplat", scene, seconds), abs=0.0051),
                pytest.approx(best, abs=0.0051),
            )
        for name, cell in zip(entries, fits.split(","), strict=True):
            of = [run.seconds[-1] for (digest, _), run in runs[name].items() if digest == digests[scene]]
            assert float(cell) == pytest.approx(statistics.median(of), abs=0.51)


def test_leads_over_time_are_those_of_the_committed_results() -> None:
    lines = quality_over_time("")
    leads = {(seconds, metric): (row, float(value)) for row, metric, seconds, value in lines if row.startswith("lead")}
    _, _, *table = tables("speed.md")[1]
    assert [line[0] for line in table] == ["10 s", "30 s", "60 s", "120 s", "300 s"]
    for seconds, rival, lead, interval, share, worst in table:
        at = seconds.removesuffix(" s")
        assert leads[at, "psnr"][0] == f"lead over {rival}"
        low, high = interval.split(" to ")
        for metric, cell in (("psnr", lead), ("low", low), ("high", high), ("worst", worst)):
            assert float(cell.strip("*")) == pytest.approx(leads[at, metric][1], abs=0.0051)
        assert float(share.removesuffix(" %")) == pytest.approx(100 * leads[at, "share"][1], abs=0.51)


def test_states_of_a_large_fit_are_what_was_measured() -> None:
    with (RESULTS / "data" / "whole_fit_told_nothing.csv").open(encoding="utf-8", newline="") as file:
        measured = list(csv.DictReader(file))
    header, _, *lines = first_table("whole_fit.md")
    assert {row["method"] for row in measured} == set(header[1:])
    assert [line[0] for line in lines] == ["60 s", "120 s", "300 s", "600 s", "the end"]
    for moment, *cells in lines:
        until = float("inf") if moment == "the end" else float(moment.removesuffix(" s"))
        for method, cell in zip(header[1:], cells, strict=True):
            shown = [row for row in measured if row["method"] == method and float(row["seconds"]) <= until]
            told = [] if cell == "–" else [float(part.strip(" *†")) for part in cell.split("/")]
            assert told == ([float(shown[-1]["psnr"]), float(shown[-1]["miou"])] if shown else [])


def test_states_of_version_30_are_what_was_measured() -> None:
    with (RESULTS / "data" / "whole_fit_version_30.csv").open(encoding="utf-8", newline="") as file:
        measured = {
            round(float(row["seconds"])): (float(row["psnr"]), float(row["miou"])) for row in csv.DictReader(file)
        }
    page = " ".join((RESULTS / "whole_fit.md").read_text(encoding="utf-8").split())
    told = re.findall(r"(\d+\.\d+) (?:dB )?and (\.\d+) (?:at its end )?after (\d+)", page)
    assert [int(seconds) for *_, seconds in told] == [45, 277, 434, 609]
    for fidelity, overlap, seconds in told:
        assert (float(fidelity), float(overlap)) == measured[int(seconds)]


def test_told_all_is_what_was_measured() -> None:
    measured, table = told_nothing(), tables("told_nothing.md")[4]
    scenes = table[0][1:-1]
    assert set(scenes) == {scene for kind, scene, *_ in measured if kind == "told all"}
    pairs = (("psnr", "miou"), ("psnr", "miou"), ("volume_iou", "motion_error"), ("volume_iou", "motion_error"))
    for (label, *cells), metrics in zip(table[2:], pairs, strict=True):
        row = "told all" if "told all" in label else "told nothing"
        for n, metric in enumerate(metrics):
            figures = [float(cell.split("/")[n]) for cell in cells]
            values = [measured["told all", scene, row, metric] for scene in scenes]
            assert figures[:-1] == pytest.approx(values, abs=1e-9)
            assert figures[-1] == pytest.approx(sum(values) / len(values), abs=0.0051 if metric == "psnr" else 5.1e-4)


def scored(*folders: str, seed: str = "0") -> dict[tuple[str, str, str, str, bool], dict[str, Any]]:
    """Committed results of a seed: metrics by scene, method, preset, version, and whether container masks were used."""
    found = {}
    for folder in folders:
        for path in (ROOT / "leaderboards" / folder / "results").glob(f"*__seed{seed}__*.json"):
            result = json.loads(path.read_text(encoding="utf-8"))
            masks = result["settings"].get("container_masks", True)
            scene = result["scene"].removeprefix("synthetic_")
            metrics = {name: metric["value"] for name, metric in result["metrics"].items()}
            found[scene, result["method"], result["preset"], result["method_version"], masks] = metrics
    return found


def test_without_container_masks_is_that_of_the_committed_results() -> None:
    results = scored("told_nothing", "told_nothing_earlier")
    _, _, *lines = tables("told_nothing.md")[6]
    columns = (
        ("splashsplat", "best", "24", False),
        ("splashsplat", "best", "22", True),
    )
    scenes = [line[0] for line in lines[:-1]]
    assert len(scenes) == 6
    for n, (method, preset, version, masks) in enumerate(columns, start=1):
        sums = dict.fromkeys(TOLD_NOTHING, 0.0)
        for line in lines:
            of = [
                values
                for (scene, *who, told, used), values in results.items()
                if scene == line[0] and who == [method, preset] and version == told and used == masks
            ]
            assert len(of) == (line[0] != "mean")
            for part, metric, digits in zip(line[n].split("/"), TOLD_NOTHING, (2, 4, 3, 3, 4), strict=True):
                value = of[0][metric] if of else sums[metric] / len(scenes)
                sums[metric] += of[0][metric] if of else 0
                assert float(part.strip(" *†")) == pytest.approx(value, abs=0.51 * 10**-digits), (line[0], method)
    header, _, *quick = tables("told_nothing.md")[7]
    for (label, *cells), (version, masks) in zip(quick, (("23", False), ("24", False), ("23", True)), strict=True):
        values = [results[scene, "splashsplat", "quick", version, masks]["psnr"] for scene in header[1:-1]]
        figures = [float(cell.strip("*")) for cell in cells]
        assert figures[:-1] == pytest.approx(values, abs=0.0051), label
        assert figures[-1] == pytest.approx(sum(values) / len(values), abs=0.0051)


def test_what_was_withheld_is_what_was_measured() -> None:
    with (RESULTS / "data" / "withheld.csv").open(encoding="utf-8", newline="") as file:
        measured = {(row["scene"], row["row"], row["metric"]): float(row["value"]) for row in csv.DictReader(file)}
    header, _, *lines = first_table("interpolation.md")
    scenes = header[1:-1]
    assert {(scene, name) for scene in scenes for name, *_ in lines} == {(scene, name) for scene, name, _ in measured}
    for name, *cells in lines:
        figures = [[float(part.strip(" *†")) for part in cell.split("/")] for cell in cells]
        for n, metric in enumerate(TOLD_NOTHING):
            values = [measured[scene, name, metric] for scene in scenes]
            assert [of[n] for of in figures[:-1]] == pytest.approx(values, abs=1e-9)
            assert figures[-1][n] == pytest.approx(sum(values) / len(values), abs=0.51 * 10.0 ** -(2, 4, 3, 3, 4)[n])


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


def test_without_masks_the_page_says_what_was_run() -> None:
    with (RESULTS / "data" / "unmasked.csv").open(encoding="utf-8", newline="") as file:
        runs = {(row["scene"], row["masks"]): row for row in csv.DictReader(file)}
    table = first_table("unmasked.md")[2:]
    names = [cells[0] for cells in table[:-1]]
    assert {(name, masks) for name in names for masks in ("none", "true")} == set(runs)
    metrics = ("psnr", "lpips", "miou")
    for name, overlaps, *cells in table[:-1]:
        wanted = [float(value) for value in runs[name, "none"]["mask_iou_by_camera"].split()]
        assert [float(value) for value in overlaps.split(",")] == wanted
        for masks, cell in zip(("none", "true"), cells, strict=True):
            for metric, figure in zip(metrics, cell.split("/"), strict=True):
                places = len(figure.strip().split(".")[1])
                assert float(figure) == pytest.approx(float(runs[name, masks][metric]), abs=0.501 * 10**-places)
    for masks, cell in zip(("none", "true"), table[-1][2:], strict=True):
        for metric, figure in zip(metrics, cell.split("/"), strict=True):
            mean = statistics.mean(float(runs[name, masks][metric]) for name in names)
            assert float(figure) == pytest.approx(mean, abs=0.501 * 10 ** -len(figure.strip().split(".")[1]))


def test_version_37_is_what_was_measured() -> None:
    with (RESULTS / "data" / "version_37.csv").open(encoding="utf-8", newline="") as file:
        measured = {
            (row["scene"], row["preset"], row["withheld"], row["version"], row["metric"]): float(row["value"])
            for row in csv.DictReader(file)
            if row["seed"] == "0"
        }
    page = (RESULTS / "history.md").read_text(encoding="utf-8")
    section = page[page.index("## Version 37") : page.index("## Version 36")]
    metrics = (("psnr", 2), ("lpips", 4), ("miou", 3), ("jitter_error", 4), ("velocity_epe_relative", 2))
    new = {"thin_stream, poured": "stream_25", "glass_tank, amber": "amber_33", "clear_liquid, blue": "clear_20"}
    seen = 0
    for header, preset, withheld in (
        ("| `best`, every timestep", "best", ""),
        ("| `quick`, fitted to every second", "quick", "odd"),
        ("| `quick`, scenes on which", "quick", ""),
    ):
        for line in section[section.index(header) :].split("\n\n")[0].splitlines()[2:]:
            name, *cells = (cell.strip() for cell in line.strip("|").split("|"))
            scene = next((short for label, short in new.items() if name.startswith(label)), name)
            for (metric, digits), cell in zip(metrics, cells):
                figures = [float(figure) for figure in cell.replace("*", "").split(" → ")]
                for version, figure in zip(("36", "37"), figures * (3 - len(figures)), strict=True):
                    value = measured[scene, preset, withheld, version, metric]
                    assert figure == pytest.approx(value, abs=0.51 * 10**-digits), (line, metric)
                    seen += 1
    assert seen == 5 * 10 + 5 * 8 + 3 * 10


def test_states_of_version_37_are_what_was_measured() -> None:
    with (RESULTS / "data" / "whole_fit_version_37.csv").open(encoding="utf-8", newline="") as file:
        states = [
            tuple(float(row[name]) for name in ("seed", "seconds", "psnr", "miou")) for row in csv.DictReader(file)
        ]
    ends = [[state for state in states if state[0] == seed][-1] for seed in range(3)]
    page = (RESULTS / "whole_fit.md").read_text(encoding="utf-8")
    said = re.search(
        r"falls\*\*: (\S+), (\S+) and (\S+) dB.*?with (\S+) to (\S+) of mIoU"
        r".*?took (\d+) s.*?had (\S+) dB after (\d+) s.*?took (\d+) s",
        page,
        re.DOTALL,
    )
    assert said is not None
    assert [float(said[n]) for n in (1, 2, 3)] == pytest.approx([end[2] for end in ends], abs=0.0051)
    assert [float(said[n]) for n in (4, 5)] == [min(end[3] for end in ends), max(end[3] for end in ends)]
    assert [float(said[n]) for n in (6, 9)] == pytest.approx([ends[1][1], ends[0][1]], abs=0.51)
    assert any(state[0] == 1 and abs(state[1] - float(said[8])) < 1 and state[2] == float(said[7]) for state in states)

"""docs/results/stability.md: its tables are what the files in data say."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
import pytest

from splashbench.study.stability import Stability, StressRun, stability

RESULTS = Path(__file__).parents[2] / "docs" / "results"
PAGE = (RESULTS / "stability.md").read_text(encoding="utf-8")
EVERY = pd.read_csv(RESULTS / "data" / "stability_runs.csv")
BOWL, TANK = "synthetic_opaque_bowl", "synthetic_glass_tank"
RUNS = EVERY[EVERY.scene == BOWL]
#: Told the times alone, the version of today.
TODAY = pd.read_csv(RESULTS / "data" / "stability_told_nothing.csv")
TOLD_NOTHING, EVERY_GLASS = TODAY[TODAY.scene == BOWL], TODAY[TODAY.scene == TANK]
SECOND_ON_GLASS, ON_GLASS, WORST_ON_GLASS = (EVERY_GLASS[EVERY_GLASS.severity == number] for number in (2, 3, 5))
METHODS = ("splashsplat", "spacetime_gaussians", "hull_points")
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
    kept = TOLD_NOTHING.set_index(["method", "kind", "severity", "metric"]).retention
    table = rows("| kept of mIoU / of PSNR")
    assert {cells[0].strip("`") for cells in table} == set(TOLD_NOTHING[TOLD_NOTHING.severity == 3].kind)
    for kind, _, *cells in table:
        columns = [(method, severity) for method in METHODS for severity in (3, 5)]
        for (method, severity), cell in zip(columns, cells, strict=True):
            holds(cell, kept, method, kind.strip("`"), severity)


def test_what_is_kept_on_glass_is_what_was_run() -> None:
    kept = ON_GLASS.set_index(["method", "kind", "metric"]).retention
    table = rows("| kept of mIoU / of PSNR, severity 3 |")
    for kind, _, *cells in table:
        for method, cell in zip(METHODS, cells, strict=True):
            holds(cell, kept, method, kind.strip("`"))
    shown = {cells[0].strip("`") for cells in table}
    others = ON_GLASS[(ON_GLASS.method == "splashsplat") & ~ON_GLASS.kind.isin(shown)]
    assert len(others[others.metric == "miou"]) == 16
    assert others[others.metric == "miou"].retention.min() >= 0.985
    psnr = others[others.metric == "psnr"].sort_values("retention")
    assert list(psnr.kind[:4]) == ["haze", "moving_shadow", "sensor_noise", "gamma"]
    assert list(psnr.retention[:4]) == pytest.approx([0.33, 0.87, 0.90, 0.95], abs=0.0051)


def on_glass(runs: pd.DataFrame, method: str, metric: str) -> tuple[Stability, int]:
    """Scores of a method's `runs` on glass, and how many of these keep less than half."""
    chosen = runs[(runs.method == method.rstrip("†")) & (runs.metric == metric)]
    kept = {StressRun(method, TANK, 0, run.kind, run.severity, run.value): run.retention for run in chosen.itertuples()}
    return stability(kept), sum(value < 0.5 for value in kept.values())


def figures_in(text: str) -> list[float]:
    return [float(figure) for figure in re.findall(r"\.\d+|(?<![\d.])[01](?![\d.])", text)]


def said_on_the_page(pattern: str) -> re.Match[str]:
    found = re.search(pattern, " ".join(PAGE.split()))
    assert found is not None
    return found


@pytest.mark.parametrize("severity", [3, 5])
def test_the_scores_on_glass_are_those_of_the_runs(severity: int) -> None:
    runs = ON_GLASS if severity == 3 else WORST_ON_GLASS
    table = rows(f"| by mIoU, severity {severity}, glass_tank")
    assert len(table) == 3
    for method, *cells, broken in table:
        scores, below = on_glass(runs, method, "miou")
        assert broken == f"{below} of {scores.runs}"
        for estimate, cell in zip((scores.score, scores.worst), cells, strict=True):
            assert figures_in(cell) == pytest.approx([estimate.value, *estimate.interval], abs=0.0051)
    by_psnr = [on_glass(runs, method, "psnr") for method in METHODS]
    figures = [figure.value for scores, _ in by_psnr for figure in (scores.score, scores.worst)]
    rivals = r"(\S+) and (\S+) for spacetime_gaussians, (\S+) and (\S+) for hull"
    if severity == 3:
        said = said_on_the_page(rf"S is (\.\d+) and CVaR10 (\.\d+); {rivals}")
    else:
        said = said_on_the_page(rf"By PSNR, at severity 5, S is (\S+) and CVaR10 (\.\d+); {rivals}")
        assert [below for _, below in by_psnr] == [2, 6, 10]
        assert "Two, six and ten runs keep less than half." in PAGE
    assert [float(figure) for figure in said.groups()] == pytest.approx(figures, abs=0.0051)


def test_what_is_kept_on_glass_at_the_worst_severity() -> None:
    kept = WORST_ON_GLASS.set_index(["method", "kind", "metric"]).retention
    table = rows("| kept of mIoU / of PSNR, severity 5 |")
    for kind, _, *cells in table:
        for method, cell in zip(METHODS, cells, strict=True):
            holds(cell, kept, method, kind.strip("`"))
    assert {len(of_method) for _, of_method in WORST_ON_GLASS.groupby(["method", "metric"])} == {30}
    ours = WORST_ON_GLASS[WORST_ON_GLASS.method == "splashsplat"]
    others = ours[~ours.kind.isin({cells[0].strip("`") for cells in table})]
    assert others[others.metric == "miou"].retention.min() >= 0.985
    assert others[others.metric == "psnr"].retention.min() >= 0.895
    said_on_the_page("rivals break under nine and three kinds")
    assert [on_glass(WORST_ON_GLASS, method, "miou")[1] for method in METHODS] == [0, 9, 3]


def test_what_is_kept_on_glass_at_the_second_severity() -> None:
    assert list(SECOND_ON_GLASS.method.unique()) == ["splashsplat"]
    miou = SECOND_ON_GLASS[SECOND_ON_GLASS.metric == "miou"].sort_values("retention")
    assert len(miou) == 31
    assert list(miou.kind[:3]) == ["eroded_masks", "grown_masks", "fewer_timesteps"]
    said = said_on_the_page(r"eroded by 2 px \((\S+)\), grown by 2 px \((\S+)\), and of every third timestep \((\S+)\)")
    assert [float(figure) for figure in said.groups()] == pytest.approx(list(miou.retention[:3]), abs=0.0051)
    scores, below = on_glass(SECOND_ON_GLASS, "splashsplat", "miou")
    said = said_on_the_page(r"timestep \(\S+\)\. S is (\S+ \(.*?\)), and CVaR10 (\S+ \(.*?\))\.")
    for text, estimate in zip(said.groups(), (scores.score, scores.worst)):
        assert figures_in(text) == pytest.approx([estimate.value, *estimate.interval], abs=0.0051)
    assert below == 0
    psnr = SECOND_ON_GLASS[SECOND_ON_GLASS.metric == "psnr"].sort_values("retention")
    haze = float(said_on_the_page(r"By PSNR haze costs most, and leaves (\.\d+)")[1])
    assert (psnr.kind.iloc[0], psnr.retention.iloc[0]) == ("haze", pytest.approx(haze, abs=0.0051))


def test_masks_of_which_nothing_is_left_are_found_anew() -> None:
    kept = TOLD_NOTHING[TOLD_NOTHING.kind == "eroded_masks"].set_index(["method", "severity", "metric"]).retention
    said = said_on_the_page(
        r"anew\*\* since version 25: (\S+ / \S+) and (\S+ / \S+) are kept, more than of 4 px \((\S+ / \S+)\)"
    )
    for severity, cell in zip((4, 5, 3), said.groups()):
        holds(cell, kept, "splashsplat", severity)
    assert kept["splashsplat 24", 5, "miou"] == 0


def test_what_is_kept_at_the_second_severity() -> None:
    runs = TOLD_NOTHING[(TOLD_NOTHING.severity == 2) & (TOLD_NOTHING.method == "splashsplat")]
    second = runs[runs.metric == "miou"].sort_values("retention")
    assert set(second.kind) == set(TOLD_NOTHING.kind)
    assert len(second) == 32
    assert list(second.kind[:2]) == ["fewer_timesteps", "uneven_timesteps"]
    said = said_on_the_page(
        r"every third timestep, (\.\d+) of mIoU.*? timesteps keep (\.\d+), and the other 30 kinds (\.\d+) or"
    )
    least = [float(figure) for figure in said.groups()]
    assert least[0] == pytest.approx(second.retention.iloc[0], abs=0.0005)
    assert least[1] == pytest.approx(second.retention.iloc[1], abs=0.0051)
    assert second.retention.iloc[2] >= least[2] - 0.005


def test_what_mended_masks_keep_is_what_was_run() -> None:
    kept = RUNS.set_index(["method", "kind", "severity", "metric"]).retention
    for kind, *cells in rows("| masks | severity 2"):
        for severity, cell in zip((2, 3, 4), cells):
            holds(cell.split(":")[1].strip(), kept, "splashsplat", kind.strip("`"), severity)
        holds(cells[-1], kept, "splashsplat with masks as told", kind.strip("`"), 3)


def found(metric: str, method: str) -> dict[StressRun, float]:
    """What `method` kept of `metric` at the severities of the first table."""
    runs = TOLD_NOTHING[(TOLD_NOTHING.metric == metric) & (TOLD_NOTHING.method == method)]
    return {
        StressRun(method, BOWL, 0, kind, severity, value): kept
        for kind, severity, value, kept in runs[runs.severity.isin((3, 5))][
            ["kind", "severity", "value", "retention"]
        ].itertuples(index=False)
    }


def test_the_scores_are_those_of_the_runs() -> None:
    table = rows("| by mIoU, severities 3 and 5")
    assert len(table) == 3
    for method, *cells, broken in table:
        kept = found("miou", method.rstrip("†"))
        scores = stability(kept)
        assert broken == f"{sum(value < 0.5 for value in kept.values())} of {scores.runs}"
        for estimate, cell in zip((scores.score, scores.worst), cells, strict=True):
            figures = [float(figure) for figure in re.findall(r"[\d.]+", cell)]
            assert figures == pytest.approx([estimate.value, *estimate.interval], abs=0.0051)


def test_the_scores_by_psnr_are_those_of_the_runs() -> None:
    said = re.search(
        r"S is (\.\d+), and CVaR10 (\.\d+); (\.\d+) and (\.\d+) for spacetime_gaussians, (\.\d+) and (\.\d+) for hull",
        " ".join(PAGE.split()),
    )
    assert said is not None
    scores = [stability(found("psnr", method)) for method in METHODS]
    figures = [figure.value for score in scores for figure in (score.score, score.worst)]
    assert [float(figure) for figure in said.groups()] == pytest.approx(figures, abs=0.0051)
    broken = [sum(value < 0.5 for value in found("psnr", method).values()) for method in METHODS]
    assert (broken, "Seven, nine and eleven runs" in " ".join(PAGE.split())) == ([7, 9, 11], True)


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
    runs = TOLD_NOTHING[TOLD_NOTHING.severity.isin((3, 5))]
    means = runs.groupby(["method", "metric"]).retention.mean()
    names = [(method, metric) for method in METHODS for metric in ("miou", "psnr")]
    assert [float(figure) for figure in said.groups()] == pytest.approx([means[name] for name in names], abs=0.0051)


def test_what_version_36_keeps_of_turned_rigs_is_what_was_run() -> None:
    kept = pd.read_csv(RESULTS / "data" / "stability_version_36.csv").set_index(
        ["scene", "version", "kind", "amount", "metric"]
    )
    table = rows("| kept of mIoU / of PSNR, before and after |")
    assert len(table) == 4
    for kind, amount, *cells in table:
        size = float(amount.split()[0])
        for (scene, version), cell in zip(((BOWL, 24), (BOWL, 36), (TANK, 26), (TANK, 36)), cells, strict=True):
            holds(cell.replace("*", ""), kept.retention, scene, version, kind.strip("`"), size)


def test_what_version_37_changes_is_what_was_run() -> None:
    measured = pd.read_csv(RESULTS / "data" / "stability_version_37.csv").set_index(
        ["kind", "amount", "metric", "version"]
    )
    kind = ""
    for name, amounts, before, after in rows("| opaque_bowl, mIoU / PSNR in dB |"):
        kind = name.strip("`") or kind
        sizes = [float(number) for number in re.findall(r"[\d.]+", amounts)]
        for version, cell in ((36, before), (37, before if after == "the same" else after)):
            for size, pair in zip(sizes, cell.replace("*", "").split(", "), strict=True):
                for metric, figure, within in zip(("miou", "psnr"), pair.split("/"), (5.1e-4, 0.0051), strict=True):
                    assert float(figure) == pytest.approx(measured.value[kind, size, metric, version], abs=within)


def test_what_version_37_hardly_touches_is_what_was_run() -> None:
    runs = pd.read_csv(RESULTS / "data" / "stability_version_37.csv")
    few = runs.groupby("kind").severity.nunique() == 1
    value = runs[runs.kind.isin(few[few].index)].set_index(["kind", "metric", "version"]).value.unstack()
    said = re.search(
        r"of (\w+) more kinds at the fifth.*?mIoU differs by (\S+) \(`(\w+)`\) to (\S+) \(`(\w+)`\), "
        r"PSNR by (\S+) to (\S+) dB",
        PAGE,
    )
    assert said is not None
    assert said[1] == "thirteen"
    assert int(few.sum()) == 13
    change = (value[37] - value[36]).unstack()
    assert (change.miou.idxmin(), change.miou.idxmax()) == (said[3], said[5])
    assert [float(said[n]) for n in (2, 4)] == pytest.approx([change.miou.min(), change.miou.max()], abs=5.1e-4)
    assert [float(said[n]) for n in (6, 7)] == pytest.approx([change.psnr.min(), change.psnr.max()], abs=0.0051)

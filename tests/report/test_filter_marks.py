"""Figures of mixed methods that rest on the silhouettes' filter say so, in every table and chart; no others do."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from matplotlib.figure import Figure

from splashbench.cli.score import _summary
from splashbench.harness.runner import run_method
from splashbench.report.charts import speed_accuracy_chart
from splashbench.report.contact_sheet import contact_sheet
from splashbench.report.results import ResultFile
from splashbench.report.table import leaderboard_table
from splashbench.report.table_markdown import to_markdown
from splashbench.scene import Scene
from splashbench.score.metrics import METRICS
from splashbench.score.notation import FILTER_MARK, FILTER_NOTE, filter_mark

FIGURES = {"psnr": 20.0, "miou": 0.71, "spill": 0.123, "spill_rgb": 0.345, "sigma_d": 52.0, "fit_seconds": 60.0}
MARKED = {"0.7100", "0.1230", "52.0"}


def _cells(line: str) -> set[str]:
    return {cell.replace("*", "").strip() for cell in line.split("|")}


@pytest.fixture
def results(make_result: Any) -> list[Any]:
    return [
        make_result(name, scene=scene, mixed=name == "together", **FIGURES)
        for name in ("alone", "together")
        for scene in ("bowl", "tank")
    ]


def test_what_rests_on_the_filter() -> None:
    marked = {name for name, metric in METRICS.items() if filter_mark(metric, True, 1.0)}
    assert {"miou", "spill", "sigma_d", "mu_d", "uniformity", "delta_e", "sdf_iou", "velocity_epe"} < marked
    assert "particles_per_frame" in marked
    assert marked.isdisjoint(
        {"psnr", "dpsnr_bg", "ssim", "ssim_fg", "lpips", "spill_rgb", "jitter_error", "fit_seconds"}
    )
    assert not any(filter_mark(metric, False, 1.0) or filter_mark(metric, True, None) for metric in METRICS.values())


def test_the_leaderboard_marks_them_by_scene_and_in_means(results: list[Any]) -> None:
    text = to_markdown(leaderboard_table([ResultFile(f"{i}.json", result) for i, result in enumerate(results)]), [])
    assert FILTER_NOTE in text
    lines = [line for line in text.splitlines() if line.startswith("| together")]
    assert len(lines) == 3  # two scenes and the mean
    for line in lines:
        assert {cell for cell in _cells(line) if FILTER_MARK in cell} == {figure + FILTER_MARK for figure in MARKED}
    without = [line for line in text.splitlines() if line.startswith("| alone")]
    assert len(without) == 3
    assert not any(FILTER_MARK in line for line in without)


def test_the_note_stands_only_where_a_mixed_method_does(results: list[Any]) -> None:
    text = to_markdown(leaderboard_table([ResultFile("0.json", results[0])]), [])
    assert FILTER_MARK not in text


def test_the_scores_that_are_printed_are_marked(results: list[Any]) -> None:
    text = _summary([results[0], results[2]])
    assert text.count(FILTER_NOTE) == 1
    alone, together = (next(line for line in text.splitlines() if line.startswith(name)) for name in ("alone", "toget"))
    assert FILTER_MARK not in alone
    marked = {word.rstrip(FILTER_MARK) for word in together.split() if FILTER_MARK in word}
    assert marked == {"0.7100", "0.1230"}
    assert FILTER_MARK not in _summary([results[0]])


def test_the_contact_sheet_marks_the_opacity(balls: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[str] = []

    def spy(figure: Figure, *rest: object, **more: object) -> None:
        axes = [text.get_ylabel() for text in figure.axes]
        written.append("|".join([*axes, figure.get_supxlabel()]))
        save(figure, *rest, **more)

    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", spy)
    out = run_method("hull_points", balls.directory, tmp_path / "submission", timing_frames=0)
    plain = SimpleNamespace(identity=out.identity, status=out.status, rendering=out.rendering, alpha=out.alpha)
    mixed = SimpleNamespace(**{**vars(plain), "identity": out.identity.model_copy(update={"mixed": True})})
    contact_sheet(balls, [plain], tmp_path / "plain.png")
    contact_sheet(balls, [plain, mixed], tmp_path / "mixed.png")
    assert FILTER_MARK not in written[0]
    assert written[1].count(f"foreground\nopacity{FILTER_MARK}") == 1
    assert FILTER_NOTE[:30] in written[1]


def test_the_chart_marks_miou_and_not_lpips(make_result: Any, results: list[Any], tmp_path: Path) -> None:
    def drawn(name: str, chosen: list[Any]) -> str:
        (tmp_path / name).mkdir()
        sources = [ResultFile(f"{i}.json", result) for i, result in enumerate(chosen)]
        return speed_accuracy_chart(sources, tmp_path / name)[1].read_text()

    with_lpips = [make_result("together", scene=scene, mixed=True, lpips=0.05, **FIGURES) for scene in ("bowl", "tank")]
    # In an SVG, matplotlib says as a comment what it writes.
    note = FILTER_NOTE[2:40]
    text = drawn("miou", results)
    assert note in text
    assert f"together{FILTER_MARK}" in text
    assert f"alone{FILTER_MARK}" not in text
    assert note not in drawn("lpips", with_lpips)
    assert note not in drawn("alone", results[:2])

"""Charts: what they draw is right, nothing is dropped, and the bytes are the same each time."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splashbench.files import image_size
from splashbench.report.charts import speed_accuracy_chart
from splashbench.report.results import ResultFile, load_results
from splashbench.report.speed_accuracy import ChartedMethod, Dot, machines, pareto_front, reported_machine
from splashbench.report.table import leaderboard_table
from splashbench.report.table_markdown import to_markdown


def test_pareto_front_keeps_what_nothing_beats_in_both() -> None:
    points = [(1.0, 5.0), (2.0, 4.0), (3.0, 8.0), (3.0, 7.0), (9.0, 8.0)]
    assert pareto_front(points, higher_is_better=True) == [(1.0, 5.0), (3.0, 8.0)]
    assert pareto_front(points, higher_is_better=False) == [(1.0, 5.0), (2.0, 4.0)]


def test_pareto_front_by_brute_force() -> None:
    rng = np.random.default_rng(0)
    for _ in range(30):
        points = [(float(x), float(y)) for x, y in rng.integers(0, 6, size=(rng.integers(1, 25), 2))]
        front = pareto_front(points, higher_is_better=False)
        beaten = {p for p in points if any(q != p and q[0] <= p[0] and q[1] <= p[1] for q in points)}
        assert front == sorted(set(points) - beaten)


def test_summary_is_the_interquartile_mean_with_an_interval_around_it() -> None:
    values = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1000.0]
    method = ChartedMethod("a", dots=[Dot(10.0, {"psnr": value}, None, "bowl") for value in values])
    summary = method.summary("psnr")
    assert summary is not None
    assert summary.value.value == pytest.approx(3.5)
    assert summary.seconds.value == pytest.approx(10.0)
    assert summary.value.interval is not None
    assert summary.value.interval[0] < 3.5 < summary.value.interval[1]
    method.dots = method.dots[:4]
    few = method.summary("psnr")
    assert few is not None
    assert few.value.interval is None
    assert method.summary("lpips") is None


def test_runs_are_sorted_into_machines_methods_controls_and_failures(folder: Path, make_result: Any) -> None:
    make_result("delta", cpu="another processor", psnr=19.0, fit_seconds=7.0).save(folder)
    other, first = machines(load_results(folder))
    assert (other.title.split(" ·")[0], first.title.split(" ·")[0]) == (
        "another processor, 2 cores",
        "test processor, 2 cores",
    )
    assert [(entry.label, len(entry.dots)) for entry in first.entries] == [("alpha", 6), ("beta", 6)]
    assert set(first.controls) == {"nothing", "oracle"}
    assert dict(first.failures) == {"gamma: out_of_memory": 1}
    assert first.quality_name() == "dpsnr_bg"
    assert other.quality_name() == "psnr"


def test_the_gain_over_background_is_charted_only_when_every_run_has_it(make_result: Any) -> None:
    results = [
        make_result("alpha", 0, psnr=20.0, dpsnr_bg=2.0, fit_seconds=5.0),
        make_result("beta", 0, psnr=19.0, fit_seconds=5.0),
    ]
    (machine,) = machines([ResultFile(f"{i}.json", result) for i, result in enumerate(results)])
    assert machine.quality_name() == "psnr"


def test_without_lpips_weights_the_panel_shows_miou(make_result: Any) -> None:
    without = make_result("alpha", 0, psnr=20.0, miou=0.8, fit_seconds=5.0)
    (machine,) = machines([ResultFile("0.json", without)])
    assert machine.perceptual_name() == "miou"
    weighed = make_result("beta", 0, psnr=20.0, miou=0.8, lpips=0.1, fit_seconds=5.0)
    (machine,) = machines([ResultFile("0.json", without), ResultFile("1.json", weighed)])
    assert machine.perceptual_name() == "lpips"


def test_two_protocols_never_share_a_panel(make_result: Any) -> None:
    first = make_result("alpha", 0, psnr=20.0, fit_seconds=5.0)
    changed = first.model_copy(update={"protocol": first.protocol.model_copy(update={"opacity_threshold": 0.9})})
    found = machines([ResultFile("0.json", first), ResultFile("1.json", changed)])
    assert [len(machine.entries[0].dots) for machine in found] == [1, 1]
    assert found[0].title.endswith("protocol v1")


def test_presets_and_settings_of_a_method_are_told_apart(make_result: Any) -> None:
    results = [
        make_result("alpha", 0, psnr=20.0, fit_seconds=5.0),
        make_result("alpha", 0, psnr=20.0, fit_seconds=5.0, preset="quick"),
        make_result("alpha", 0, psnr=20.0, fit_seconds=5.0, preset="quick", settings={"grid": 48}),
    ]
    (machine,) = machines([ResultFile(f"{i}.json", result) for i, result in enumerate(results)])
    labels = [entry.label for entry in machine.entries]
    assert labels[0] == "alpha [best]"
    assert all(re.fullmatch(r"alpha \[quick\] [0-9a-f]{8}", label) for label in labels[1:])


def test_the_memory_charted_is_the_device_s_where_one_was_used(make_result: Any) -> None:
    on_device = {"psnr": 20.0, "fit_seconds": 5.0, "peak_memory_bytes": 1e9, "peak_device_memory_bytes": 8e9}
    results = [
        make_result("alpha", **on_device),
        make_result("beta", psnr=20.0, fit_seconds=5.0, peak_memory_bytes=2e9),
    ]
    (machine,) = machines([ResultFile(f"{i}.json", result) for i, result in enumerate(results)])
    assert [entry.memory_bytes() for entry in machine.entries] == [8e9, 2e9]


def test_a_run_without_a_fit_time_is_shown_as_such(make_result: Any) -> None:
    (machine,) = machines([ResultFile("a.json", make_result("alpha", psnr=20.0))])
    assert dict(machine.failures) == {"alpha: fit time not measured": 1}


def test_odd_names_from_strangers_files_are_drawn_as_they_are(make_result: Any, tmp_path: Path) -> None:
    odd = make_result("alpha", 0, "bowl", "$\\broken{", "why", cpu="$\\frac{ <b>")
    _, svg = speed_accuracy_chart([ResultFile("a.json", odd)], tmp_path)
    assert "$\\broken{" in svg.read_text()
    text = to_markdown(leaderboard_table([ResultFile("a.json", odd)]), [ResultFile("a.json", odd)])
    assert "<b>" not in text


def test_the_papers_figures_stand_on_a_machine_of_their_own() -> None:
    machine = reported_machine()
    assert machine.reported
    assert "as reported" in machine.title
    by_label = {entry.label: entry.dots[0] for entry in machine.entries}
    assert by_label["splashsplat"].values == {"psnr": 20.13, "lpips": 0.0806}
    assert by_label["splashsplat"].seconds == pytest.approx(37.8 * 60)
    assert len(by_label) == 4


def test_charts_show_every_run_and_have_the_same_bytes_each_time(folder: Path, tmp_path: Path) -> None:
    sources = load_results(folder)
    png, svg = speed_accuracy_chart(sources, tmp_path / "a", with_paper=True)
    again = speed_accuracy_chart(sources, tmp_path / "b", with_paper=True)
    assert [png.read_bytes(), svg.read_bytes()] == [path.read_bytes() for path in again]
    assert image_size(png)[0] > 1000
    text = svg.read_text()
    comments = set(re.findall(r"<!-- (.*?) -->", text))
    for shown in ("✕ gamma: out_of_memory", "control: nothing", "beta", "splashsplat"):
        assert shown in comments
    assert any("test processor, 2 cores" in comment for comment in comments)
    assert any("V100" in comment for comment in comments)
    assert not re.search(r"\b20\d\d-\d\d-\d\d", text)


@pytest.mark.parametrize("status", ["ok", "crashed"])
def test_a_chart_of_one_run_or_of_failures_alone_can_be_drawn(make_result: Any, tmp_path: Path, status: str) -> None:
    values = {"psnr": 20.0, "fit_seconds": 5.0} if status == "ok" else {}
    png, _ = speed_accuracy_chart([ResultFile("a.json", make_result("alpha", 0, "bowl", status, **values))], tmp_path)
    assert image_size(png)[1] > 300


def test_the_front_is_of_methods_that_ran_on_the_same_scenes_without_failure(make_result: Any) -> None:
    """One that came through on the easy scene alone would stand before all."""
    results = [make_result("whole", 0, scene, psnr=22.0, fit_seconds=60.0) for scene in ("easy", "b", "c")]
    results.append(make_result("crasher", 0, "easy", psnr=29.0, fit_seconds=40.0))
    results += [make_result("crasher", 0, scene, "crashed", "no memory") for scene in "bc"]
    results.append(make_result("picky", 0, "easy", psnr=28.0, fit_seconds=30.0))
    (machine,) = machines([ResultFile(f"{n}.json", result) for n, result in enumerate(results)])
    assert {entry.label: entry.compares("psnr") for entry in machine.entries} == {
        "whole": True,
        "crasher": False,
        "picky": False,
    }
    assert machine.n_scenes == 3
    # A figure that one of its scenes lacks is a mean over others, too.
    whole = next(entry for entry in machine.entries if entry.label == "whole")
    del whole.dots[0].values["psnr"]
    assert not whole.compares("psnr")
    picky = next(entry for entry in machine.entries if entry.label == "picky")
    assert picky.shared is None
    assert picky.summary("psnr") is not None

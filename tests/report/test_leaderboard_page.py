"""The leaderboard's page: what it holds, that it needs nothing but itself, and how it behaves in a browser."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splashbench.cli.main import main
from splashbench.report.page import PAGE, leaderboard_page
from splashbench.report.page.content import command
from splashbench.report.results import load_results
from splashbench.report.table import leaderboard_table, to_csv
from splashbench.score.result import Result
from splashbench.score.settings import PROTOCOL_V1
from splashbench.submission import Decision, Rung

PageOf = Callable[..., str]
DataOf = Callable[[str], dict[str, Any]]
Course = Callable[..., Any]


def test_the_page_needs_nothing_but_itself_and_is_always_the_same(results: Path, page_of: PageOf) -> None:
    page = page_of(results)
    assert page == page_of(results)
    assert len(page) < 8 << 20
    # Beside the chart library, which names addresses that it never asks for here.
    own = re.sub(r"<script>/\*\*?!?.*?plotly.*?</script>", "", page, count=1, flags=re.DOTALL | re.IGNORECASE)
    assert len(own) < len(page) / 10
    assert re.findall(r"""(?:src|href)\s*=|@import|url\(|fetch\(|XMLHttpRequest|https?://""", own) == []


def test_names_from_strangers_stay_text(make_result: Any, tmp_path: Path, page_of: PageOf, data_of: DataOf) -> None:
    hostile = "</script><img src=x onerror=alert(1)>"
    make_result("alpha", scene=hostile, reason=hostile, psnr=20.0, fit_seconds=9.0).save(tmp_path / "results")
    make_result(
        "beta", scene=hostile, notes={hostile: hostile}, overrides=(f"a={hostile}",), psnr=2.0, fit_seconds=9.0
    ).save(tmp_path / "results")
    page = page_of(tmp_path / "results")
    assert "<img src=x" not in page
    assert data_of(page)["rows"][0]["scene"] == hostile


def test_decisions_are_text_and_bounded(make_result: Any, tmp_path: Path, page_of: PageOf, data_of: DataOf) -> None:
    hostile = "</script><img src=x onerror=alert(1)>\x1b[1m\n"
    rungs = [Rung(value=f"{n} {hostile}", bought=n < 2, gain=0.5, reason=hostile * 10) for n in range(40)]
    decision = Decision(name=hostile, basis="withheld", chosen=hostile, because=hostile * 10, rungs=rungs)
    make_result("alpha", decisions=[decision] * 70, psnr=20.0, fit_seconds=9.0).save(tmp_path / "results")
    page = page_of(tmp_path / "results")
    assert "<img src=x" not in page
    (run,) = data_of(page)["runs"]
    assert len(run["decisions"]) + run["decisions_left_out"] == 70
    first = run["decisions"][0]
    assert len(first["rungs"]) + first["rungs_left_out"] == 40
    assert first["header"] == ["value", "gain ± s.e.", ""]
    assert first["rungs"][0][:2] == ["0 </script><img src=x onerror=alert(1)>…", "+0.5"]
    assert first["held"] == 1
    assert len(json.dumps(run)) < 200_000
    assert all(text.isprintable() for rung in first["rungs"] for text in rung)


def test_failed_runs_and_machines_are_kept_apart(results: Path, page_of: PageOf, data_of: DataOf) -> None:
    data = data_of(page_of(results))
    assert len(data["groups"]) == 2
    here = data["groups"][1]
    assert here["machine"].startswith("test processor")
    assert here["told"] == "times"
    # It ran on one scene of two, so that its means could not be compared.
    assert here["left_out"] == ["broken"]
    assert here["shared_scenes"] == ["bowl", "tank"]
    assert "another" in data["groups"][0]["machine"]
    assert [row["status"] for row in data["rows"]].count("crashed") == 1


def test_means_are_over_scenes_that_methods_have_in_common(
    make_result: Any, tmp_path: Path, page_of: PageOf, data_of: DataOf
) -> None:
    for method, scenes in (("a", "abcd"), ("b", "abc"), ("c", "abc"), ("d", "d")):
        for scene in scenes:
            psnr = 20.0 + "abcd".index(scene) + "abcd".index(method) / 10
            make_result(method, scene=scene, psnr=psnr, fit_seconds=9.0).save(tmp_path / "results")
    make_result("a", 1, scene="a", status="timeout", reason="over 60 s").save(tmp_path / "results")
    (here,) = data_of(page_of(tmp_path / "results"))["groups"]
    assert (here["shared_scenes"], here["left_out"]) == (["a", "b", "c"], ["d"])
    figures = {label: entry["figures"]["psnr"]["value"] for label, entry in here["estimates"].items()}
    # Without the control `nothing` the run that failed cannot be charged: it is counted, and its method on no front.
    assert figures == {"a": pytest.approx(21.0), "b": pytest.approx(21.1), "c": pytest.approx(21.2)}
    assert (here["estimates"]["a"]["runs"], here["estimates"]["a"]["failed"]) == (4, 1)
    assert here["scenes"] == ["a", "b", "c", "d"]


def test_a_failed_run_has_the_quality_of_nothing(
    results: Path, make_result: Any, page_of: PageOf, data_of: DataOf
) -> None:
    next(path for path in results.glob("good__bowl__*") if "test processor" in path.read_text()).unlink()
    make_result("good", 7, scene="bowl", status="out_of_memory", reason="killed", told=("times",)).save(results)
    here = data_of(page_of(results))["groups"][-1]
    entry = here["estimates"]["good"]
    assert entry["failed"] == 1
    assert entry["figures"]["psnr"]["runs"] == 4
    # Of 12, 28 or 28.1, 29 and 29.1 dB the middle two.
    assert 28.4 < entry["figures"]["psnr"]["value"] < 28.6


def test_odd_results_do_not_stop_the_page(make_result: Any, tmp_path: Path, page_of: PageOf, data_of: DataOf) -> None:
    folder = tmp_path / "results"
    make_result("a", fit_seconds=0.0, psnr=20.0, settings={"rate": float("nan")}).save(folder)
    make_result("b", fit_seconds=9.0, psnr=21.0).save(folder)
    make_result("b", 1, scene="tank", fit_seconds=9.0).save(folder)
    make_result("constructor", scene="far", fit_seconds=9.0, psnr=3.0).save(folder)
    path = next(folder.glob("a__*"))
    path.write_text(path.read_text().replace('"rate": null', '"rate": NaN'))
    data = data_of(page_of(folder))
    assert {"rate": "NaN"} in data["settings"].values()
    assert len(data["rows"]) == 4


def test_one_submission_scored_by_two_protocols_is_two_runs(
    make_result: Any, tmp_path: Path, page_of: PageOf, data_of: DataOf
) -> None:
    first: Result = make_result("a", psnr=20.0, fit_seconds=9.0)
    changed = PROTOCOL_V1.model_copy(update={"opacity_threshold": 0.3})
    digests = first.digests.model_copy(update={"protocol": changed.digest})
    metrics = {**first.metrics, "psnr": first.metrics["psnr"].model_copy(update={"value": 30.0})}
    first.save(tmp_path / "results")
    second = first.model_copy(update={"protocol": changed, "digests": digests, "metrics": metrics})
    second.save(tmp_path / "results")
    data = data_of(page_of(tmp_path / "results"))
    for row in data["rows"]:
        (number,) = row["runs"]
        assert data["runs"][number]["figures"]["psnr"] == row["cells"]["psnr"][0]
        assert data["runs"][number]["group"] == row["group"]


def test_what_scenes_told_is_never_mixed_in_a_row(
    make_result: Any, tmp_path: Path, page_of: PageOf, data_of: DataOf
) -> None:
    make_result("a", 0, psnr=20.0, told=None).save(tmp_path / "results")
    make_result("a", 1, psnr=22.0, told=("times", "gravity")).save(tmp_path / "results")
    rows = data_of(page_of(tmp_path / "results"))["rows"]
    assert {(row["told"], row["cells"]["psnr"][0]) for row in rows} == {("not noted", 20.0), ("times, gravity", 22.0)}


def test_who_leads_when(results: Path, page_of: PageOf, data_of: DataOf) -> None:
    here = data_of(page_of(results))["groups"][1]
    leaders = {s["seconds"]: [place["label"] for place in s["ranking"]] for s in here["standings"]["psnr"]}
    # At 10 s `good` has 15 dB and `fast` is done; `slow` begins at 41 s.
    assert leaders == {10: ["fast", "good"], 60: ["good", "fast", "slow"], 300: ["good", "slow", "fast"]}
    at_ten = here["standings"]["psnr"][0]
    assert at_ten["ranking"][0]["value"] == pytest.approx(22.55)
    assert at_ten["lead"]["difference"]["value"] == pytest.approx(7.55)
    assert at_ten["lead"]["scenes"] == 2
    assert at_ten["lead"]["probability"] is None


def test_curves_begin_where_every_run_has_a_value(results: Path, page_of: PageOf, data_of: DataOf) -> None:
    here = data_of(page_of(results))["groups"][1]
    curves = {curve["label"]: curve for curve in here["curves"]["psnr"]}
    # `nothing` was run on both scenes, so that each curve begins with what it shows.
    assert curves["slow"]["y"][0] == pytest.approx(12.0)
    assert curves["slow"]["y"][-1] == pytest.approx(26.55)
    assert curves["good"]["x"][-1] == 80
    assert "broken" not in curves


def test_without_the_control_nothing_a_curve_begins_later(results: Path, page_of: PageOf, data_of: DataOf) -> None:
    for path in results.glob("nothing__*"):
        path.unlink()
    here = data_of(page_of(results))["groups"][1]
    slow = next(curve for curve in here["curves"]["psnr"] if curve["label"] == "slow")
    assert slow["x"][0] >= 41


def test_the_time_to_the_others_quality_charges_failures(results: Path, page_of: PageOf, data_of: DataOf) -> None:
    here = data_of(page_of(results))["groups"][1]
    chases = {(chase["label"], chase["target"]): chase for chase in here["chases"]["psnr"]}
    # `good` passes the 22.05 dB that `fast` ends with on the first scene at 11 s: 11 of 9 seconds.
    assert chases["good", "fast"]["ratio"] == pytest.approx(11 / 9, rel=1e-3)
    assert chases["fast", "good"]["ratio"] is None
    assert chases["fast", "good"]["reached"] == 0
    assert chases["broken", "fast"]["ratio"] is None


def test_the_command_makes_the_run_again(make_result: Any, course: Course) -> None:
    result: Result = make_result("alpha", 3, "my bowl", overrides=("a=1", "b=x y"), checkpoints=course((5.0, 20.0)))
    assert command(result) == (
        "splashbench run alpha 'scenes/my bowl' OUT --preset best --seed 3 --device cpu --checkpoints "
        "--set a=1 --set 'b=x y'"
    )
    assert "--device cuda" in command(result.model_copy(update={"hardware": {"gpu": "NVIDIA Example"}}))


def test_an_external_code_has_its_own_command(make_result: Any) -> None:
    settings = {"format": "blender", "command": "train {scene} {out}", "importer": "scaffold_4d", "points": 2000}
    result: Result = make_result("theirs", 2, "bowl", settings=settings)
    assert command(result) == (
        "splashbench run-external scenes/bowl OUT --name theirs --seed 2 --format blender "
        "--command 'train {scene} {out}' --import scaffold_4d"
    )


def test_pictures_are_embedded_where_they_lie_beside_results(results: Path, tmp_path: Path, data_of: DataOf) -> None:
    from splashbench.files import write_image

    sources = load_results(results)
    first, second = (results / source.path for source in sources[:2])
    write_image(first.with_suffix(".jpg"), np.full((40, 60, 3), 90, np.uint8))
    second.with_suffix(".jpg").write_bytes(b"<svg onload=alert(1)>")
    assert main(["leaderboard", str(results), str(tmp_path / "board")]) == 0
    data = data_of((tmp_path / "board" / PAGE).read_text())
    sheets = {run["file"]: run["sheet"] for run in data["runs"]}
    assert sheets[first.name].startswith("data:image/jpeg;base64,")
    assert sheets[second.name] is None


def test_the_committed_page_is_what_its_results_give(data_of: DataOf) -> None:
    folder = Path(__file__).parents[2] / "leaderboards" / "told_nothing"
    if not folder.is_dir():
        pytest.skip("the page of the project's runs lies in its repository alone")
    sources = load_results(folder / "results")
    table = leaderboard_table(sources)
    assert (folder / "leaderboard.csv").read_text(encoding="utf-8") == to_csv(table), "run `make leaderboard`"
    committed = data_of((folder / PAGE).read_text(encoding="utf-8"))
    made = data_of(leaderboard_page(table, sources))
    # Figures are rounded to six digits; another numpy may differ in the last.
    for kept, new in zip(committed["groups"], made["groups"], strict=True):
        assert kept["shared_scenes"] == new["shared_scenes"]
        for label, entry in new["estimates"].items():
            for name, found in entry["figures"].items():
                assert kept["estimates"][label]["figures"][name]["value"] == pytest.approx(found["value"], rel=1e-4)
    assert len(committed["runs"]) == len(made["runs"]) == len(sources)
    assert any(run["sheet"] for run in committed["runs"])


def test_a_run_that_failed_on_another_machine_than_nothing_is_charged_as_well(
    make_result: Any, tmp_path: Path, page_of: PageOf, data_of: DataOf
) -> None:
    """`nothing` needs no GPU: what it shows of a scene is the same for whoever ran on one."""
    for seed in range(4):
        failed = {"status": "crashed", "reason": "no memory"} if seed == 3 else {"psnr": 25.0, "fit_seconds": 9.0}
        make_result("m", seed, cpu="a GPU", **failed).save(tmp_path / "results")
        make_result("o", seed, cpu="a GPU", psnr=22.0, fit_seconds=9.0).save(tmp_path / "results")
    make_result("nothing", 0, control=True, psnr=10.0, fit_seconds=3.0).save(tmp_path / "results")
    here = next(g for g in data_of(page_of(tmp_path / "results"))["groups"] if "a GPU" in g["machine"])
    after = next(standing for standing in here["standings"]["psnr"] if standing["seconds"] == 60)
    assert [row["label"] for row in after["ranking"]] == ["m", "o"]
    assert here["estimates"]["m"]["figures"]["psnr"] == {"value": 25.0, "interval": None, "runs": 4}


def test_a_figure_says_how_many_of_the_runs_it_is_of(
    make_result: Any, tmp_path: Path, page_of: PageOf, data_of: DataOf
) -> None:
    figures = {"psnr": 28.0, "dpsnr_bg": 12.0, "ssim": 0.99, "jitter_error": 0.01, "fit_seconds": 9.0}
    make_result("m", 0, **figures).save(tmp_path / "results")
    for seed in (1, 2, 3):
        make_result("m", seed, status="crashed", reason="no memory").save(tmp_path / "results")
    make_result("nothing", 0, control=True, psnr=10.0, ssim=0.5, fit_seconds=3.0).save(tmp_path / "results")
    (here,) = data_of(page_of(tmp_path / "results"))["groups"]
    found = here["estimates"]["m"]["figures"]
    assert [(found[name]["value"], found[name]["runs"]) for name in ("psnr", "ssim", "dpsnr_bg")] == [
        (10.0, 4),
        (0.5, 4),
        (0.0, 4),
    ]
    # What `nothing` does not have cannot be charged, nor can a cost.
    assert [found[name]["runs"] for name in ("jitter_error", "fit_seconds")] == [1, 1]

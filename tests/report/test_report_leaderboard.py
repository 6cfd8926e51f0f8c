"""The leaderboard: failures keep their rows, seeds are summarised, the same results give the same bytes."""

import csv
import io
from pathlib import Path
from typing import Any

import pytest

from splashbench.errors import SplashbenchError
from splashbench.report.leaderboard import write_leaderboard
from splashbench.report.results import ResultFile, load_results
from splashbench.report.table import CSV_COLUMNS, leaderboard_table, to_csv
from splashbench.report.table_markdown import to_markdown


def _table(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(to_csv(leaderboard_table(load_results(folder))))))


def test_columns_begin_with_the_names_of_the_schema() -> None:
    assert CSV_COLUMNS[:8] == ("method", "scene", "seed", "preset", "status", "reason", "psnr", "dpsnr_bg")
    assert len(set(CSV_COLUMNS)) == len(CSV_COLUMNS)


def test_rows_are_medians_over_seeds_sorted_by_scene_then_lpips(folder: Path) -> None:
    rows = _table(folder)
    assert [(row["scene"], row["method"]) for row in rows] == [
        ("bowl", "oracle"),
        ("bowl", "alpha"),
        ("bowl", "beta"),
        ("bowl", "nothing"),
        ("bowl", "gamma"),
        ("tank", "oracle"),
        ("tank", "alpha"),
        ("tank", "beta"),
        ("tank", "nothing"),
    ]
    alpha = rows[1]
    assert (alpha["seed"], alpha["runs"]) == ("0 1 2", "3")
    assert (alpha["psnr"], alpha["psnr_spread"]) == ("19.90", "0.20")
    assert alpha["sigma_d"] == ""
    assert rows[0]["psnr_spread"] == ""


def test_failures_keep_their_rows_and_reasons(folder: Path) -> None:
    failed = [row for row in _table(folder) if row["status"] != "ok"]
    assert [(row["method"], row["status"], row["psnr"]) for row in failed] == [("gamma", "out_of_memory", "")]
    assert failed[0]["reason"] == "killed (signal 9) | of 8 GiB"
    sources = load_results(folder)
    text = to_markdown(leaderboard_table(sources), sources)
    assert "| gamma | best | 0 | out_of_memory |" in text
    assert "- gamma (best, seed 0) on bowl: out_of_memory: killed (signal 9)" in text


def test_a_seed_that_fails_is_not_averaged_away(folder: Path, make_result: Any) -> None:
    make_result("alpha", 7, "bowl", "crashed", "NaN in the loss").save(folder)
    rows = [row for row in _table(folder) if (row["scene"], row["method"]) == ("bowl", "alpha")]
    assert [(row["seed"], row["status"]) for row in rows] == [("0 1 2", "ok"), ("7", "crashed")]


def test_controls_are_marked_and_never_best(folder: Path) -> None:
    sources = load_results(folder)
    text = to_markdown(leaderboard_table(sources), sources)
    assert "| *oracle* |" in text
    assert "**100.00**" not in text
    assert "**19.90** ± 0.10" in text
    assert {row["method"]: row["control"] for row in _table(folder)}["nothing"] == "true"


def test_a_low_sigma_d_is_not_best_since_a_smaller_cloud_has_it_too(make_result: Any) -> None:
    sources = [
        ResultFile(f"{name}.json", make_result(name, sigma_d=sigma, uniformity=sigma / 10))
        for name, sigma in (("alpha", 20.0), ("beta", 30.0))
    ]
    line = next(s for s in to_markdown(leaderboard_table(sources), sources).splitlines() if s.startswith("| alpha"))
    assert "**2.000**" in line
    assert "| 20.0 |" in line


def test_without_lpips_the_higher_psnr_comes_first(make_result: Any) -> None:
    results = [make_result(name, psnr=psnr) for name, psnr in (("alpha", 19.0), ("beta", 21.0))]
    table = leaderboard_table([ResultFile(f"{i}.json", result) for i, result in enumerate(results)])
    assert list(table["method"]) == ["beta", "alpha"]


def test_presets_of_rows_that_would_look_alike_name_their_settings(make_result: Any) -> None:
    results = [
        make_result("alpha", 0, psnr=20.0),
        make_result("alpha", 0, psnr=21.0, settings={"grid": 48}),
        make_result("beta", 0, psnr=19.0),
    ]
    sources = [ResultFile(f"{i}.json", result) for i, result in enumerate(results)]
    lines = to_markdown(leaderboard_table(sources), sources).splitlines()
    presets = [line.split(" | ")[1] for line in lines if line.startswith(("| alpha", "| beta"))]
    assert presets == [f"best ({results[1].settings_digest})", f"best ({results[0].settings_digest})", "best"]


def test_means_over_scenes_leave_out_methods_that_failed_on_one(folder: Path, make_result: Any) -> None:
    def means() -> dict[str, str]:
        sources = load_results(folder)
        text = to_markdown(leaderboard_table(sources), sources)
        section = text.partition("## Mean over 2 scenes")[2].partition("## Hardware")[0]
        lines = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("| ")]
        return {line[0]: line[3] for line in lines}

    assert means()["alpha"] == "19.55"
    assert means()["gamma"] == "–"
    make_result("alpha", 7, "tank", "timeout", "over 60 s").save(folder)
    assert means()["alpha"] == "–"


def _write(folder: Path, out: Path) -> list[Path]:
    sources = load_results(folder)
    return write_leaderboard(leaderboard_table(sources), sources, out)


def test_bytes_do_not_depend_on_where_or_in_which_order_results_lie(folder: Path, tmp_path: Path) -> None:
    first = [path.read_bytes() for path in _write(folder, tmp_path / "a")]
    again = [path.read_bytes() for path in _write(folder, tmp_path / "b")]
    assert first == again
    for i, path in enumerate(sorted(folder.glob("*.json"), reverse=True)):
        (tmp_path / "moved" / str(i)).mkdir(parents=True)
        (tmp_path / "moved" / str(i) / "result.json").write_bytes(path.read_bytes())
    assert to_csv(leaderboard_table(load_results(tmp_path / "moved"))).encode() == first[0]


def test_runs_with_other_settings_hardware_or_protocol_are_never_averaged(make_result: Any) -> None:
    results = [
        make_result("alpha", 0, psnr=10.0),
        make_result("alpha", 1, psnr=20.0, settings={"iterations": 5}),
        make_result("alpha", 2, psnr=30.0, cpu="another processor"),
        make_result("alpha", 3, psnr=40.0, method_version="2"),
    ]
    table = leaderboard_table([ResultFile(f"{i}.json", result) for i, result in enumerate(results)])
    assert list(table["psnr"]) == [40.0, 30.0, 20.0, 10.0]
    assert list(table["runs"]) == [1] * 4


def test_the_better_informed_of_two_scores_of_one_submission_stands(tmp_path: Path, make_result: Any) -> None:
    make_result("alpha", psnr=20.0, lpips=0.1).save(tmp_path / "with")
    make_result("alpha", psnr=20.0).save(tmp_path / "without")
    sources = load_results(tmp_path)
    assert [source.path.split("/")[0] for source in sources] == ["with"]


def test_an_old_and_a_new_run_are_no_spread_over_seeds(tmp_path: Path, make_result: Any) -> None:
    old = make_result("alpha", 0, psnr=20.0)
    new = old.model_copy(update={"digests": old.digests.model_copy(update={"submission": "f" * 64})})
    for result in (old, new):
        result.save(tmp_path)
    with pytest.raises(SplashbenchError, match="two runs of alpha with one seed and the same settings"):
        load_results(tmp_path)


def test_a_submission_given_for_results_is_told(tmp_path: Path) -> None:
    (tmp_path / "submission.toml").touch()
    with pytest.raises(SplashbenchError, match="is a submission, not results; score it first"):
        load_results(tmp_path)


def test_sources_and_claims_are_listed(make_result: Any) -> None:
    result = make_result("alpha", psnr=20.0, claimed={"psnr": 35.0})
    source = ResultFile("deep/alpha.json", result)
    text = to_markdown(leaderboard_table([source]), [source])
    assert "psnr: claimed 35, verified 20.00" in text
    assert f"| deep/alpha.json | `{result.digests.scene[:12]}` | `{result.digests.submission[:12]}` |" in text


def test_a_file_that_is_no_result_is_named(folder: Path, tmp_path: Path) -> None:
    (folder / "notes.json").write_text('{"psnr": 99}')
    with pytest.raises(SplashbenchError, match=r"notes.json: "):
        load_results(folder)
    with pytest.raises(SplashbenchError, match="holds no results"):
        load_results(tmp_path / "empty")


def test_means_mix_neither_settings_nor_what_scenes_told(make_result: Any) -> None:
    results = [
        make_result("m", 0, "a", psnr=10.0, told=None),
        make_result("m", 1, "a", psnr=10.0, told=("times",)),
        make_result("m", 1, "b", psnr=40.0, told=("times",)),
        *(
            make_result("n", 0, scene, psnr=20.0 + size, told=("times",), settings={"size": size})
            for scene in "ab"
            for size in (5, 10)
        ),
    ]
    sources = [ResultFile(f"{n}.json", result) for n, result in enumerate(results)]
    means = to_markdown(leaderboard_table(sources), sources).partition("## Mean over 2 scenes")[2].partition("##")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in means.splitlines() if "of 2" in line]
    assert sorted((row[0], row[2], row[3], row[4]) for row in rows) == [
        ("m", "1 of 2", "not noted", "–"),
        ("m", "2 of 2", "times", "25.00"),
        ("n", "2 of 2", "times", "25.00"),
        ("n", "2 of 2", "times", "30.00"),
    ]
    assert len({row[1] for row in rows if row[0] == "n"}) == 2


def test_a_figure_that_one_seed_lacks_is_told(make_result: Any) -> None:
    results = [make_result("m", 0, psnr=20.0, lpips=0.1), make_result("m", 1, psnr=20.0)]
    sources = [ResultFile(f"{n}.json", result) for n, result in enumerate(results)]
    told = to_markdown(leaderboard_table(sources), sources).partition("## Why a figure is missing")[2]
    assert "(m, seed 1 on " in next(line for line in told.splitlines() if line.startswith("- lpips: "))


def test_figures_against_two_truths_are_not_averaged(make_result: Any) -> None:
    results = [make_result("m", seed, psnr=20.0, sdf_iou=iou) for seed, iou in enumerate((0.9, 0.3))]
    results = [
        result.model_copy(update={"digests": result.digests.model_copy(update={"truth": str(n) * 64})})
        for n, result in enumerate(results)
    ]
    sources = [ResultFile(f"{n}.json", result) for n, result in enumerate(results)]
    table = leaderboard_table(sources)
    assert table["psnr"].tolist() == [20.0]
    assert table["sdf_iou"].isna().all()
    assert "different true particles" in to_markdown(table, sources)

"""The leaderboard with figures against true particles, and with results from before there were any."""

import csv
import io
import json
from pathlib import Path
from typing import Any

from splashbench.report.results import load_results
from splashbench.report.table import CSV_COLUMNS, leaderboard_table, to_csv
from splashbench.report.table_markdown import to_markdown
from splashbench.score.metrics import TRUTH_METRICS
from splashbench.score.result import Result


def test_figures_against_the_truth_stand_at_the_end_and_in_a_table_of_their_own(
    tmp_path: Path, make_result: Any
) -> None:
    for seed in (0, 1):
        make_result("alpha", seed, psnr=20.0, sdf_iou=0.6 + 0.1 * seed, velocity_epe_relative=0.5).save(tmp_path)
    make_result("beta", 0, psnr=19.0).save(tmp_path)
    sources = load_results(tmp_path)
    rows = leaderboard_table(sources)
    assert CSV_COLUMNS[-16:] == (*TRUTH_METRICS, *(f"{name}_spread" for name in TRUTH_METRICS))
    alpha, beta = csv.DictReader(io.StringIO(to_csv(rows)))
    assert (alpha["sdf_iou"], alpha["sdf_iou_spread"], beta["sdf_iou"]) == ("0.6500", "0.1000", "")
    text = to_markdown(rows, sources)
    table = text[text.index("Against the true particles:") :].split("\n\n")[1].splitlines()
    assert len(table) == 3
    assert "0.6500 ± 0.0500" in table[2]


def test_results_from_before_there_was_a_truth_are_read_and_stand_in_the_same_table(
    tmp_path: Path, make_result: Any
) -> None:
    path = make_result("alpha", 0, psnr=20.0).save(tmp_path)
    data = json.loads(path.read_text())
    for name in TRUTH_METRICS:
        del data["metrics"][name]
    del data["digests"]["truth"]
    path.write_text(json.dumps(data))
    make_result("beta", 0, psnr=19.0).save(tmp_path)
    old = Result.load(path)
    assert old.value("sdf_iou") is None
    assert old.digests.truth is None
    sources = load_results(tmp_path)
    text = to_markdown(leaderboard_table(sources), sources)
    assert text.count("## bowl (protocol v1") == 1
    assert "Against the true particles" not in text
    assert "sdf_iou" not in text

"""Results to the leaderboard's table: a row is a method with its settings on one scene, over all seeds.

A figure is the median over seeds, with the spread (largest - smallest) beside it. A run that failed keeps a row of its
own with its status; nothing is dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pandas as pd

from splashbench.csv_cells import csv_text
from splashbench.report.groups import told_text
from splashbench.report.results import ResultFile
from splashbench.score.metrics import METRICS, TRUTH_METRICS
from splashbench.score.notation import stored
from splashbench.score.result import Result
from splashbench.score.verification import Verification

_FIGURES = tuple(name for name in METRICS if name not in TRUTH_METRICS)
_SPREAD = tuple(name for name in _FIGURES if METRICS[name].group != "cost" or name == "fit_seconds")
CSV_COLUMNS = (
    *("method", "scene", "seed", "preset", "status", "reason"),
    *_FIGURES,
    *("control", "mixed", "runs"),
    *(f"{name}_spread" for name in _SPREAD),
    *("method_version", "settings_digest", "protocol", "scene_digest", "hardware"),
    *TRUTH_METRICS,
    *(f"{name}_spread" for name in TRUTH_METRICS),
)
#: Of a leaderboard whose results were scored again.
VERIFIED_COLUMNS = ("verified", "stated_otherwise")
# Text of a CSV: what strangers wrote, and what is made of it.
_TEXT_COLUMNS = (
    *("method", "scene", "seed", "preset", "status", "reason", "method_version", "settings_digest", "protocol"),
    *("scene_digest", "hardware", *VERIFIED_COLUMNS),
)
#: What rows must share to stand in one table of the Markdown: scene, its exact bytes, and protocol.
SCENE_COLUMNS = ["scene", "scene_digest", "protocol"]
#: What names a method besides: figures of rows that differ in any of these are never averaged.
METHOD_COLUMNS = ["method", "preset", "settings_digest", "hardware"]
# Failed runs never share a row: each has its own submission here, where all others have "".
_ROW_COLUMNS = [*SCENE_COLUMNS, *METHOD_COLUMNS, "told", "failed_submission"]
_SHARED_COLUMNS = ["status", "reason", "failed", "control", "mixed", "method_version"]


def leaderboard_table(sources: Sequence[ResultFile]) -> pd.DataFrame:
    """The rows, by scene, then protocol, then LPIPS (lower first), then PSNR (higher first); failures last.

    Columns: those of the CSV, with figures as floats and NaN for none; every metric has its spread, NaN for one run.
    `failed` says whether a row is a failed run, and `results` holds the row's results in the order of their seeds.
    `verified` and `stated_otherwise` say in words what scoring the submissions again gave; "" where nobody asked.
    `truths` is the number of different truths that a row was scored against; more than one has no figures of them.
    """
    runs = pd.DataFrame([{**_run(source.result), "verification": source.verification} for source in sources])
    names = list(METRICS)
    runs[names] = runs[names].astype(float)
    groups = runs.sort_values(["seed", "submission"]).groupby(_ROW_COLUMNS, sort=False)
    figures = groups[names]
    rows = (
        groups[_SHARED_COLUMNS]
        .first()
        .join(
            [
                groups.agg(
                    seed=("seed", _joined),
                    runs=("seed", "size"),
                    results=("result", list),
                    verifications=("verification", list),
                    truths=("truth", "nunique"),
                ),
                figures.median(),
                (figures.max() - figures.min()).where(figures.count() > 1).add_suffix("_spread"),
            ]
        )
    )
    against_truth = [name + end for name in TRUTH_METRICS for end in ("", "_spread")]
    rows.loc[rows["truths"] > 1, against_truth] = float("nan")
    rows["verified"] = rows["verifications"].map(_verdict)
    rows["stated_otherwise"] = rows["verifications"].map(_stated_otherwise)
    ranking = [*SCENE_COLUMNS, "failed", "lpips", "psnr", *METHOD_COLUMNS, "told", "failed_submission"]
    ascending = [column != "psnr" for column in ranking]
    return rows.reset_index().sort_values(ranking, ascending=ascending, ignore_index=True)


def _run(result: Result) -> dict[str, Any]:
    failed = result.status != "ok"
    return {
        "scene": result.scene,
        "scene_digest": result.digests.scene,
        "protocol": result.protocol_label,
        "method": result.method,
        "preset": result.preset,
        "settings_digest": result.settings_digest,
        "hardware": result.hardware_label,
        "told": told_text(result.told),
        "failed_submission": result.digests.submission if failed else "",
        "status": result.status,
        "reason": result.reason,
        "failed": failed,
        "control": result.control,
        "mixed": result.mixed,
        "method_version": result.method_version,
        "seed": result.seed,
        "submission": result.digests.submission,
        "truth": result.digests.truth,
        "result": result,
        **{name: result.value(name) for name in METRICS},
    }


def _verdict(verifications: Sequence[Verification | None]) -> str:
    """One word for a row: the same verdict for all of its runs, or how many of them have which."""
    verdicts = [verification.verdict for verification in verifications if verification is not None]
    if len(set(verdicts)) <= 1:
        return verdicts[0] if verdicts else ""
    return ", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in sorted(set(verdicts)))


def _stated_otherwise(verifications: Sequence[Verification | None]) -> str:
    found = dict.fromkeys(str(different) for each in verifications if each for different in each.differences)
    return "; ".join(found)


def _joined(seeds: pd.Series) -> str:
    return " ".join(map(str, seeds))


def to_csv(table: pd.DataFrame) -> str:
    """The leaderboard as CSV; the bytes depend on nothing but the results."""
    text = table.copy()
    for name in METRICS:
        for column in (name, f"{name}_spread"):
            text[column] = [stored(name, value) for value in table[column]]
    for column in ("control", "mixed"):
        text[column] = table[column].map({True: "true", False: "false"})
    for column in _TEXT_COLUMNS:
        text[column] = table[column].map(csv_text)
    columns = [*CSV_COLUMNS, *(VERIFIED_COLUMNS if (table["verified"] != "").any() else ())]
    return str(text.to_csv(columns=columns, index=False, lineterminator="\n"))

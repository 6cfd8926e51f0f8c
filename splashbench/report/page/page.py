"""leaderboard: index.html, one file that needs no network: data, script, style and the chart library are in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from splashbench.pages import render
from splashbench.report.anytime import BUDGETS, MAX_DRAWN, QUALITY
from splashbench.report.groups import groups
from splashbench.report.page.content import (
    COSTS,
    QUALITIES,
    TABLE,
    distinct_settings,
    group_facts,
    metric_facts,
    row_facts,
    run_facts,
    verification_facts,
)
from splashbench.report.results import LeftOut, ResultFile
from splashbench.report.speed_accuracy import reported_machine

PAGE = "index.html"
_HERE = Path(__file__).parent


def leaderboard_page(
    table: pd.DataFrame,
    sources: Sequence[ResultFile],
    with_paper: bool = False,
    sheets: Mapping[str, str] | None = None,
    left_out: Sequence[LeftOut] = (),
) -> str:
    """The page as text; the same results give the same bytes.

    Args:
        table: from `leaderboard_table(sources)`.
        with_paper: the paper's figures, hollow and in a group of their own.
        sheets: contact sheets by the path of a result's file: an address, such as one that holds the picture.
        left_out: files that could not be used, which are named.
    """
    from plotly.offline import get_plotlyjs

    found = groups(sources)
    # Not by digests: one submission may have been scored by two protocols.
    place = {
        id(result): (n, entry.label)
        for n, group in enumerate(found)
        for entry in (*group.entries, *group.controls)
        for result in entry.results
    }
    scenes = [group.scenes for group in found]
    runs = []
    for source in sources:
        n, label = place[id(source.result)]
        facts = run_facts(source.result, n, label, scenes[n][source.result.digests.scene], source.path)
        runs.append(facts | verification_facts(source.verification))
    for run in runs:
        run["sheet"] = (sheets or {}).get(run["file"])
    number = {id(source.result): n for n, source in enumerate(sources)}
    rows = [
        row_facts(row, *place[id(row["results"][0])], [number[id(result)] for result in row["results"]])
        for _, row in table.iterrows()
    ]
    data = {
        "metrics": metric_facts(),
        "columns": list(TABLE),
        "costs": list(COSTS),
        "qualities": list(QUALITIES),
        "budgets": list(BUDGETS),
        "drawn": MAX_DRAWN,
        "quality": list(QUALITY),
        "groups": [group_facts(group) for group in found],
        "runs": runs,
        "rows": rows,
        "settings": distinct_settings(source.result for source in sources),
        "paper": _paper() if with_paper else None,
    }
    content = {"data": data, "plotly": get_plotlyjs(), "counts": _counts(table, sources), "left_out": left_out}
    return render(_HERE, "leaderboard.html.j2", **content)


def _counts(table: pd.DataFrame, sources: Sequence[ResultFile]) -> dict[str, int]:
    return {
        "results": len(sources),
        "rows": len(table),
        "failed": sum(source.result.status != "ok" for source in sources),
        "scenes": len({source.result.digests.scene for source in sources}),
        "methods": len({source.result.method for source in sources if not source.result.control}),
    }


def _paper() -> dict[str, Any]:
    reported = reported_machine()
    return {
        "title": reported.title,
        "entries": [
            {"label": entry.label, "seconds": dot.seconds, "memory": dot.memory_bytes, **dot.values}
            for entry in reported.entries
            for dot in entry.dots
        ],
    }

"""The leaderboard's two files: CSV for programs, Markdown for people."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from splashbench.files import write_text
from splashbench.report.results import LeftOut, ResultFile
from splashbench.report.table import to_csv
from splashbench.report.table_markdown import to_markdown


def write_leaderboard(
    table: pd.DataFrame,
    sources: Sequence[ResultFile],
    out: Path,
    with_paper: bool = False,
    left_out: Sequence[LeftOut] = (),
) -> list[Path]:
    """Write leaderboard.csv and leaderboard.md into the folder `out`; returns their paths.

    Args:
        table: from `leaderboard_table(sources)`.
        with_paper: below a scene's table in the Markdown, what the paper reports for that scene. The CSV never has it.
        left_out: files that could not be used; the Markdown names them.
    """
    paths = [Path(out, "leaderboard.csv"), Path(out, "leaderboard.md")]
    for path, text in zip(paths, (to_csv(table), to_markdown(table, sources, with_paper, left_out))):
        write_text(path, text)
    return paths

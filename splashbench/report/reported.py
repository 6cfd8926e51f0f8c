"""The paper's own figures for one scene, to stand below a leaderboard's table and never in it.

Only NeuroFluid's scenes have figures of their own there (Tables 3 and S4); of real scenes it prints means.
"""

from __future__ import annotations

from splashbench.score.metrics import METRICS, format_value

_FIGURES = ("psnr", "ssim", "lpips", "jitter_error")


def reported_table(scene: str) -> tuple[str, list[list[str]]] | None:
    """What to say above the table, and its lines with their head; None for a scene of which the paper prints nothing.

    Scenes are known by name, in upper or lower case: downloads differ in that.
    """
    from splashbench.paper_figures import paper_rows

    rows = [row for row in paper_rows() if row["scene_set"] == scene.lower()]
    if not rows:
        return None
    title = f"As the paper reports it ({rows[0]['source']}), by its own unpublished scorer and not by this protocol:"
    lines = [["Method", *(METRICS[name].label for name in _FIGURES)], ["---", *["---:"] * len(_FIGURES)]]
    for row in rows:
        values = (row[name] for name in _FIGURES)
        cells = [format_value(n, v if isinstance(v, float) else None, "–") for n, v in zip(_FIGURES, values)]
        lines.append([str(row["method"]), *cells])
    return title, lines

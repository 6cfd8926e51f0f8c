"""The paper's figures for one scene, below a leaderboard's table and never in it.

The paper gives figures scene by scene only for NeuroFluid's scenes (Tables 3 and S4); of real scenes it gives means.
"""

from __future__ import annotations

from splashbench.markdown import table
from splashbench.score.metrics import METRICS
from splashbench.score.notation import label, shown

_FIGURES = [METRICS[name] for name in ("psnr", "ssim", "lpips", "jitter_error")]


def has_reported_figures(scene: str) -> bool:
    """Whether the paper prints figures of this very scene."""
    from splashbench.paper_figures import paper_rows

    return any(row["scene_set"] == scene.lower() for row in paper_rows())


def reported_table(scene: str) -> list[str]:
    """A line of introduction and the table, in Markdown; nothing for a scene of which the paper prints nothing.

    Scenes are matched by name whatever its case, which differs between downloads.
    """
    from splashbench.paper_figures import paper_rows

    rows = [row for row in paper_rows() if row["scene_set"] == scene.lower()]
    if not rows:
        return []
    figures = {
        label(metric): [shown(metric, value if isinstance(value := row[metric.name], float) else None) for row in rows]
        for metric in _FIGURES
    }
    return [
        f"As the paper reports it ({rows[0]['source']}), by its own unpublished scorer and not by this protocol:",
        table({"Method": [str(row["method"]) for row in rows], **figures}, right=figures),
    ]

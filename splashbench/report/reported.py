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
    return bool(_rows(scene))


def reported_table(scene: str) -> list[str]:
    """A line of introduction and the table, in Markdown; nothing for a scene of which the paper prints nothing."""
    rows = _rows(scene)
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


def _rows(scene: str) -> list[dict[str, str | float | None]]:
    """The paper's rows of `scene`, by its name whatever the case, which differs between downloads."""
    from splashbench.paper_figures import paper_rows

    return [row for row in paper_rows() if row["scene_set"] == scene.lower()]

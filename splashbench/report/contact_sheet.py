"""A contact sheet: ground truth, renders and foreground opacity of several submissions side by side.

Metrics can hide haze outside the silhouette and missing liquid; the images show both.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill, shorten
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from splashbench.files import atomic_path
from splashbench.scene import Scene
from splashbench.score.notation import FILTER_MARK, FILTER_NOTE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_CELL_INCHES = 2.0
_CELL_PIXELS = 600
_REASON_CHARACTERS = 140
_OUTLINE = "#E69F00"


def contact_sheet(scene: Scene, submissions: Sequence[Any], out_png: Path, times: Sequence[int] | None = None) -> Path:
    """Draw the sheet: a column per test view and time, a row for the truth and two per submission; returns `out_png`.

    Args:
        submissions: verified submissions of `scene`; one that failed shows its status.
        times: timesteps to show; three spread over the frames with liquid by default.
    """
    import matplotlib
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    chosen = list(times) if times is not None else spread_times(scene)
    columns = [(camera, t) for camera in scene.test for t in chosen]
    ratios = [1.0] + [ratio for s in submissions for ratio in ((1.0, 1.0) if _ok(s) else (0.25,))]
    aspect = float(np.mean([scene.cameras[name].height / scene.cameras[name].width for name in scene.test]))
    size = (_CELL_INCHES * len(columns) + 1.2, (_CELL_INCHES * aspect + 0.08) * sum(ratios) + 0.7)
    # The names come from strangers' files; a "$" in one is no formula.
    with matplotlib.rc_context({"font.family": "DejaVu Sans", "font.size": 8, "text.parse_math": False}):
        tight = ConstrainedLayoutEngine(w_pad=0.02, h_pad=0.02, wspace=0.01, hspace=0.01)
        figure = Figure(figsize=size, layout=tight)
        grid = figure.subplots(len(ratios), len(columns), squeeze=False, gridspec_kw={"height_ratios": ratios})
        figure.suptitle(f"{scene.name}: test views; orange: outline of the true liquid", x=0.01, ha="left", fontsize=10)
        for column, (camera, t) in enumerate(columns):
            truth, mask = scene.image(camera, t), scene.mask(camera, t)
            grid[0, column].set_title(f"view {camera}, {_moment(scene, t)}", fontsize=8)
            _show(grid[0, column], truth, None)
            row = 1
            for submission in submissions:
                if not _ok(submission):
                    grid[row, column].set_axis_off()
                    row += 1
                    continue
                _show(grid[row, column], submission.rendering(camera, t), None)
                _show(grid[row + 1, column], submission.alpha(camera, t), mask)
                row += 2
        _label_rows(grid, submissions)
        if any(_ok(submission) and submission.identity.mixed for submission in submissions):
            figure.supxlabel(fill(FILTER_NOTE, int(17 * size[0])), x=0.01, ha="left", fontsize=7, color="#666666")
        with atomic_path(Path(out_png)) as temporary:
            figure.savefig(temporary, format="png", dpi=150, facecolor="white", metadata={"Software": None})
    return Path(out_png)


def _ok(submission: Any) -> bool:
    return getattr(submission.status, "value", submission.status) == "ok"


def spread_times(scene: Scene) -> list[int]:
    """Early, middle and last of the frames in which the first test view sees liquid."""
    wet = [t for t in range(scene.n_frames) if scene.mask(scene.test[0], t).any()] or list(range(scene.n_frames))
    return sorted({wet[round(share * (len(wet) - 1))] for share in (0.2, 0.6, 1.0)})


def _moment(scene: Scene, t: int) -> str:
    seconds = "" if scene.times_source == "nominal" else f", {scene.times[t] - scene.times[0]:.2f} s"
    return f"frame {t}{seconds}"


def _show(axes: Axes, image: NDArray, mask: NDArray[np.bool_] | None) -> None:
    """An image, or an opacity in grey, with the outline of `mask`; large ones thinned out for display only."""
    step = max(1, max(image.shape[:2]) // _CELL_PIXELS)
    axes.imshow(image[::step, ::step], cmap="gray", vmin=0, vmax=1, interpolation="antialiased")
    if mask is not None and mask.any():
        axes.contour(mask[::step, ::step], levels=[0.5], colors=[_OUTLINE], linewidths=0.5)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def _label_rows(grid: NDArray, submissions: Sequence[Any]) -> None:
    grid[0, 0].set_ylabel("ground truth")
    row = 1
    for submission in submissions:
        identity = submission.identity
        name = f"{identity.method}\n{identity.preset}, seed {identity.seed}"
        if _ok(submission):
            grid[row, 0].set_ylabel(f"{name}\nrender")
            grid[row + 1, 0].set_ylabel(f"foreground\nopacity{FILTER_MARK if identity.mixed else ''}")
            row += 2
        else:
            status = getattr(submission.status, "value", submission.status)
            text = f"{identity.method} ({identity.preset}, seed {identity.seed}) failed: {status}. {submission.reason}"
            text = shorten(text, _REASON_CHARACTERS, placeholder=" ...")
            note = grid[row, 0].text(0, 0.5, text, transform=grid[row, 0].transAxes, va="center", color="#A00000")
            # The text extends over the neighbouring cells and must not widen its cell.
            note.set_in_layout(False)
            row += 1

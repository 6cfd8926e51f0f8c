"""What a comparison of masks looks like: a table of every mask, one of the paper's figures, and a picture per scene."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.csv_cells import csv_text
from splashbench.files import atomic_path, read_image, write_text
from splashbench.prepare.masks.comparison import (
    MaskChange,
    MaskComparison,
    MaskPair,
    mask_change,
    read_pair,
    worst_pairs,
)
from splashbench.prepare.masks.drawing import around_masks, changed
from splashbench.prepare.masks.sheet import find_image

WORST = 6
_COLUMNS = 3
_WIDTH_INCHES, _TITLE_INCHES, _PANEL_INCHES, _NOTE_INCHES, _PICTURE_INCHES = 11.0, 0.8, 1.3, 0.45, 3.0
_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "text.parse_math": False,  # names come from strangers' files; a "$" in one is no formula
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def pair_table(comparisons: Sequence[MaskComparison]) -> str:
    """CSV of every mask, areas and changes in pixels; `iou` is blank where neither mask has liquid."""
    names = ["camera", "frame", "n_pixels", "raw_area", "refined_area", "added", "removed"]
    rows = [
        [
            csv_text(comparison.scene),
            *(csv_text(value) if isinstance(value := getattr(pair, name), str) else value for name in names),
            "" if pair.iou is None else f"{pair.iou:.6f}",
        ]
        for comparison in comparisons
        for pair in comparison.all_pairs
    ]
    return _csv(["scene", *names, "iou"], rows)


def change_table(rows: Mapping[tuple[str, str], MaskChange]) -> str:
    """CSV of the figures of each camera, scene and all; blank where nothing has liquid."""
    names = [field.name for field in fields(MaskChange)]
    body = [[*map(csv_text, key), *(_plain(getattr(change, name)) for name in names)] for key, change in rows.items()]
    return _csv(["scene", "camera", *names], body)


def _csv(header: list[str], rows: list[list[Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()


def _plain(value: float) -> str:
    return "" if math.isnan(value) else str(value) if isinstance(value, int) else f"{value:.6f}"


def write_report(
    comparisons: Sequence[MaskComparison], rows: Mapping[tuple[str, str], MaskChange], folder: Path
) -> list[str]:
    """Write masks.csv, summary.csv and a picture per scene into `folder`; returns their names."""
    write_text(folder / "masks.csv", pair_table(comparisons))
    write_text(folder / "summary.csv", change_table(rows))
    names = ["masks.csv", "summary.csv"]
    for comparison in comparisons:
        name = "comparison.png" if len(comparisons) == 1 else f"comparison_{comparison.scene}.png"
        draw_comparison(comparison, folder / name)
        names.append(name)
    return names


def draw_comparison(comparison: MaskComparison, path: Path) -> None:
    """IoU over time, a panel per camera, and the masks that differ most, as a PNG."""
    import matplotlib
    from matplotlib.figure import Figure

    worst = worst_pairs(comparison, WORST)
    panels = list(comparison.pairs.items())
    lines, pictures = -(-len(panels) // _COLUMNS), -(-len(worst) // _COLUMNS)
    middle = _TITLE_INCHES + lines * _PANEL_INCHES  # from the top, where the pictures begin
    height = middle + (_NOTE_INCHES + pictures * _PICTURE_INCHES if worst else 0.0)
    change = mask_change(comparison.all_pairs)
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(_WIDTH_INCHES, height))
        figures = (
            f"IoU mean {change.mean_iou:.3f}, median {change.median_iou:.3f}; of the union {change.added_share:.1%}"
            f" added, {change.removed_share:.1%} removed; {change.empty_share:.1%} of {change.n_masks} raw masks empty"
        )
        title = f"{comparison.scene[:80]}: raw against refined masks"
        figure.text(0.03, 1 - 0.17 / height, title, fontsize=10, fontweight="bold", va="center")
        figure.text(0.03, 1 - 0.37 / height, figures, fontsize=9, va="center")
        sides = {"left": 0.04, "right": 0.985, "wspace": 0.14}
        grid = figure.add_gridspec(
            lines, _COLUMNS, top=1 - _TITLE_INCHES / height, bottom=1 - (middle - 0.25) / height, hspace=0.6, **sides
        )
        for number, (camera, pairs) in enumerate(panels):
            marked = [pairs.index(pair) for pair in worst if pair.camera == camera]
            _draw_iou(figure.add_subplot(grid[divmod(number, _COLUMNS)]), camera, pairs, marked)
        if worst:
            note = "The masks that differ most (circles above). Blue: added by refining; orange: removed; light: kept."
            figure.text(0.04, 1 - (middle + 0.12) / height, note, va="center")
            top = 1 - (middle + _NOTE_INCHES) / height
            grid = figure.add_gridspec(pictures, _COLUMNS, top=top, bottom=0.1 / height, hspace=0.12, **sides)
            for number, pair in enumerate(worst):
                _draw_pair(figure.add_subplot(grid[divmod(number, _COLUMNS)]), comparison, pair)
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format="png", dpi=120, facecolor="white", metadata={"Software": None})


def _draw_pair(axes: Any, comparison: MaskComparison, pair: MaskPair) -> None:
    axes.imshow(_overlay(comparison, pair), interpolation="antialiased")
    shares = f"{pair.added / pair.union:.0%} added, {pair.removed / pair.union:.0%} removed"
    axes.set_title(f"camera {pair.camera}, frame {pair.frame}: IoU {pair.iou:.2f}, {shares}", fontsize=8)
    axes.set_axis_off()


def _draw_iou(axes: Any, camera: str, pairs: Sequence[MaskPair], marked: Sequence[int]) -> None:
    values = np.array([math.nan if pair.iou is None else pair.iou for pair in pairs])
    empty = [t for t, pair in enumerate(pairs) if pair.raw_area == 0 and pair.union]
    axes.plot(values, color="#0072B2", linewidth=1.2, marker=".", markersize=3)
    axes.plot(empty, [0.0] * len(empty), linestyle="none", marker="x", color="#C02020", markersize=5, clip_on=False)
    axes.plot(marked, values[list(marked)], linestyle="none", marker="o", fillstyle="none", color="#222222")
    axes.set_ylim(-0.02, 1.02)
    axes.set_xlim(-0.5, len(pairs) - 0.5)
    mean = np.nanmean(values) if np.isfinite(values).any() else math.nan
    note = f", {len(empty)} raw masks empty (×)" if empty else ""
    axes.set_title(f"camera {camera}: mean IoU {mean:.3f}{note}", loc="left", fontsize=8)
    axes.grid(True, color="#E6E6E6", linewidth=0.6)
    axes.set_axisbelow(True)


def _overlay(comparison: MaskComparison, pair: MaskPair) -> NDArray[np.uint8]:
    raw, refined = read_pair(comparison.raw, comparison.refined, pair.camera, pair.frame)
    image = np.zeros((*raw.shape, 3), np.uint8)
    for mask_set in (comparison.refined, comparison.raw):
        path = find_image(Path(mask_set.images) if mask_set.images else None, pair.camera, pair.frame)
        if path is not None:
            picture = read_image(path)
            image = picture if picture.shape == image.shape else image
            break
    rows, columns = around_masks((raw.shape[0], raw.shape[1]), raw, refined)
    return changed(image[rows, columns], raw[rows, columns], refined[rows, columns])

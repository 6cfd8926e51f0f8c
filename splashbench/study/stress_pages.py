"""One page for each method of a stress study: where it breaks, how that looks, and what to do about it.

method_NAME.md has a table of kinds, the worst first, and a picture: the true view, the method's of the recording as it
is, and its view of a worse one.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import atomic_path, write_text
from splashbench.markdown import table as markdown_table
from splashbench.scene import Scene
from splashbench.study.job import Store, pictured_timestep
from splashbench.study.stability import BROKEN, Breakdown, StressRun
from splashbench.study.stress import Harm, StressPlan

# Rows of a picture, and the width of one of its views in pixels.
_MOST_ROWS, _VIEW_WIDTH = 8, 360
_MARGIN = 0.12  # of the liquid's box, about it


@dataclass(frozen=True)
class KindSummary:
    """What a method keeps under one kind: by level the mean retention of its runs, and how many there are of them.

    breaks_at: the first of these levels at which the curve of `found` is below BROKEN; None where it never is.
    """

    kind: str
    kept: Mapping[int, float]
    runs: int
    failed: int
    found: Breakdown
    breaks_at: int | None


def summaries(found: Mapping[StressRun, float], breakdowns: Mapping[str, Breakdown]) -> list[KindSummary]:
    """Of one method's retentions each kind, those first that break it the soonest, then those that cost it the most.

    breakdowns: by kind, of the levels that were run.
    """
    kinds: dict[str, dict[int, list[float]]] = {}
    failed: dict[str, int] = {}
    for run, value in found.items():
        kinds.setdefault(run.kind, {}).setdefault(run.level, []).append(value)
        failed[run.kind] = failed.get(run.kind, 0) + (run.value is None)
    rows = []
    for kind, levels in kinds.items():
        kept = {level: float(np.mean(values)) for level, values in sorted(levels.items())}
        curve = zip(kept, breakdowns[kind].fitted[1:], strict=True)
        broken = next((level for level, of_curve in curve if of_curve < BROKEN), None)
        runs = sum(map(len, levels.values()))
        rows.append(KindSummary(kind, kept, runs, failed[kind], breakdowns[kind], broken))
    return sorted(rows, key=lambda row: (row.breaks_at or 6, min(row.kept.values())))


def place(found: Breakdown) -> str:
    """Where a method breaks, in the unit of the kind, with the interval where there is one."""
    least = f"{found.amounts[-1]:g}"
    if found.point is None:
        return f"not up to {least}"
    low, high = (least if end is None else f"{end:.3g}" for end in found.interval)
    return f"{found.point:.3g}" + ("" if found.interval == (None, None) else f" ({low} to {high})")


def page_name(label: str, number: int) -> str:
    """The name of a method's page, without an ending; labels may be anything."""
    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", label).strip("_")[:40]
    return f"method_{plain}" if plain == label else f"method_{plain}_{number}"


def write_pages(
    stress: StressPlan,
    store: Store,
    by_method: Mapping[str, Mapping[StressRun, float]],
    breakdowns: Mapping[tuple[str, str], Breakdown],
    metric: str,
    out: Path,
) -> list[str]:
    """Write the page of every method of `by_method` into `out`, with its picture; returns the names of the files.

    by_method: retentions by `metric`. breakdowns: of the same by method and kind.
    """
    names = []
    for number, label in enumerate(stress.methods):
        found = by_method.get(label)
        if not found:
            continue
        of_label = {kind: where for (method, kind), where in breakdowns.items() if method == label}
        rows, name = summaries(found, of_label), page_name(label, number)
        picture = _picture(stress, store, label, rows)
        if picture is not None:
            with atomic_path(out / f"{name}.png") as temporary:
                imageio.imwrite(temporary, picture, extension=".png")
            names.append(f"{name}.png")
        write_text(out / f"{name}.md", _page(stress, label, rows, metric, None if picture is None else f"{name}.png"))
        names.append(f"{name}.md")
    return names


def _page(stress: StressPlan, label: str, rows: Sequence[KindSummary], metric: str, picture: str | None) -> str:
    kinds = {harm.kind.named(): harm.kind for harm in stress.harms}
    broken = [row for row in rows if row.breaks_at is not None]
    levels = sorted({harm.level for harm in stress.harms})
    said = f"{label} breaks under {len(broken)} of {len(rows)} kinds of harm that were tried"
    first = f", first under `{broken[0].kind}`" if broken else ""
    parts = [
        f"# Where {label} breaks",
        f"**{said}{first}.** It breaks where the curve of what it keeps falls below {BROKEN:g}.",
    ]
    if picture is not None:
        parts.append(f"![The true view, the method's, and its view of a worse recording]({picture})")
        parts.append(
            "*From left to right: the truth; the recording as it is; a recording that is worse. The worst first.*"
        )
    cells = {
        "kind": [f"`{row.kind}`" for row in rows],
        "breaks at": [f"{place(row.found)} {kinds[row.kind].unit}" for row in rows],
        **{
            f"severity {level}": [f"{row.kept[level]:.2f}" if level in row.kept else "–" for row in rows]
            for level in levels
        },
        "failed": [str(row.failed) for row in rows],
    }
    right = [name for name in cells if name.startswith("severity") or name == "failed"]
    parts += [f"## What it keeps, by {metric}", markdown_table(cells, right=right)]
    parts.append(
        "Means of the runs; – was not run. Severities are those of each kind's ladder (docs/study.md). The curve never "
        "rises, so that luck at one severity breaks nothing."
    )
    if broken:
        advice = {
            "kind": [f"`{row.kind}`" for row in broken],
            "in your own recording": [kinds[row.kind].remedy for row in broken],
        }
        parts += ["## What to do about it", markdown_table(advice)]
    return "\n\n".join(parts) + "\n"


def _picture(stress: StressPlan, store: Store, label: str, rows: Sequence[KindSummary]) -> NDArray[np.uint8] | None:
    """Rows of three views with their titles, or None where no renders were kept."""
    strips = []
    for row in rows[:_MOST_ROWS]:
        level = row.breaks_at or max(row.kept)
        strip = _strip(stress, store, label, row.kind, level, row.kept[level])
        if strip is not None:
            strips.append(strip)
    return np.concatenate(strips) if strips else None


def _strip(
    stress: StressPlan, store: Store, label: str, kind: str, level: int, kept: float
) -> NDArray[np.uint8] | None:
    for scene in stress.plan.scenes:
        whole = _render(stress, store, label, scene.name, None)
        worse = _render(stress, store, label, scene.name, (kind, level))
        if whole is None or worse is None:
            continue
        view, middle = scene.scene.test[0], pictured_timestep(scene.scene.n_frames)
        truth = scene.scene.image(view, middle)
        window = _window(scene.scene, view, middle)
        harm = next(h for h in stress.harms if h.kind.named() == kind and h.level == level)
        titles = (f"truth, {scene.name}", "as recorded", f"{_amount(harm)}: keeps {kept:.2f}")
        return np.concatenate(
            [_titled(image[window], title) for image, title in zip((truth, whole, worse), titles)], axis=1
        )
    return None


def _amount(harm: Harm) -> str:
    return f"{harm.kind.named().replace('_', ' ')} {harm.amount:g} {harm.kind.unit}"


def _render(
    stress: StressPlan, store: Store, label: str, scene: str, harm: tuple[str, int] | None
) -> NDArray[np.uint8] | None:
    for run in stress.plan.runs:
        of, what = stress.rows[run.variant.name]
        same = harm is None if what is None else harm == (what.kind.named(), what.level)
        path = store.picture_path(run.digest, pictured_timestep(run.scene.scene.n_frames))
        if of == label and run.scene.name == scene and same and path.is_file():
            try:
                return np.asarray(imageio.imread(path))[..., :3]
            except (OSError, ValueError) as error:
                raise SplashbenchError(f"{path} is no picture; delete it: {error}") from None
    return None


def _window(scene: Scene, view: str, t: int) -> tuple[slice, slice]:
    """The part of the image about the liquid of all frames."""
    ever = np.logical_or.reduce([scene.mask(view, k) for k in range(scene.n_frames)])
    rows, columns = np.flatnonzero(ever.any(axis=1)), np.flatnonzero(ever.any(axis=0))
    if not len(rows):
        return slice(None), slice(None)
    height, width = ever.shape
    around = round(_MARGIN * max(rows[-1] - rows[0], columns[-1] - columns[0]))
    return (
        slice(max(rows[0] - around, 0), min(rows[-1] + 1 + around, height)),
        slice(max(columns[0] - around, 0), min(columns[-1] + 1 + around, width)),
    )


def _titled(image: NDArray[np.uint8], title: str) -> NDArray[np.uint8]:
    """`image` at the width of a view, with `title` above it."""
    import cv2

    height = max(1, round(image.shape[0] * _VIEW_WIDTH / image.shape[1]))
    grown = cv2.resize(np.ascontiguousarray(image), (_VIEW_WIDTH - 6, height), interpolation=cv2.INTER_CUBIC)
    canvas = np.full((height + 24, _VIEW_WIDTH, 3), 255, np.uint8)
    canvas[22 : 22 + height, 3 : _VIEW_WIDTH - 3] = grown
    cv2.putText(canvas, title, (4, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (20, 20, 20), 1, cv2.LINE_AA)
    return canvas

"""Charts of the results pages: `python docs/results/charts.py` draws docs/results/charts/ from the tables in data/.

Nothing is computed but differences of figures in these tables. Hollow marks are the paper's figures, as it reports
them on other scenes (leaderboards/paper.csv); diamonds rest on the protocol's filter for mixed methods.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

HERE = Path(__file__).parent
PAPER = HERE.parents[1] / "leaderboards"

# Okabe and Ito: vermilion for splashsplat, blue for what it is compared with.
BLUE, VERMILION, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"
SCENES = {
    "opaque_bowl": ("o", BLUE),
    "glass_tank": ("s", GREEN),
    "thin_stream": ("^", VERMILION),
    "still_pool": ("D", GREY),
}
METHODS = (
    "splashsplat",
    "splashsplat_masks_alone",
    "scaffold_4d",
    "spacetime_gaussians",
    "spacetime_gaussians_lite",
    "deformable_3dgs",
    "hull_points",
)
STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.grid.axis": "x",
    "grid.color": "#e5e5e5",
    "axes.axisbelow": True,
}


def read(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def study(name: str) -> dict[tuple[str, str], dict[str, str]]:
    """A study's table: (variant, metric) to its row."""
    return {(row["variant"], row["metric"]): row for row in read(HERE / "data" / f"{name}.csv")}


def by_scene(name: str, metric: str) -> dict[tuple[str, str], float]:
    """Figures of single scenes: (variant, scene) to the value."""
    rows = [row for row in read(HERE / "data" / "by_scene.csv") if (row["study"], row["metric"]) == (name, metric)]
    return {(row["variant"], row["scene"]): float(row["value"]) for row in rows}


def reported(scene_set: str, metric: str) -> dict[str, float]:
    """The paper's figures: variant ("full" without one) to the value."""
    rows = [row for row in read(PAPER / "paper.csv") if row["scene_set"] == scene_set and row[metric]]
    names = {row["method"]: row["method"].partition("[")[2].rstrip("]") or row["method"] for row in rows}
    return {names[row["method"]].replace("splashsplat", "full"): float(row[metric]) for row in rows}


def named_rows(place: Axes, names: Sequence[str]) -> None:
    """Label the rows of a panel from the top down."""
    place.set_yticks(range(len(names)), [name.replace("_", " ") for name in names])
    place.set_ylim(len(names) - 0.5, -0.5)


def legend(place: Axes) -> None:
    place.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.01, 1.0))


def scene_dots(place: Axes, figures: dict[tuple[str, str], float], names: Sequence[str]) -> None:
    """A row per variant, a mark per scene."""
    for scene, (marker, color) in SCENES.items():
        points = [(figures[name, scene], y) for y, name in enumerate(names) if (name, scene) in figures]
        if points:
            place.plot(*zip(*points), marker, color=color, ms=6, label=scene.replace("_", " "))
    named_rows(place, names)


def baselines() -> Figure:
    table = study("baselines")
    figure = Figure(figsize=(9.2, 4.4), layout="constrained")
    places = figure.subplots(2, 2, sharey=True).flat
    panels = (
        ("psnr", "PSNR of the liquid, dB →"),
        ("lpips", "← LPIPS"),
        ("miou", "mIoU →"),
        ("jitter_error", "← jitter error"),
    )
    for place, (metric, title) in zip(places, panels):
        for y, name in enumerate(METHODS):
            row = table[name, metric]
            color = VERMILION if name.startswith("splashsplat") else BLUE
            marker = "D" if row["filtered"] == "true" else "o"
            place.errorbar(float(row["mean"]), y, xerr=float(row["sd"]), fmt=marker, color=color, ms=5)
        place.set_title(title)
        named_rows(place, METHODS)
    figure.supxlabel(
        "Means of three scenes, bars: one standard deviation over three seeds. Diamonds: filtered.", fontsize=7.5
    )
    return figure


def psnr_by_scene() -> Figure:
    figure = Figure(figsize=(8.2, 2.9), layout="constrained")
    place = figure.subplots()
    scene_dots(place, by_scene("baselines", "psnr"), METHODS)
    place.set_title("PSNR of the liquid in test views, dB →")
    legend(place)
    return figure


def switches() -> Figure:
    rows = {name: row for (name, metric), row in study("best").items() if metric == "psnr" and row["difference"]}
    rows = {
        name: rows[name] for name in sorted(rows, key=lambda name: float(rows[name]["difference"])) if name != "nothing"
    }
    figure = Figure(figsize=(7.2, 4.3), layout="constrained")
    place = figure.subplots()
    values = [float(row["difference"]) for row in rows.values()]
    place.barh(
        range(len(rows)), values, xerr=[float(row["difference_sd"]) for row in rows.values()], color=BLUE, height=0.65
    )
    named_rows(place, list(rows))
    place.axvline(0, color=GREY, lw=0.8)
    place.set_title("PSNR against preset best, dB (bars: one standard deviation over three seeds)")
    return figure


def filtering() -> Figure:
    figures = by_scene("filter", "miou")
    figure = Figure(figsize=(8.2, 2.6), layout="constrained")
    place = figure.subplots()
    scene_dots(place, figures, list(dict.fromkeys(name for name, _ in figures)))
    place.set_title("mIoU → (all rows but the first are filtered)")
    legend(place)
    return figure


def budgets() -> Figure:
    kinds = ("test", "training")
    figure = Figure(figsize=(9.2, 2.6), layout="constrained")
    for place, kind in zip(figure.subplots(1, 2, sharey=True), kinds):
        quick, published = (by_scene("budgets", f"{budget}_{kind}_psnr") for budget in ("quick", "published"))
        names = [name for name, _ in quick]
        for y, (short, long) in enumerate(zip(quick.values(), published.values())):
            place.plot([short, long], [y, y], color=GREY, lw=1, zorder=1)
        place.plot(list(published.values()), range(len(names)), "o", color=BLUE, label="published steps")
        place.plot(list(quick.values()), range(len(names)), "o", color=VERMILION, label="quick")
        named_rows(place, names)
        place.set_title(f"PSNR of the liquid in {kind} views, dB →")
    legend(place)
    return figure


def interpolation() -> Figure:
    rows = read(HERE / "data" / "withheld.csv")
    figures = {(row["row"], row["scene"], row["metric"]): float(row["value"]) for row in rows}
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    names = list(dict.fromkeys(row["row"] for row in rows if not row["row"].endswith(", faded")))
    figure = Figure(figsize=(9.2, 2.1), layout="constrained")
    for place, scene in zip(figure.subplots(1, len(scenes), sharey=True), scenes):
        for y, name in enumerate(names):
            color = VERMILION if name == "splashsplat" else BLUE
            place.plot(figures[name, scene, "psnr"], y, "o", color=color)
            place.plot(figures[f"{name}, faded", scene, "psnr"], y, "|", color=GREY, ms=12, mew=1.5)
        named_rows(place, names)
        place.set_title(scene)
    figure.supxlabel(
        "PSNR at unseen timesteps, dB → Upright bars: faded, the method's own renders of the neighbours, averaged.",
        fontsize=7.5,
    )
    return figure


def container() -> Figure:
    figures = by_scene("container", "psnr")
    figure = Figure(figsize=(8.2, 1.9), layout="constrained")
    place = figure.subplots()
    scene_dots(place, figures, list(dict.fromkeys(name for name, _ in figures)))
    place.set_title("PSNR of the liquid by what splashsplat is told, dB →")
    legend(place)
    return figure


def against_paper(name: str, scene_set: str, metrics: Sequence[tuple[str, str]]) -> Callable[[], Figure]:
    """Differences to the first row, ours filled and the paper's hollow."""

    def draw() -> Figure:
        table = study(name)
        variants = list(dict.fromkeys(variant for variant, _ in table if variant != "nothing"))
        base, rows = variants[0], variants[1:]
        figure = Figure(figsize=(4.6 * len(metrics), 0.9 + 0.3 * len(rows)), layout="constrained")
        for place, (metric, title) in zip(figure.subplots(1, len(metrics), sharey=True, squeeze=False)[0], metrics):
            paper = {
                variant.replace("without_", "no_").replace("raw_masks", "raw"): value
                for variant, value in reported(scene_set, metric).items()
            }
            for y, variant in enumerate(rows):
                row = table[variant, metric]
                place.errorbar(
                    float(row["difference"]), y - 0.12, xerr=float(row["difference_sd"] or 0), fmt="o", color=VERMILION
                )
                if variant in paper:
                    place.plot(paper[variant] - paper["full"], y + 0.12, "o", mfc="white", color=GREY)
            named_rows(place, rows)
            place.axvline(0, color=GREY, lw=0.8)
            place.set_title(f"{title}, against {base.replace('_', ' ')}")
        figure.supxlabel(
            "Filled: measured on synthetic scenes. Hollow: reported by the paper, on real ones.", fontsize=7.5
        )
        return figure

    return draw


def carriers() -> Figure:
    best, shared = by_scene("carriers", "psnr"), by_scene("shared_features", "psnr")
    rows = {
        "two Gaussians a carrier": [(best, "two_children")],
        "pruned below .05": [(best, "hard_pruning")],
        "new carriers in every frame": [(best, "per_frame")],
        "nothing shared (version 2)": [(shared, "own_features")],
    }
    differences = {
        (label, scene): figures[variant, scene] - figures["best", scene]
        for label, [(figures, variant)] in rows.items()
        for scene in SCENES
    }
    figure = Figure(figsize=(8.2, 2.4), layout="constrained")
    place = figure.subplots()
    scene_dots(place, differences, list(rows))
    place.axvline(0, color=GREY, lw=0.8)
    place.set_title("PSNR against preset best, dB")
    legend(place)
    return figure


def transport() -> Figure:
    rows = read(PAPER / "paper_one_step.csv")
    paper = {row["predictor"].replace("_", " ").replace("flip", "FLIP"): float(row["validity"]) for row in rows}
    figure = Figure(figsize=(8.2, 1.9), layout="constrained")
    place = figure.subplots()
    for preset, color in (("best", VERMILION), ("paper", BLUE)):
        figures = by_scene("transport", f"validity_{preset}")
        place.plot(list(figures.values()), range(len(figures)), "o", color=color, label=f"preset {preset}")
    names = [name for name, _ in figures]
    place.plot(
        [paper[name] for name in names], range(len(names)), "o", mfc="white", color=GREY, label="reported by the paper"
    )
    named_rows(place, names)
    place.set_title("Carriers still within half a voxel of the liquid one step on →")
    legend(place)
    return figure


def told_nothing() -> Figure:
    rows = [row for row in read(HERE / "data" / "told_nothing.csv") if row["set"] == "240x160"]
    figures = {(row["row"], row["scene"], row["metric"]): float(row["value"]) for row in rows}
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure = Figure(figsize=(9.2, 2.8), layout="constrained")
    places = figure.subplots(1, 3, sharey=True)
    marks = (
        ("spacetime_gaussians", "s", GREY, "white"),
        ("scaffold_4d", "D", BLUE, BLUE),
        ("splashsplat", "o", VERMILION, VERMILION),
    )
    panels = (("psnr", "PSNR of the liquid, dB →"), ("lpips", "← LPIPS"), ("jitter_error", "← jitter error"))
    for place, (metric, title) in zip(places, panels):
        for name, marker, edge, face in marks:
            values = [figures[name, scene, metric] for scene in scenes]
            place.plot(values, range(len(scenes)), marker, mec=edge, mfc=face, ms=6, label=name)
        named_rows(place, scenes)
        place.set_title(title)
    legend(places[-1])
    return figure


def logarithmic(place: Axes, ticks: Sequence[float], label: str, title: str) -> None:
    place.set_xscale("log")
    place.set_xticks(ticks, [f"{tick:g}" for tick in ticks], minor=False)
    place.set_xticks([], minor=True)
    place.set_xlabel(label)
    place.set_title(title)


def quality_over_time(name: str = "quality_over_time") -> Figure:
    rows = [row for row in read(HERE / "data" / f"{name}.csv") if row["seconds"]]
    figure = Figure(figsize=(9.2, 2.8), layout="constrained")
    places = figure.subplots(1, 3)
    marks = (("spacetime_gaussians", "s", GREY), ("scaffold_4d", "D", BLUE), ("splashsplat", "o", VERMILION))
    for place, (metric, title) in zip(
        places, (("psnr", "PSNR of the liquid, dB"), ("lpips", "LPIPS (less is better)"), ("miou", "mIoU"))
    ):
        for name, marker, color in marks:
            points = [
                (float(row["seconds"]), float(row["value"]))
                for row in rows
                if (row["row"], row["metric"]) == (name, metric)
            ]
            place.step(*zip(*points), where="post", color=color, lw=1.4)
            place.plot(*zip(*points), marker, mec=color, mfc="white", ms=4, label=name)
        last = max(float(row["seconds"]) for row in rows)
        ticks = (5, 10, 20, 40, 80, 160, 300) if last <= 300 else (10, 20, 40, 80, 160, 320, 640)
        logarithmic(place, ticks, "seconds of the fit", title)
    legend(places[-1])
    return figure


def capacity() -> Figure:
    rows = read(HERE / "data" / "capacity.csv")
    figure = Figure(figsize=(9.2, 2.8), layout="constrained")
    places = figure.subplots(1, 3)
    units = (
        ("seconds", "thin_stream", "budget of seconds"),
        ("megabytes", "thin_stream", "budget of megabytes stored"),
        ("memory", "opaque_bowl", "budget of megabytes of memory"),
    )
    for place, (unit, scene, title) in zip(places, units):
        points = [
            (float(row["limit"]), float(row["psnr"])) for row in rows if (row["budget"], row["scene"]) == (unit, scene)
        ]
        place.plot(*zip(*sorted(points)), "o-", color=BLUE, mfc="white", ms=4, lw=1.4)
        logarithmic(place, [limit for limit, _ in sorted(points)], title, f"PSNR, dB ({scene})")
    return figure


def whole_fit() -> Figure:
    rows = read(HERE / "data" / "by_scene.csv")
    phases = {row["metric"]: float(row["value"]) for row in rows if row["study"] == "whole_fit"}
    figure = Figure(figsize=(7.2, 2.2), layout="constrained")
    place = figure.subplots()
    place.barh(range(len(phases)), list(phases.values()), color=BLUE, height=0.65)
    named_rows(place, list(phases))
    place.set_title("Wall time of preset best at 1200x1800, 50 frames, s")
    return figure


def whole_fit_told_nothing() -> Figure:
    rows = read(HERE / "data" / "whole_fit_told_nothing.csv")
    figure = Figure(figsize=(7.2, 2.8), layout="constrained")
    places = figure.subplots(1, 2)
    marks = (
        ("hull_points", "x", GREY, "none"),
        ("spacetime_gaussians", "s", GREY, "-"),
        ("scaffold_4d", "D", BLUE, "-"),
        ("splashsplat 28", "o", VERMILION, ":"),
        ("splashsplat", "o", VERMILION, "-"),
    )
    for place, (metric, title) in zip(places, (("psnr", "PSNR of the liquid, dB"), ("miou", "mIoU"))):
        for name, marker, color, line in marks:
            points = [(float(row["seconds"]), float(row[metric])) for row in rows if row["method"] == name]
            place.step(*zip(*points), where="post", color=color, lw=1.4, ls=line)
            place.plot(*zip(*points), marker, color=color, mfc="white", ms=4, label=name)
        logarithmic(place, (30, 60, 120, 300, 600, 1800), "seconds of the fit at 1200x1800", title)
    legend(places[-1])
    return figure


IMAGES = (("psnr", "PSNR, dB"), ("miou", "mIoU"))
CHARTS: dict[str, Callable[[], Figure]] = {
    "psnr_by_scene": psnr_by_scene,
    "baselines": baselines,
    "switches": switches,
    "filter": filtering,
    "budgets": budgets,
    "interpolation": interpolation,
    "container": container,
    "ablation": against_paper("ablation", "ablation_10", IMAGES),
    "masks": against_paper("masks", "mask_robustness", IMAGES),
    "views": against_paper("views", "views_10", IMAGES),
    "sensitivity": against_paper(
        "sensitivity", "sensitivity_10", (("psnr", "PSNR, dB"), ("sigma_mu_ratio", "σ_D / μ_D"))
    ),
    "carriers": carriers,
    "transport": transport,
    "told_nothing": told_nothing,
    "quality_over_time": quality_over_time,
    "quality_over_time_transparent": partial(quality_over_time, "quality_over_time_transparent"),
    "quality_over_time_600x400": partial(quality_over_time, "quality_over_time_600x400"),
    "capacity": capacity,
    "whole_fit": whole_fit,
    "whole_fit_told_nothing": whole_fit_told_nothing,
}


def main() -> None:
    out = HERE / "charts"
    out.mkdir(exist_ok=True)
    with rc_context(STYLE):
        for name, draw in CHARTS.items():
            draw().savefig(out / f"{name}.png", dpi=100, metadata={"Software": None}, facecolor="white")


if __name__ == "__main__":
    main()

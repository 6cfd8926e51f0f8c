"""Writes docs/results/data/quality_over_time*.csv from the committed results of leaderboards/told_nothing*.

    python docs/tools/quality_over_time.py

What each method has to show after so many seconds of its fit, as the leaderboard's page counts it: the mean over scenes
of means over seeds. `reached` is the share of a rival's fit time in which splashsplat has the rival's final value, the
median over rivals and scenes. `lead` is splashsplat's over the rival with the higher mean, in PSNR: the mean over
scenes, the ends of its 95 % interval by resampling scenes, the share of resamplings in which it is positive, and the
least over scenes against the best rival of each. Fewer than five scenes have no interval.
"""

from __future__ import annotations

import csv
import sys
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median

from splashbench.files import atomic_path
from splashbench.report.anytime import before, trajectories, value_at
from splashbench.report.groups import Entry, Group, groups
from splashbench.report.results import load_results
from splashbench.statistics import compare

ROOT = Path(__file__).parents[2]
LEADERBOARDS, DATA = ROOT / "leaderboards", ROOT / "docs" / "results" / "data"


@dataclass(frozen=True)
class Times:
    """seconds: of the fit, at which values are told; those of the page's table are among them. budgets: of these, the
    ones at which leads are told."""

    seconds: tuple[int, ...]
    budgets: tuple[int, ...]


#: By what stands behind `told_nothing` and `quality_over_time` in the names of results and table.
TIMES = {
    "": Times((5, 7, 10, 14, 20, 30, 40, 60, 80, 120, 160, 220, 300), (10, 30, 60, 120, 300)),
    "_transparent": Times((5, 7, 10, 14, 20, 30, 40, 60, 80, 120, 160, 220, 300), (10, 30, 60, 120, 300)),
    "_600x400": Times((10, 14, 20, 30, 40, 60, 80, 120, 160, 220, 300, 450, 600, 900), (30, 60, 120, 300, 600)),
}
METRICS = ("psnr", "lpips", "miou")
#: by method, the preset whose runs count
PRESETS = {"splashsplat": "best", "scaffold_4d": "quick", "spacetime_gaussians": "quick"}
METHODS = tuple(PRESETS)


def rows(group: Group, times: Times) -> list[tuple[str, str, str, str]]:
    """method, metric, seconds and value, as text."""
    found = []
    entries = entries_of(group)
    for method in METHODS:
        for metric in METRICS:
            nothing = before(group, metric)
            runs = trajectories(group, entries[method], metric)
            for seconds in times.seconds:
                scenes: dict[str, list[float]] = {}
                for (scene, _), run in runs.items():
                    scenes.setdefault(scene, []).append(run.at(seconds, nothing[scene]))
                found.append((method, metric, str(seconds), f"{mean(map(mean, scenes.values())):.4f}"))
    found.append(("splashsplat", "reached", "", f"{reached(group):.2f}"))
    for seconds in times.budgets:
        found += lead(group, seconds)
    return found


def entries_of(group: Group) -> dict[str, Entry]:
    """The rows of METHODS in `group`, by method."""
    firsts = {(entry.results[0].method, entry.results[0].preset): entry for entry in group.entries}
    return {method: firsts[method, preset] for method, preset in PRESETS.items()}


def lead(group: Group, seconds: float) -> list[tuple[str, str, str, str]]:
    """The rows of the lead after `seconds`; see above."""
    nothing = before(group, "psnr")
    entries = entries_of(group)
    values = {name: value_at(trajectories(group, entries[name], "psnr"), seconds, nothing) for name in METHODS}
    leads = {rival: compare(METHODS[0], rival, values, True) for rival in METHODS[1:]}
    rival, found = min(leads.items(), key=lambda item: item[1].difference.value)
    means = {name: {scene: _mean_of(of, scene) for scene, _ in of} for name, of in values.items()}
    worst = min(own - max(means[other][scene] for other in METHODS[1:]) for scene, own in means[METHODS[0]].items())
    figures = {"psnr": found.difference.value}
    if found.difference.interval is not None:
        low, high = found.difference.interval
        figures |= {"low": low, "high": high, "share": found.probability}
    figures["worst"] = worst
    return [(f"lead over {rival}", name, str(seconds), f"{value:.4f}") for name, value in figures.items()]


def _mean_of(values: dict[tuple[str, int], float], scene: str) -> float:
    return mean(value for (at, _), value in values.items() if at == scene)


def reached(group: Group) -> float:
    """See above; of PSNR. A run that never has the value counts as endless."""
    entries = entries_of(group)
    ours = trajectories(group, entries["splashsplat"], "psnr")
    shares = []
    for rival in METHODS[1:]:
        theirs = trajectories(group, entries[rival], "psnr")
        for scene in {scene for scene, _ in theirs}:
            of_scene = [run for (where, _), run in theirs.items() if where == scene]
            goal, spent = mean(run.values[-1] for run in of_scene), mean(run.seconds[-1] for run in of_scene)
            times = [
                min((s for s, value in zip(run.seconds, run.values) if value >= goal), default=float("inf"))
                for (where, _), run in ours.items()
                if where == scene
            ]
            shares.append(mean(times) / spent)
    return median(shares)


def table(name: str) -> list[tuple[str, str, str, str]]:
    """The rows of the one group of the committed results; name: of TIMES."""
    (group,) = groups(load_results(LEADERBOARDS / f"told_nothing{name}" / "results"))
    return rows(group, TIMES[name])


def main() -> int:
    for name in TIMES:
        path = DATA / f"quality_over_time{name}.csv"
        with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["row", "metric", "seconds", "value"])
            writer.writerows(table(name))
    return 0


if __name__ == "__main__":
    sys.exit(main())

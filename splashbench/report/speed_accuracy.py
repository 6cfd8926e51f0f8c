"""What the speed-accuracy chart shows, as numbers: dots, means with intervals, Pareto front, controls, failures.

docs/protocol.md, "Quality over time". One chart row per group (groups.py): a front that mixes hardware would compare
machines, not methods.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from splashbench.report.groups import Group, comparable, groups
from splashbench.report.results import ResultFile
from splashbench.score.result import Result
from splashbench.statistics import Estimate, estimate


@dataclass(frozen=True)
class Dot:
    """One run, or one reported figure: seconds of fitting, the values it has, and of which scene (its digest)."""

    seconds: float
    values: dict[str, float]
    memory_bytes: float | None
    scene: str = ""


@dataclass
class ChartedMethod:
    """A method with its settings on one machine. mixed: see docs/protocol.md, "Mixed methods".

    shared: the scenes that means are over, common to all methods that compare; None: those that it ran on, which are
    others. failed: runs without a figure.
    """

    label: str
    mixed: bool = False
    dots: list[Dot] = field(default_factory=list)
    shared: frozenset[str] | None = None
    failed: int = 0

    def compares(self, name: str) -> bool:
        """Whether its mean of metric `name` may stand on a front: over the same scenes as others', no run left out."""
        shared = self.shared
        if shared is None or self.failed:
            return False
        return all(name in dot.values for dot in self.dots if dot.scene in shared)

    @property
    def scenes(self) -> set[str]:
        return {dot.scene for dot in self.dots}

    def memory_bytes(self) -> float | None:
        """Median over the runs that measured it."""
        measured = [dot.memory_bytes for dot in self.dots if dot.memory_bytes is not None]
        return float(np.median(measured)) if measured else None

    def summary(self, name: str) -> Summary | None:
        """Inter-quartile mean of time and of metric `name` over the runs that have it."""
        by_scene: dict[str, list[Dot]] = defaultdict(list)
        for dot in self.dots:
            if name in dot.values and (self.shared is None or dot.scene in self.shared):
                by_scene[dot.scene].append(dot)
        if not by_scene:
            return None
        runs = by_scene.values()
        return Summary(
            seconds=estimate([np.log10([dot.seconds for dot in scene]) for scene in runs]).on(lambda x: 10.0**x),
            value=estimate([np.array([dot.values[name] for dot in scene]) for scene in runs]),
        )


@dataclass(frozen=True)
class Summary:
    """Inter-quartile means of time (of its logarithm; seconds) and of a metric, with their intervals."""

    seconds: Estimate
    value: Estimate


_SHOWN = ("lpips", "miou", "dpsnr_bg", "psnr")


@dataclass
class Machine:
    """One row of panels: everything measured on one machine, or reported for it."""

    title: str
    n_scenes: int = 1
    reported: bool = False
    entries: list[ChartedMethod] = field(default_factory=list)
    controls: dict[str, dict[str, float]] = field(default_factory=dict)
    failures: Counter[str] = field(default_factory=Counter)

    def quality_name(self) -> str:
        """`dpsnr_bg` where every run has it, else `psnr`: one panel never mixes the two."""
        dots = [dot for entry in self.entries for dot in entry.dots]
        return "dpsnr_bg" if dots and all("dpsnr_bg" in dot.values for dot in dots) else "psnr"

    def perceptual_name(self) -> str:
        """`lpips` where any run has it; else `miou`, which needs no network weights, rather than an empty panel."""
        dots = [dot for entry in self.entries for dot in entry.dots]
        measured = {name for dot in dots for name in dot.values}
        return "miou" if "miou" in measured and "lpips" not in measured else "lpips"


def pareto_front(points: Sequence[tuple[float, float]], higher_is_better: bool) -> list[tuple[float, float]]:
    """The points (seconds, value) that no other point beats in both, fastest first."""
    sign = 1.0 if higher_is_better else -1.0
    front: list[tuple[float, float]] = []
    for seconds, value in sorted(points, key=lambda point: (point[0], -sign * point[1])):
        if not front or sign * value > sign * front[-1][1]:
            front.append((seconds, value))
    return front


def machines(sources: Sequence[ResultFile]) -> list[Machine]:
    """The measured results by machine, protocol and what the scenes told, in order of name.

    Controls and failed runs are set apart; no run is dropped. Figures of two groups never share a panel.
    """
    return [_machine(group) for group in groups(sources)]


def _machine(group: Group) -> Machine:
    scenes = len(group.scenes)
    comparing = comparable(group)
    kept = {entry.label for entry in comparing.entries}
    shared = frozenset().union(*(entry.scenes for entry in comparing.entries))
    told = "" if group.told is None else f", told {group.told_text}"
    machine = Machine(
        f"{group.machine} · {scenes} scene{'' if scenes == 1 else 's'}, protocol {group.protocol}{told}", scenes
    )
    if kept and len(shared) < scenes:
        machine.title += f" · means over the {len(shared)} that methods have in common"
    for entry in group.entries:
        charted = ChartedMethod(entry.label, entry.first.mixed, shared=shared if entry.label in kept else None)
        for result in entry.results:
            seconds = result.value("fit_seconds")
            if result.status != "ok":
                machine.failures[f"{result.method}: {result.status}"] += 1
                charted.failed += 1
            elif not seconds or seconds <= 0:
                machine.failures[f"{result.method}: fit time not measured"] += 1
                charted.failed += 1
            else:
                memory = result.value("peak_device_memory_bytes") or result.value("peak_memory_bytes")
                charted.dots.append(Dot(seconds, _shown_values(result), memory, result.digests.scene))
        if charted.dots:
            machine.entries.append(charted)
    controls: dict[str, list[dict[str, float]]] = defaultdict(list)
    for entry in group.controls:
        for result in entry.results:
            if result.status == "ok":
                controls[result.method].append(_shown_values(result))
            else:
                machine.failures[f"{result.method}: {result.status}"] += 1
    for method, runs in sorted(controls.items()):
        metrics = {name for run in runs for name in run}
        machine.controls[method] = {
            name: float(np.mean([run[name] for run in runs if name in run])) for name in sorted(metrics)
        }
    return machine


def _shown_values(result: Result) -> dict[str, float]:
    return {name: value for name in _SHOWN if (value := result.value(name)) is not None}


def reported_machine() -> Machine:
    """The paper's main table (means over its 20 scenes), as reported on its own machine."""
    from splashbench.paper_figures import paper_rows

    machine = Machine("", reported=True)
    for row in paper_rows():
        minutes = row["train_minutes"]
        if not isinstance(minutes, float):
            continue
        values = {name: value for name in ("psnr", "lpips") if isinstance(value := row[name], float)}
        memory = row["memory_gib"]
        bytes_ = memory * 2**30 if isinstance(memory, float) else None
        machine.entries.append(
            ChartedMethod(str(row["method"]), dots=[Dot(minutes * 60, values, bytes_)], shared=frozenset([""]))
        )
        machine.title = f"{row['hardware']} by the paper · means over {row['scene_set']}"
    return machine

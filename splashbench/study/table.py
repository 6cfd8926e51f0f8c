"""From runs to rows: means over scenes, spread over seeds, and differences to the baseline.

For each seed a row has the mean over scenes; a row's figure is the mean of these, its spread their standard deviation
(n - 1). The difference to the baseline is taken seed by seed, so what seeds have in common cancels. A mean over the
easier scenes would flatter: a seed counts only where the row has the figure on every scene on which any row has it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Any

from splashbench.score import Result
from splashbench.study.job import Entry, Store
from splashbench.study.plan import Plan, Planned
from splashbench.study.spec import DERIVED, metric_of

#: The status of a run that has not been made.
NOT_RUN = "not run"
#: Column of leaderboards/paper.csv for a metric, and what turns its unit into the metric's.
_PAPER_COLUMNS = {
    "psnr": ("psnr", 1.0),
    "ssim": ("ssim", 1.0),
    "lpips": ("lpips", 1.0),
    "jitter_error": ("jitter_error", 1.0),
    "sigma_d": ("sigma_d", 1.0),
    "sigma_mu_ratio": ("sigma_mu_ratio", 1.0),
    "delta_e": ("delta_e", 1.0),
    "miou": ("miou", 1.0),
    "particles_per_frame": ("carriers", 1.0),
    "primitives_per_frame": ("gaussians_per_frame", 1.0),
    "dynamic_bytes": ("dynamic_storage_mb", 1e6),
    "storage_bytes": ("storage_mb", 1e6),
}


@dataclass(frozen=True)
class Run:
    """A run of the plan and what is known of it; `values` has every metric of the study."""

    planned: Planned
    entry: Entry | None
    result: Result | None
    values: Mapping[str, float | None]

    @property
    def status(self) -> str:
        return self.entry.status if self.entry else NOT_RUN

    @property
    def reason(self) -> str:
        return self.entry.reason if self.entry else ""


@dataclass(frozen=True)
class Cell:
    """One figure of a row; None where it cannot be said.

    mean, std: over seeds, of the means over scenes; seeds: how many. difference, difference_std: to the baseline.
    """

    mean: float | None
    std: float | None
    seeds: tuple[float, ...]
    difference: float | None
    difference_std: float | None


@dataclass(frozen=True)
class Row:
    """A variant, or the reference: its runs and a cell for each metric. `paper`: what the paper reports of it.

    control: whether it is of a method that is a control, as the reference is.
    """

    name: str
    note: str
    control: bool
    runs: tuple[Run, ...]
    cells: Mapping[str, Cell]
    paper: Mapping[str, float]

    def count(self, *statuses: str) -> int:
        """How many runs ended with one of `statuses`."""
        return sum(run.status in statuses for run in self.runs)

    @property
    def failed(self) -> tuple[Run, ...]:
        return tuple(run for run in self.runs if run.status not in ("ok", NOT_RUN))

    @property
    def mixed(self) -> bool:
        """Whether it is of a mixed method, whose liquid the protocol's filter picks out; known from its results."""
        return any(run.result is not None and run.result.mixed for run in self.runs)

    @property
    def whole(self) -> bool:
        """Whether every run of the row came through."""
        return self.count("ok") == len(self.runs)


@dataclass(frozen=True)
class Table:
    """A study's outcome. `scenes_of`: the scenes a metric is averaged over, by name."""

    plan: Plan
    rows: tuple[Row, ...]
    scenes_of: Mapping[str, tuple[str, ...]]

    @property
    def filtered(self) -> bool:
        """Whether some figure rests on the filter that picks out the liquid of mixed methods."""
        named = any(metric_of(name).filtered for name in self.plan.spec.metrics)
        return named and any(row.mixed for row in self.rows)

    @property
    def runs(self) -> tuple[Run, ...]:
        return tuple(run for row in self.rows for run in row.runs)

    @property
    def baseline(self) -> Row:
        return next(row for row in self.rows if row.name == self.plan.spec.baseline)


def make_table(plan: Plan, store: Store) -> Table:
    """The table of what is in `store` by now."""
    spec = plan.spec
    paper = _paper_figures(plan)
    groups = [(v.name, v.note, [run for run in plan.runs if run.variant.name == v.name]) for v in spec.variants]
    if plan.reference_row:
        name = plan.reference_row[0].variant.name
        groups.append((name, "control: the background alone", list(plan.reference_row)))
    made = {name: tuple(_run(planned, store, spec.metrics) for planned in runs) for name, _, runs in groups}
    scenes_of = {
        metric: tuple(
            scene.name
            for scene in plan.scenes
            if any(r.values[metric] is not None for runs in made.values() for r in runs if r.planned.scene is scene)
        )
        for metric in spec.metrics
    }
    by_seed = {
        name: {metric: _scene_means(runs, metric, scenes_of[metric]) for metric in spec.metrics}
        for name, runs in made.items()
    }
    rows = [
        Row(
            name,
            note,
            made[name][0].planned.control,
            made[name],
            {
                m: _cell(by_seed[name][m], None if name == spec.baseline else by_seed[spec.baseline][m])
                for m in spec.metrics
            },
            paper.get(name, {}),
        )
        for name, note, _ in groups
    ]
    return Table(plan, tuple(rows), scenes_of)


def _run(planned: Planned, store: Store, metrics: Sequence[str]) -> Run:
    entry = store.entry(planned.digest)
    result = store.result(entry) if entry else None
    return Run(planned, entry, result, {name: _value(result, name) for name in metrics})


def _value(result: Result | None, metric: str) -> float | None:
    if result is None or result.status != "ok":
        return None
    if metric in DERIVED:
        _, over, under = DERIVED[metric]
        top, bottom = result.value(over), result.value(under)
        return top / bottom if top is not None and bottom else None
    return result.value(metric)


def _scene_means(runs: Sequence[Run], metric: str, scenes: Sequence[str]) -> dict[int, float]:
    """Seed -> mean over `scenes`, of the seeds that have the figure on all of them."""
    values = {(run.planned.seed, run.planned.scene.name): run.values[metric] for run in runs}
    means = {}
    for seed in dict.fromkeys(run.planned.seed for run in runs):
        known = [value for scene in scenes if (value := values.get((seed, scene))) is not None]
        if known and len(known) == len(scenes):
            means[seed] = fmean(known)
    return means


def _cell(means: Mapping[int, float], baseline: Mapping[int, float] | None) -> Cell:
    """`baseline` is None for the baseline itself, which has no difference to itself."""
    values = tuple(means.values())
    differences = [value - baseline[seed] for seed, value in means.items() if baseline and seed in baseline]
    return Cell(_mean(values), _spread(values), values, _mean(differences), _spread(differences))


def _mean(values: Sequence[float]) -> float | None:
    return fmean(values) if values else None


def _spread(values: Sequence[float]) -> float | None:
    return stdev(values) if len(values) > 1 else None


def _paper_figures(plan: Plan) -> dict[str, dict[str, float]]:
    """Row -> metric -> what the paper reports, in the metric's unit."""
    spec = plan.spec
    if spec.paper is None:
        return {}
    from splashbench.paper_figures import paper_rows

    reported: dict[str, dict[str, Any]] = {
        str(row["method"]): row for row in paper_rows() if row["scene_set"] == spec.paper.scene_set
    }
    names = {variant.name: variant.paper for variant in spec.variants if variant.paper}
    if spec.reference:
        names[spec.reference.method] = spec.reference.method
    figures = {}
    for name, method in names.items():
        row = reported.get(method, {})
        figures[name] = {
            metric: float(value) * unit
            for metric in spec.metrics
            if metric in _PAPER_COLUMNS
            for column, unit in [_PAPER_COLUMNS[metric]]
            if (value := row.get(column)) is not None
        }
    return figures

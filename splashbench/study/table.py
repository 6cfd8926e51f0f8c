"""From runs to rows: means over scenes, spread over seeds, and differences to the baseline.

For each seed a row has the mean over scenes; a row's figure is the mean of these, its spread their standard deviation
(n - 1). The difference to the baseline is taken seed by seed, so what seeds have in common cancels. A mean over the
easier scenes would flatter: a seed counts only where the row has the figure on every scene on which any row has it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from splashbench.score import Result
from splashbench.study.job import RunEntry, Store
from splashbench.study.plan import PlannedRun, StudyPlan
from splashbench.study.spec import DERIVED, StudySpec, metric_of

#: The status of a run that has not been made.
NOT_RUN = "not run"
#: Behind a variant's name, the row of its control `faded` (submission/faded.py). No variant has a comma in its name.
FADED = ", faded"
#: A metric's columns in table.csv: its name with each of these behind it.
SUFFIXES = ("", "_std", "_difference", "_difference_std")
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


#: What a run costs on its machine. A mean over GPUs and processors would be of neither.
_OF_THE_MACHINE = ("fit_seconds", "render_fps", "peak_memory_bytes", "peak_device_memory_bytes")

_REFERENCE_NOTE = "control: the background alone"
_FADED_NOTE = "control: the row's own renders of the timesteps before and after, averaged"


@dataclass(frozen=True)
class StudyRun:
    """A run of the plan, with its entry and result where it has been made; `faded`: of the run's control instead."""

    planned: PlannedRun
    entry: RunEntry | None
    result: Result | None
    faded: bool = False

    @property
    def row(self) -> str:
        """The name of its row."""
        return self.planned.variant.name + (FADED if self.faded else "")

    @property
    def status(self) -> str:
        return self.entry.status if self.entry else NOT_RUN

    @property
    def reason(self) -> str:
        return self.entry.reason if self.entry else ""

    @property
    def failed(self) -> bool:
        return self.status not in ("ok", NOT_RUN)

    def value(self, metric: str) -> float | None:
        """The run's figure; None where it has none, and of runs that failed."""
        if self.result is None or self.result.status != "ok":
            return None
        if metric in DERIVED:
            _, over, under = DERIVED[metric]
            top, bottom = self.result.value(over), self.result.value(under)
            return top / bottom if top is not None and bottom else None
        return self.result.value(metric)


@dataclass(frozen=True)
class Cell:
    """One figure of a row; None where it is undefined.

    mean, std: over seeds, of the means over scenes; seeds: these means. difference, difference_std: to the baseline.
    """

    mean: float | None
    std: float | None
    seeds: tuple[float, ...]
    difference: float | None
    difference_std: float | None


@dataclass(frozen=True)
class TableRow:
    """A variant, or the reference: its runs and a cell for each metric. `paper`: what the paper reports of it.

    control: whether it is of a method that is a control, as the reference is, or a variant faded.
    """

    name: str
    note: str
    control: bool
    runs: tuple[StudyRun, ...]
    cells: Mapping[str, Cell]
    paper: Mapping[str, float]

    def count(self, *statuses: str) -> int:
        """How many runs ended with one of `statuses`."""
        return sum(run.status in statuses for run in self.runs)

    @property
    def failed(self) -> tuple[StudyRun, ...]:
        return tuple(run for run in self.runs if run.failed)

    @property
    def mixed(self) -> bool:
        """Whether the method is mixed, by its results: the protocol's filter selects such a method's liquid."""
        return any(run.result is not None and run.result.mixed for run in self.runs)

    @property
    def on_gpu_and_processor(self) -> bool:
        """Whether some of its runs were made on a GPU and others were not: its costs have no mean then."""
        return _on_gpu_and_processor(self.runs)

    @property
    def complete(self) -> bool:
        """Whether every run of the row succeeded."""
        return self.count("ok") == len(self.runs)


@dataclass(frozen=True, eq=False)
class Table:
    """A study's outcome.

    Attributes:
        rows: variants in the spec's order, each with its control `faded` where it has one, then the reference.
        run_frame: a row per run, the columns of runs.csv.
        figures: indexed by row name; a column for each metric with each of SUFFIXES, NaN where there is no figure.
        scenes_of: the scenes that a metric is averaged over, by name.
    """

    plan: StudyPlan
    rows: tuple[TableRow, ...]
    run_frame: pd.DataFrame
    figures: pd.DataFrame
    scenes_of: Mapping[str, tuple[str, ...]]

    @property
    def filtered(self) -> bool:
        """Whether some figure rests on the filter that selects the liquid of mixed methods."""
        named = any(metric_of(name).filtered for name in self.plan.spec.metrics)
        return named and any(row.mixed for row in self.rows)

    @property
    def runs(self) -> tuple[StudyRun, ...]:
        """Every run once: a control `faded` has none of its own."""
        return tuple(run for row in self.rows for run in row.runs if not run.faded)

    @property
    def failed(self) -> tuple[StudyRun, ...]:
        """The runs that failed."""
        return tuple(run for run in self.runs if run.failed)

    @property
    def baseline(self) -> TableRow:
        return next(row for row in self.rows if row.name == self.plan.spec.baseline)


def make_table(plan: StudyPlan, store: Store) -> Table:
    """The table of what is in `store` by now."""
    spec = plan.spec
    notes: dict[str, str] = {}
    runs: dict[str, tuple[StudyRun, ...]] = {}
    for variant in spec.variants:
        planned = [run for run in plan.runs if run.variant.name == variant.name]
        notes[variant.name], runs[variant.name] = variant.note, tuple(_study_run(run, store) for run in planned)
        if variant.unseen:
            name = variant.name + FADED
            notes[name], runs[name] = _FADED_NOTE, tuple(_study_run(run, store, faded=True) for run in planned)
    if plan.reference_row:
        name = plan.reference_row[0].variant.name
        notes[name], runs[name] = _REFERENCE_NOTE, tuple(_study_run(run, store) for run in plan.reference_row)
    run_frame = _run_frame([run for row in runs.values() for run in row], spec.metrics)
    apart = run_frame["variant"].isin([name for name, row in runs.items() if _on_gpu_and_processor(row)])
    compared = run_frame.copy()
    compared.loc[apart, [metric for metric in spec.metrics if metric in _OF_THE_MACHINE]] = float("nan")
    scenes_of = {
        metric: tuple(s.name for s in plan.scenes if s.name in set(run_frame["scene"][run_frame[metric].notna()]))
        for metric in spec.metrics
    }
    means = _scene_means(compared, scenes_of)
    figures = _figures(means, spec.baseline)
    paper = _paper_figures(spec)
    rows = [
        TableRow(
            name=name,
            note=note,
            control=runs[name][0].planned.control or runs[name][0].faded,
            runs=runs[name],
            cells={metric: _cell(metric, figures.loc[name], means.loc[name]) for metric in spec.metrics},
            paper=paper.get(name, {}),
        )
        for name, note in notes.items()
    ]
    return Table(plan, tuple(rows), run_frame, figures, scenes_of)


def _on_gpu_and_processor(runs: Sequence[StudyRun]) -> bool:
    return len({bool(run.result.hardware.get("gpu")) for run in runs if run.result is not None}) > 1


def _study_run(planned: PlannedRun, store: Store, faded: bool = False) -> StudyRun:
    entry = store.entry(planned.digest)
    read = store.faded if faded else store.result
    return StudyRun(planned, entry, read(entry) if entry else None, faded)


def _run_frame(runs: Sequence[StudyRun], metrics: Sequence[str]) -> pd.DataFrame:
    """A row per run. reused_seconds: of fit_seconds, what was spent in an earlier run of the study."""
    records = [run.entry.record if run.entry else None for run in runs]
    columns = {
        "scene": [run.planned.scene.name for run in runs],
        "variant": [run.row for run in runs],
        "seed": [run.planned.seed for run in runs],
        "status": [run.status for run in runs],
        "reason": [run.reason for run in runs],
        **{name: pd.Series([run.value(name) for run in runs], dtype=float) for name in metrics},
        "reused_seconds": [sum(record.reused.values()) if record and record.reused else None for record in records],
        "runs_at_once": pd.array([run.entry.at_once if run.entry else None for run in runs], dtype="Int64"),
        "digest": [run.planned.digest[:16] for run in runs],
        "mixed": [str(run.result.mixed).lower() if run.result else "" for run in runs],
    }
    return pd.DataFrame(columns)


def _scene_means(runs: pd.DataFrame, scenes_of: Mapping[str, Sequence[str]]) -> pd.DataFrame:
    """By variant and seed: each metric's mean over its scenes, NaN where the figure of one is missing."""
    order = pd.MultiIndex.from_frame(runs[["variant", "seed"]].drop_duplicates())
    means = {
        metric: runs.pivot(index=["variant", "seed"], columns="scene", values=metric)
        .reindex(columns=list(scenes))
        .mean(axis=1, skipna=False)
        for metric, scenes in scenes_of.items()
    }
    return pd.DataFrame(means, index=order)


def _figures(means: pd.DataFrame, baseline: str) -> pd.DataFrame:
    """By variant: mean and deviation over seeds, of the figures and of their differences to the baseline's."""
    differences = means - means.loc[baseline].reindex(means.index.get_level_values("seed")).to_numpy()
    differences.loc[baseline] = float("nan")
    seeds, seed_differences = (frame.groupby("variant", sort=False) for frame in (means, differences))
    parts = (seeds.mean(), seeds.std(), seed_differences.mean(), seed_differences.std())
    figures = pd.concat([part.add_suffix(suffix) for part, suffix in zip(parts, SUFFIXES)], axis=1)
    return figures[[f"{metric}{suffix}" for metric in means.columns for suffix in SUFFIXES]]


def _cell(metric: str, figures: pd.Series, means: pd.DataFrame) -> Cell:
    mean, std, difference, difference_std = (_or_none(figures[f"{metric}{suffix}"]) for suffix in SUFFIXES)
    return Cell(mean, std, tuple(means[metric].dropna().tolist()), difference, difference_std)


def _or_none(value: float) -> float | None:
    return None if pd.isna(value) else float(value)


def _paper_figures(spec: StudySpec) -> dict[str, dict[str, float]]:
    """Row -> metric -> what the paper reports, in the metric's unit."""
    if spec.paper is None:
        return {}
    from splashbench.paper_figures import paper_rows

    reported: dict[str, dict[str, Any]] = {
        str(row["method"]): row for row in paper_rows() if row["scene_set"] == spec.paper.scene_set
    }
    names = {variant.name: variant.paper for variant in spec.variants if variant.paper}
    if spec.reference:
        names[spec.reference.method] = spec.reference.method
    return {
        name: {
            metric: float(value) * _PAPER_COLUMNS[metric][1]
            for metric in spec.metrics
            if metric in _PAPER_COLUMNS
            if (value := reported.get(method, {}).get(_PAPER_COLUMNS[metric][0])) is not None
        }
        for name, method in names.items()
    }

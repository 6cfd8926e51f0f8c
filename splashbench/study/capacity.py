"""The capacity study: one method, larger rung for rung, as one plan of runs; and their figures as tables.

Its runs are those of an ordinary study: stored, resumed and scored alike. Training views are scored besides. What the
curves say is in knee.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np
import pandas as pd

from splashbench.errors import SplashbenchError
from splashbench.harness.devices import CPU
from splashbench.harness.discovery import load_method
from splashbench.study.job import ERROR, Store
from splashbench.study.knee import Rung
from splashbench.study.ladder import Ladder, ladder_of
from splashbench.study.plan import PlannedRun, StudyPlan, make_plan
from splashbench.study.spec import SceneEntry, StudySpec, StudyVariant
from splashbench.study.spending import StudyBudget
from splashbench.study.table import StudyRun
from splashbench.study.training_views import TRAINING_METRICS

#: What is scored of test views, and of training views as train_NAME.
QUALITIES = TRAINING_METRICS
#: What a run costs; the first two are what its price is of.
COSTS = ("storage_bytes", "fit_seconds", "dynamic_bytes", "peak_memory_bytes", "primitives_per_frame")
#: The curve of the means over scenes. No scene has this name: it has a space.
MEAN = "mean over scenes"
_LOGARITHMIC = ("storage_bytes", "fit_seconds", "dynamic_bytes", "primitives_per_frame")


@dataclass(frozen=True)
class CapacityPlan:
    """plan: the runs; a variant is a rung. ladder: their settings. rungs: variants' numbers, from 1 on, by name."""

    plan: StudyPlan
    ladder: Ladder
    rungs: Mapping[str, int]


def make_capacity_plan(
    method: str,
    scenes: Sequence[str],
    *,
    preset: str | None = None,
    ladder: Sequence[str] = (),
    base: Mapping[str, Any] | None = None,
    seeds: Sequence[int] = (0,),
    timeout_seconds: float | None = None,
    device: str = CPU,
    gpu_elsewhere: bool | None = None,
) -> CapacityPlan:
    """The runs of `method` on `scenes` on every rung.

    Args:
        ladder: each SETTING=V1,V2,...; empty for the method's own.
        base: settings of every rung, on top of the preset.
        device, gpu_elsewhere: what the method runs on, see `make_plan`.

    Raises SplashbenchError, one line, for a method, preset, setting, value or scene that does not exist or is wrong.
    """
    loaded = load_method(method)
    climbed = ladder_of(loaded, ladder, preset or next(iter(loaded.Config.presets)))
    for name in climbed.columns:
        if name in (base or {}):
            raise SplashbenchError(f"setting {name} is on the ladder and given with --set; leave one out")
    rungs = {f"rung{number}": number for number in range(1, climbed.height + 1)}
    spec = StudySpec(
        name="capacity",
        title="Capacity",
        method=method,
        preset=preset,
        base=dict(base or {}),
        scenes=tuple(SceneEntry(path=entry) for entry in scenes),
        seeds=tuple(seeds),
        metrics=QUALITIES,
        baseline="rung1",
        variants=tuple(StudyVariant(name=name, settings=climbed.settings(number)) for name, number in rungs.items()),
        reference=None,
        timeout_seconds=timeout_seconds,
        device=device,
    )
    return CapacityPlan(make_plan(spec, gpu_elsewhere), climbed, rungs)


def smallest_first(
    capacity: CapacityPlan, store: Store, budget: StudyBudget
) -> Callable[[Sequence[PlannedRun]], Iterator[PlannedRun]]:
    """What orders the missing runs rung by rung, and leaves out those that would not end within `budget`.

    A knee is found from below: a rung says little without those below it.
    """

    def order(missing: Sequence[PlannedRun]) -> Iterator[PlannedRun]:
        for run in sorted(missing, key=lambda run: capacity.rungs[run.variant.name]):  # stable: seeds, then scenes
            if budget.allows(_expected(capacity, store, run)):
                yield run

    return order


def _expected(capacity: CapacityPlan, store: Store, run: PlannedRun) -> float:
    """Seconds that the run may take: as other seeds on its rung, or else as the rung below and its step once more."""
    seconds: dict[int, list[float]] = {}
    for other in capacity.plan.runs:
        entry = store.entry(other.digest) if other.scene.name == run.scene.name else None
        if entry is not None and entry.status != ERROR:
            seconds.setdefault(capacity.rungs[other.variant.name], []).append(entry.seconds)
    means = {rung: fmean(values) for rung, values in seconds.items()}
    number = capacity.rungs[run.variant.name]
    if number in means:
        return means[number]
    below = sorted(rung for rung in means if rung < number)
    if not below:
        return 0.0
    step = means[below[-1]] / means[below[-2]] if len(below) > 1 and means[below[-2]] > 0 else 1.0
    return means[below[-1]] * max(1.0, step)


def capacity_frame(capacity: CapacityPlan, store: Store) -> pd.DataFrame:
    """A row per rung, scene and seed, whether it was run, failed or not.

    Columns: rung, scene, seed, set_SETTING for each of the ladder, status, reason; `COSTS` in stored units (bytes,
    seconds, primitives); psnr (dB), lpips, miou of test views; train_psnr, train_lpips, train_miou of training views,
    train_status, train_reason. NaN where there is no figure.
    """
    rows = []
    for planned in sorted(capacity.plan.runs, key=lambda run: capacity.rungs[run.variant.name]):
        entry = store.entry(planned.digest)
        run = StudyRun(planned, entry, store.result(entry) if entry else None)
        number = capacity.rungs[planned.variant.name]
        training = entry.training if entry else None
        figures = training.metrics if training else {}
        rows.append(
            {"rung": number, "scene": planned.scene.name, "seed": planned.seed}
            | {f"set_{name}": value for name, value in capacity.ladder.row(number).items()}
            | {"status": run.status, "reason": run.reason}
            | {name: _number(run.value(name)) for name in (*COSTS, *QUALITIES)}
            | {f"train_{name}": _number(figures.get(name)) for name in QUALITIES}
            | {"train_status": training.status if training else "", "train_reason": training.reason if training else ""}
        )
    return pd.DataFrame(rows)


def curves(frame: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """By scene, and as `MEAN` where there are several: a row per rung, with means of figures.

    Besides: psnr_std, standard deviation of psnr over seeds, dB; runs, how many there are; ok, how many came through.
    A scene's figures are means over the seeds that came through. Those of `MEAN` are means over seeds of means over
    scenes, of seeds that have the figure on every scene: one over the easier scenes would flatter. Where some seed has
    a PSNR on every rung that has any, rungs are over such seeds alone: from one rung to the next the settings are to
    differ, and not the seeds. Means of costs are geometric, since a cost counts by its doublings.
    """
    found = {str(scene): _curve(rows, 1) for scene, rows in frame.groupby("scene", sort=False)}
    if len(found) > 1:
        found[MEAN] = _curve(frame, len(found))
    return found


def _curve(frame: pd.DataFrame, n_scenes: int) -> pd.DataFrame:
    names = [*COSTS, *QUALITIES, *(f"train_{name}" for name in QUALITIES)]
    values = frame[["rung", "seed", *names]].copy()
    logarithmic = list(_LOGARITHMIC)
    values[logarithmic] = np.log(values[logarithmic].where(values[logarithmic] > 0))
    groups = values.groupby(["rung", "seed"])[names]
    by_seed = groups.mean().where(groups.count() == n_scenes)
    psnr = by_seed["psnr"].unstack("seed").dropna(how="all")
    everywhere = psnr.columns[psnr.notna().all()]
    if len(everywhere):
        by_seed = by_seed[by_seed.index.get_level_values("seed").isin(everywhere)]
    by_rung = by_seed.groupby("rung")
    means = by_rung.mean()
    means[logarithmic] = np.exp(means[logarithmic])
    ok = frame.assign(ok=frame["status"] == "ok").groupby("rung")["ok"]
    return means.assign(psnr_std=by_rung["psnr"].std(), ok=ok.sum(), runs=ok.count())


def rungs_of(curve: pd.DataFrame) -> list[Rung]:
    """The rungs of a curve as knee.py takes them."""
    return [
        Rung(int(number), row["fit_seconds"], row["storage_bytes"], row["psnr"], row["train_psnr"])
        for number, row in curve.iterrows()
    ]


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)

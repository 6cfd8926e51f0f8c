"""How long a benchmark takes, and how much memory and disk, before it starts.

Three sources, the best one first: runs of the method that were made in the same folder; fits recorded in rates.json,
between and beyond their sizes by straight lines, and scaled to this machine by a render of a second; and nothing, which
is said. harness/estimates.py is no source: it knows fits of the same size alone, and none of a study's.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from itertools import pairwise
from statistics import fmean

import numpy as np
from pydantic import BaseModel, ConfigDict

from splashbench.benchmark.budgets import SHRINKS
from splashbench.harness.discovery import load_method
from splashbench.render import rasterize_arrays
from splashbench.scene import Camera, Scene
from splashbench.study.job import Store
from splashbench.study.plan import PlannedRun, StudyPlan
from splashbench.study.stress import NOTHING

_PROBE_GAUSSIANS, _PROBE_SIZE, _PROBE_SECONDS = 20_000, (640, 416), 0.7
# Of a third core and every further one: fits are not spread over them evenly.
_FURTHER_CORES = 0.5
_STEPS = "iterations"


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Recorded(_Strict):
    """Fits of a method and preset, which `source` says the origin of. points: (megapixels of a photograph, seconds) in
    rising order.

    grows_with: what a fit takes longer with, the "iterations" or the "timesteps", of which the points had `amount`.
    memory_points: (megapixels, bytes of memory). cache_bytes: kept in the folder for each scene.
    """

    points: list[tuple[float, float]]
    grows_with: str
    amount: int
    memory_points: list[tuple[float, float]]
    cache_bytes: float = 0.0
    source: str


class Rates(_Strict):
    """rates.json. probe_seconds: of the render that measures a machine, on the recorded one, per core.

    picture_seconds: to render and score a megapixel of a test picture, with LPIPS `lpips_seconds` more; picture_bytes:
    of a submission, for each.
    """

    machine: str
    cores: int
    probe_seconds: float
    picture_seconds: float
    lpips_seconds: float
    picture_bytes: float
    particles_seconds: float
    fits: dict[str, dict[str, Recorded]]


def load_rates() -> Rates:
    """The rates that come with splashbench."""
    return Rates.model_validate_json(files("splashbench.benchmark").joinpath("rates.json").read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Machine:
    """This machine against the recorded one. factor: how many times as long it takes; 1 where it was not measured."""

    cores: int
    factor: float
    probe_seconds: float | None = None

    def share(self, cores: int) -> float:
        """How fast a run with `cores` of its cores is, against one with all."""
        return _effective(cores) / _effective(self.cores)

    def alone(self, at_once: int) -> float:
        """What share of its time a run would take with all cores to itself that was one of `at_once`."""
        return self.share(max(1, self.cores // at_once))


def measure_machine(rates: Rates) -> Machine:
    """Measure this machine by a render, in processor time: what else runs here is not counted."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    seconds = probe()
    return Machine(cores, seconds / rates.probe_seconds * _effective(rates.cores) / _effective(cores), seconds)


def _effective(cores: int) -> float:
    return min(cores, 2) + _FURTHER_CORES * max(0, cores - 2)


def probe() -> float:
    """Processor seconds of one render of 20 000 Gaussians at 640x416, the least of several."""
    rng = np.random.default_rng(0)
    width, height = _PROBE_SIZE
    means = rng.uniform((-1.5, -1, 2), (1.5, 1, 5), (_PROBE_GAUSSIANS, 3)).astype(np.float32)
    factors = (np.eye(3, dtype=np.float32) * 0.02)[None].repeat(_PROBE_GAUSSIANS, axis=0)
    opacities = np.full(_PROBE_GAUSSIANS, 0.5, np.float32)
    colors = rng.random((_PROBE_GAUSSIANS, 3), dtype=np.float32)
    K = np.array([[600.0, 0, width / 2], [0, 600.0, height / 2], [0, 0, 1]])
    camera = Camera("probe", width, height, K, np.eye(4))
    best, end = float("inf"), time.monotonic() + _PROBE_SECONDS
    while time.monotonic() < end or best == float("inf"):
        start = time.process_time()
        rasterize_arrays(means, factors, opacities, colors, camera)
        best = min(best, time.process_time() - start)
    return best


@dataclass
class MethodEstimate:
    """Of one method: runs, those that are there already, and what the others take. seconds: None where unknown.

    basis: what it rests on, in words. beyond: the largest photographs are this many times as large as any recorded.
    """

    label: str
    preset: str
    runs: int = 0
    made: int = 0
    seconds: float | None = 0.0
    memory_bytes: float = 0.0
    basis: str = ""
    beyond: float = 0.0


@dataclass
class Estimate:
    """What the runs that are left take. disk_bytes: in the folder."""

    methods: list[MethodEstimate]
    scenes: int
    disk_bytes: float
    machine: Machine

    @property
    def seconds(self) -> float:
        """Of all known runs that are left, one after another."""
        return sum(each.seconds or 0.0 for each in self.methods)

    def seconds_at_once(self, jobs: int, cores: int | None = None) -> float:
        """The same for `jobs` runs at a time, of `cores` threads each; None for as many as each has to itself.

        More runs at a time gain what a machine's further cores are worth to a run of their own: nothing on two cores.
        """
        there = self.machine.cores
        each = min(cores or max(1, there // jobs), there)
        return self.seconds / (self.machine.share(each) * min(jobs, there / each))

    @property
    def memory_bytes(self) -> float:
        """The most that a known run takes."""
        return max((each.memory_bytes for each in self.methods), default=0.0)

    @property
    def unknown(self) -> list[str]:
        """Methods of which nothing is known."""
        return [each.label for each in self.methods if each.seconds is None]

    @property
    def left(self) -> int:
        """How many runs are to be made."""
        return sum(each.runs - each.made for each in self.methods)


def estimate(plan: StudyPlan, store: Store, rates: Rates, machine: Machine, with_lpips: bool) -> Estimate:
    """What the runs of `plan` that are not in `store` take on `machine`, one at a time."""
    sizes = {named.name: _Size.of(named.scene) for named in plan.scenes}
    rows: dict[str, list[PlannedRun]] = {}
    for run in (*plan.reference_row, *plan.runs):
        rows.setdefault(run.variant.name, []).append(run)
    found = [_row(name, runs, sizes, store, rates, machine, with_lpips) for name, runs in rows.items()]
    return Estimate([row for row, _ in found], len(plan.scenes), sum(disk for _, disk in found), machine)


@dataclass(frozen=True)
class _Size:
    """Of a scene: megapixels of a training photograph, on the mean; of all test pictures; the longest side, pixels."""

    photograph: float
    test: float
    side: int
    timesteps: int

    @classmethod
    def of(cls, scene: Scene) -> _Size:
        of = {name: camera.width * camera.height / 1e6 for name, camera in scene.cameras.items()}
        side = max(max(camera.width, camera.height) for camera in scene.cameras.values())
        test = sum(of[name] for name in scene.test) * scene.n_frames
        return cls(fmean(of[name] for name in scene.train), test, side, scene.n_frames)


def _row(
    name: str,
    runs: Sequence[PlannedRun],
    sizes: dict[str, _Size],
    store: Store,
    rates: Rates,
    machine: Machine,
    with_lpips: bool,
) -> tuple[MethodEstimate, float]:
    """The estimate of a row, and bytes that its runs that are left leave on the disk."""
    first = runs[0]
    method = load_method(first.method)
    config = method.Config.preset(first.preset, dict(first.overrides)).model_dump(mode="json")
    recorded = rates.fits.get(method.id, {}).get(first.preset)
    row = MethodEstimate(name, first.preset, len(runs))
    disk, ratios, per_work, left = 0.0, [], [], []
    for run in runs:
        size = sizes[run.scene.name]
        shown = min(1.0, (config.get(SHRINKS, size.side) / size.side) ** 2) * size.photograph
        expected = None
        if recorded is not None:
            expected = machine.factor * (_fit_seconds(recorded, config, shown, size) + _score(rates, size, with_lpips))
            row.memory_bytes = max(row.memory_bytes, _line(recorded.memory_points, shown))
            row.beyond = max(row.beyond, shown / recorded.points[-1][0])
        entry = store.entry(run.digest)
        if entry is not None and entry.status == "ok":
            row.made += 1
            # Those that shared the machine had fewer cores.
            seconds = entry.seconds * machine.alone(entry.at_once)
            per_work.append(seconds / max(size.test, 1e-6))
            if expected:
                ratios.append(seconds / expected)
        else:
            left.append((expected, size.test))
            if recorded is not None:
                disk += recorded.cache_bytes * size.timesteps / 50
            if first.method == NOTHING:  # references stay: others are measured against their renders
                disk += size.test * rates.picture_bytes
    if not left:
        row.seconds, row.basis = 0.0, "all of its runs are there"
    elif ratios:
        row.seconds = fmean(ratios) * sum(expected or 0.0 for expected, _ in left)
        row.basis = f"{len(ratios)} of its runs, made here"
    elif recorded is not None:
        row.seconds = sum(expected or 0.0 for expected, _ in left)
        row.basis = recorded.source
    elif per_work:
        row.seconds = fmean(per_work) * sum(test for _, test in left)
        row.basis = f"{len(per_work)} of its runs, made here"
    else:
        row.seconds, row.basis = None, "nothing: no run of it was recorded, and none was made here yet"
    return row, disk


def _fit_seconds(recorded: Recorded, config: dict, megapixels: float, size: _Size) -> float:
    seconds = _line(recorded.points, megapixels)
    amount = config.get(_STEPS, recorded.amount) if recorded.grows_with == _STEPS else size.timesteps
    return seconds * float(amount) / recorded.amount


def _score(rates: Rates, size: _Size, with_lpips: bool) -> float:
    per_megapixel = rates.picture_seconds + (rates.lpips_seconds if with_lpips else 0.0)
    return per_megapixel * size.test + rates.particles_seconds * size.timesteps / 50


def _line(points: Sequence[tuple[float, float]], x: float) -> float:
    """The value at `x` of straight lines through `points`, the last one going on; below the first, as at the first."""
    if x <= points[0][0] or len(points) == 1:
        return points[0][1]
    for (x0, y0), (x1, y1) in pairwise(points):
        if x <= x1 or (x1, y1) == tuple(points[-1]):
            return y0 + (y1 - y0) * (x - x0) / (x1 - x0)
    raise AssertionError("the last line goes on")


def as_json(found: Estimate) -> dict:
    """The estimate for programs. seconds: one run after another, each with all cores."""
    return {
        "scenes": found.scenes,
        "runs_left": found.left,
        "seconds": found.seconds,
        "memory_bytes": found.memory_bytes,
        "disk_bytes": found.disk_bytes,
        "machine_factor": found.machine.factor,
        "cores": found.machine.cores,
        "unknown": found.unknown,
        "methods": [asdict(each) for each in found.methods],
    }

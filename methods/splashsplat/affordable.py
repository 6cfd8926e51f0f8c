"""What of the method a budget of seconds or bytes leaves room for: grids before the fit, and a clock for the fit.

How long a reconstruction on a finer grid takes is told from how long a coarse one took on the same scene and machine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from splashbench.harness.contract import Decision, Run, Rung
from splashbench.scene.scene import TrainingScene

from .fields.container import KnownContainer
from .settings import SplashSplatConfig
from .smaller import draft_of
from .trace import Traced, trace_liquid

# Hull cells along the longest side that may be chosen.
_CELLS = (128, 160, 200, 240, 300)
# By how much longer a trace takes than the draft's, at as many cells; and how that grows with cells along a side.
# Budgets were measured with these (docs/results/capacity.md). Four traces of opaque_bowl and glass_tank by version 19
# took 1.8 to 2.1 times the draft's at as many cells, by version 18 1.8 to 2.4 times: `_BEFORE` is so much exceeded.
_LONGER, _EXPONENT = 1.35, 2.15
# Share of the seconds that what comes before the appearance may take.
_BEFORE = 0.4
# Below so many seconds there is the draft's background, below so many `quick`'s.
_DRAFT_BACKGROUND, _QUICK_BACKGROUND = 45.0, 120.0
# Seconds from which self-calibration is no large part of a fit: it takes 2 to 5 at 240x160, and 23 to 49 at 1200x1800.
_SELF_CALIBRATION, _SELF_CALIBRATION_MEGAPIXEL = 30.0, 125.0
# Bytes of a background anchor as it is stored, and the share of a byte budget for all of them.
_ANCHOR_BYTES, _BACKGROUND_SHARE = 52, 0.25
# Bytes of a carrier's values, about; a track that takes more than this much of its room is traced anew, coarser.
_VALUE_BYTES, _TOO_LARGE = 3.9, 1.5
# Share of the carriers that the fit leaves.
_LEFT = 0.5
# Traces of one scene, and cells along a side, at the least.
_TRACES, _FEWEST = 4, 32


@dataclass(frozen=True)
class Affordable:
    """config: what the budget allows. traced: where it was traced on the way."""

    config: SplashSplatConfig
    traced: Traced | None = None


def affords_self_calibration(scene: TrainingScene, run: Run) -> bool:
    """Whether the budget of seconds leaves time to look for clocks, cameras, exposures and masks that are off."""
    seconds = run.budget.seconds
    megapixels = max(camera.width * camera.height for camera in scene.cameras.values()) / 1e6
    least = max(_SELF_CALIBRATION, _SELF_CALIBRATION_MEGAPIXEL * megapixels)
    affords = seconds is None or seconds >= least
    if not affords:
        run.decide(
            Decision(
                name="self-calibration",
                basis="budget",
                chosen="left out",
                because=f"{seconds:g} s are to be kept, and it is worth its time from {least:.0f} s on",
            )
        )
    return affords


def within_seconds(
    scene: TrainingScene, config: SplashSplatConfig, run: Run, known: KnownContainer | None = None
) -> Affordable:
    """The finest grids whose trace leaves most of `run.budget.seconds` to the appearance; `config` without a budget.

    known: the container, where it was looked for already. The draft's trace is made to tell how long others take, and
    taken where no other is affordable.
    """
    seconds = run.budget.seconds
    if seconds is None:
        return Affordable(config)
    start = run.seconds
    draft = draft_of(config)
    traced = trace_liquid(scene, draft, run, known)
    took = max(run.seconds - start, 1e-3)
    cells = max(traced.observations.hull_grid.shape) - 1
    left = seconds - run.seconds
    full = _cells_of(traced, config)
    options = sorted({min(option, full) for option in _CELLS})
    predicted = {option: _LONGER * took * (option / cells) ** _EXPONENT for option in options}
    # The draft's carriers are those of one variant of the method.
    least = None if config.variant == "full" else options[0]
    chosen = max((option for option in options if predicted[option] <= _BEFORE * left), default=least)
    rungs = [Rung(value=f"draft, {cells} cells", bought=chosen is None, seconds=took)]
    rungs += [
        Rung(value=f"{option} cells", bought=option == chosen, seconds=predicted[option] - took) for option in options
    ]
    run.decide(
        Decision(
            name="grids for the seconds",
            basis="budget",
            chosen=f"{cells} cells, as the draft" if chosen is None else f"{chosen} cells",
            because=f"a trace may take {100 * _BEFORE:.0f} % of what is left of {seconds:g} s, and the draft's took "
            f"{took:.1f} s",
            rungs=rungs,
        )
    )
    if chosen is None:
        longer = traced.config.model_copy(update={"iterations": config.iterations})
        if run.budget.storage_bytes is not None:  # how little may be stored is measured then, too
            longer = longer.model_copy(update={"storage_tolerance": config.storage_tolerance})
        return Affordable(longer, replace(traced, config=longer))
    return Affordable(with_cells(config, chosen))


def _cells_of(traced: Traced, config: SplashSplatConfig) -> int:
    """Hull cells along the longest side that `config` has on a scene whose draft was `traced`."""
    cells = max(traced.observations.hull_grid.shape) - 1
    # By the pixels that a voxel of the draft spans, unless there were too many or too few for that.
    draft = draft_of(config)
    if config.voxel_pixels == 0 or cells >= draft.hull_cells or cells <= draft.fewest_cells:
        return config.hull_cells
    return min(config.hull_cells, max(config.fewest_cells, round(cells * draft.voxel_pixels / config.voxel_pixels)))


def with_cells(config: SplashSplatConfig, hull_cells: int) -> SplashSplatConfig:
    """`config` on grids of at most `hull_cells` along the longest side, the others in proportion."""
    share = hull_cells / config.hull_cells
    if share >= 1:
        return config
    return config.model_copy(
        update={
            "hull_cells": hull_cells,
            "transport_cells": max(16, round(share * config.transport_cells)),
            "control_cells": max(4, round(share * config.control_cells)),
            "fewest_cells": max(16, min(config.fewest_cells, hull_cells)),
        }
    )


def within_bytes(
    config: SplashSplatConfig, run: Run, trace: Callable[[SplashSplatConfig], Traced], first: Traced | None = None
) -> Traced:
    """What `trace` gives for `config`, or on coarser grids where that could not be stored within the run's budget.

    first: what it gave for `config` already.
    """
    traced = first or trace(config)
    limit = run.budget.storage_bytes
    if limit is None:
        return traced
    occlusion = traced.observations.occlusion
    beside = 0 if occlusion is None else occlusion.stored_bytes
    room = max((1 - _BACKGROUND_SHARE) * limit - beside, 1.0)
    rungs: list[Rung] = []
    first_size = stored_estimate(traced)
    for left in reversed(range(_TRACES)):
        cells = max(traced.observations.hull_grid.shape) - 1
        size = stored_estimate(traced)
        last = size <= _TOO_LARGE * room or cells <= _FEWEST or left == 0
        rungs.append(Rung(value=f"{cells} cells, {size / 1e6:.2f} MB", bought=last, bytes=size - first_size))
        if last:
            break
        fewer = max(_FEWEST, round(cells * (room / size) ** 0.5))
        exactly = {"observable": False, "voxel_pixels": 0.0, "clear_voxel_pixels": 0.0}
        config = with_cells(config, fewer).model_copy(update=exactly)
        traced = trace(config)
    if len(rungs) > 1:
        run.decide(
            Decision(
                name="grids for the bytes",
                basis="budget",
                chosen=rungs[-1].value,
                because=f"{room / 1e6:.2f} MB are left beside the background",
                rungs=rungs,
            )
        )
    return traced


def stored_estimate(traced: Traced) -> float:
    """Bytes that the liquid will take, about: half of the carriers are pruned by the fit."""
    files = traced.track_bytes
    carriers = files["carriers"] + _VALUE_BYTES * traced.track.carriers.count
    return files["motion"] + files["distance"] + _LEFT * carriers


def background_update(config: SplashSplatConfig, run: Run) -> dict[str, int]:
    """Settings of the background that the run's budget asks for."""
    own = config.background
    update: dict[str, int] = {}
    seconds, size = run.budget.seconds, run.budget.storage_bytes
    if seconds is not None and seconds < _DRAFT_BACKGROUND:
        update = {"iterations": 80, "longest_side": 160, "max_anchors": 5000}
    elif seconds is not None and seconds < _QUICK_BACKGROUND:
        update = {"iterations": 400, "longest_side": 400, "max_anchors": 5000}
    if size is not None:
        most = max(100, int(_BACKGROUND_SHARE * size / _ANCHOR_BYTES))
        update["max_anchors"] = min(most, update.get("max_anchors", own.max_anchors))
    smaller = {name: value for name, value in update.items() if value < getattr(own, name)}
    if smaller:
        words = ", ".join(f"{name} {value}" for name, value in smaller.items())
        rungs = [
            Rung(value=f"{name} {number}", bought=number == value)
            for name, value in smaller.items()
            for number in (getattr(own, name), value)
        ]
        limit = f"{seconds:g} s" if seconds is not None else f"{(size or 0) / 1e6:.2f} MB"
        run.decide(
            Decision(
                name="background for the budget",
                basis="budget",
                chosen=words[:100],
                because=f"{limit} are to be kept",
                rungs=rungs,
            )
        )
    return smaller

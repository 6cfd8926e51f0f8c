"""Settings of the optimisation of the appearance, which fitting.py makes."""

from __future__ import annotations

from dataclasses import dataclass, field

from . import losses


@dataclass(frozen=True)
class FitSettings:
    """Settings of the optimisation.

    iterations: at most. ssim_every: the SSIM term enters every so many of them, weighted up by as much. anneal:
    whether the learning rates fall along a half cosine, where the schedule is fixed. validation_share: of the
    photographs, withheld to tell when to let them fall (schedule.py); 0 for a schedule that is fixed. handed_on:
    they are withheld for a fit that goes on from this one, and the schedule is fixed. stop_gain: see
    `AdaptiveSchedule`. price: see `EarningSchedule`, which is taken where it is above 0. prune_opacity: carriers
    whose learned opacity is below this at one of `_PRUNINGS` (fitting.py) are not fitted any further; 0 fits all to
    the end. idle_share: carriers that together make up no more of a photograph than this are not fitted to it;
    which they are is looked at at `_FOCUSINGS`. idle_early: at `_EARLY_FOCUSING` as well, and once each photograph
    was seen a single time. feature_cells, still_cell: see `SharedFeatures`; learning_rate_cells is that of the
    shared parts. coarse_share: of the iterations, the first ones, that see targets at half their size where these
    have one; coarsest_share: of all, the first ones, that see them at a quarter. plates_share: of the iterations,
    the first ones, for which the background is not needed yet. measured_share: of the iterations, the last ones, in
    which it is measured how much photographs change with what is learned. begun: of the iterations, the first ones,
    that another fit has made (warm_start.py), where the schedule is fixed or an earning one.
    """

    iterations: int = 1000
    begun: int = 0
    validation_share: float = 0.0
    handed_on: bool = False
    stop_gain: float = 0.01
    price: float = 0.0
    learning_rate_features: float = 0.06
    learning_rate_cells: float = 0.02
    feature_cells: tuple[float, ...] = ()
    still_cell: float = 0.0
    learning_rate_heads: float = 0.015
    learning_rate_scales: float = 1e-2
    anneal: bool = True
    ssim_every: int = 1
    base_scale: float = 0.35
    prune_opacity: float = 0.0
    idle_share: float = 0.0
    idle_early: bool = False
    coarse_share: float = 0.0
    coarsest_share: float = 0.0
    plates_share: float = 0.0
    measured_share: float = 0.0
    weights: losses.LossWeights = field(default_factory=losses.LossWeights)

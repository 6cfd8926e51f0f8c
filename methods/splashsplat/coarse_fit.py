"""The first part of the fit, on coarse grids. Not in the paper.

A trace on fine grids takes about as long as this whole part, and has nothing to show. What is learned here is what the
carriers of the fine grids begin with (appearance/warm_start.py). They go on with its schedule.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from splashbench.harness.contract import Run
from splashbench.scene.scene import TrainingScene

from .appearance.warm_start import Learned
from .fields.container import KnownContainer
from .fields.observations import Sightings
from .reconstruction import Offer, Reconstruction, fit_liquid
from .settings import SplashSplatConfig
from .smaller import coarse_of
from .trace import trace_liquid

# Share of it that the trace takes, for the progress bar only.
_TRACE = 0.4
# What is not shown of it where Gaussians show what is behind them, in photographs seen: in glass these states are up to
# half a decibel below the draft.
_BELOW_DRAFT = 0.35


def begins_on_coarse_grids(scene: TrainingScene, config: SplashSplatConfig, run: Run) -> bool:
    """Whether the fit of `scene` by `config` has such a part: where photographs are small, learning rates fall from the
    start on, there is no budget, and plates stand for the background at first."""
    plates = config.plates_share > 0 and config.composition != "together"
    falling = (config.validation_share == 0 or config.price > 0) and not run.budget.limits
    longest = max(max(camera.width, camera.height) for camera in scene.cameras.values())
    return plates and falling and config.coarse_iterations > 0 and longest <= config.coarse_grids_side


def fit_coarsely(
    scene: TrainingScene,
    config: SplashSplatConfig,
    run: Run,
    known: KnownContainer | None,
    before: Sightings,
    behind: dict[str, np.ndarray],
    offer: Offer | None,
    span: tuple[float, float],
) -> list[Learned]:
    """What the first iterations by `config` teach, on coarse grids, to be taken out of the list, as it is large. It is
    empty where these grids show nothing that a photograph could teach.

    known, before: see `observe`. behind: float32 [H, W, 3] of every training view, what lies behind the liquid.
    offer: see `fit_liquid`. span: the part of `run`'s progress this takes up.
    """
    middle = span[0] + _TRACE * (span[1] - span[0])
    # What the observations say is noted by the fine ones.
    traced = trace_liquid(scene, coarse_of(config), run.aside((span[0], middle)), known, before)
    if offer is not None and config.draft_cells > 0 and config.transmission == "always":
        offer = _without_first(offer, round(_BELOW_DRAFT * len(scene.train) * scene.n_frames))
    learned: list[Learned] = []
    found = fit_liquid(scene, behind, traced, run.aside((middle, span[1])), offer=offer, keep=learned.append)
    if learned and offer is not None:
        offer(lambda: found, True)
    return learned


def _without_first(offer: Offer, count: int) -> Offer:
    """`offer` from its call number `count` on, but for states that are to stand."""
    calls = itertools.count()

    def later(found: Callable[[], Reconstruction], milestone: bool) -> None:
        if next(calls) >= count or milestone:
            offer(found, milestone)

    return later

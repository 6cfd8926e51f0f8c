"""From masks to the fitted liquid: observation fields, motion, carriers, appearance (paper, Fig. "pipeline").

Each name stands for a folder: `fields` observes the whole sequence, `motion` gives one observed frame after another
with what moved the liquid there, `carriers` follow frame by frame, and `appearance` is fitted to the photographs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from splashbench.files import compressed_bytes
from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.harness.contract import Run
from splashbench.native import memory
from splashbench.render import Frozen
from splashbench.render.constants import MIN_ALPHA
from splashbench.scene.scene import TrainingScene

from .appearance.coarse import set_smaller_backgrounds
from .appearance.fitting import Appearance, Fit, fit_appearance, visible_carriers
from .appearance.iterations import iterations_decision
from .appearance.schedule import Clock
from .appearance.sensitivity import Sensitivity
from .appearance.targets import Views, release_backgrounds, set_backgrounds
from .appearance.warm_start import Learned
from .beginning import Beginning, begin
from .carriers.subframe import Track
from .fields.occlusion import LiquidOcclusion
from .model import UNKNOWN_STEP, Liquid
from .settings import SplashSplatConfig
from .storage.looks import learned_values
from .storage.packing import pack_distance, packed_bytes
from .storage.steps import Storage, Stored
from .storage.track import carrier_arrays, track_arrays
from .trace import Traced

#: The liquid, and what hides it from cameras.
Reconstruction = tuple[Liquid, LiquidOcclusion | None]
#: Is given what makes it as it is on the way, and whether there will be no other for a while.
Offer = Callable[[Callable[[], Reconstruction], bool], None]

# Share of the seconds left for the appearance that storing it takes, and seconds beside.
_STORING, _STORING_LEAST = 0.03, 1.0
# Bytes of liquid.json and of the decoder's heads, roundly.
_HEADER = 12_000


def _clock(run: Run) -> Clock | None:
    """When the appearance has to be done, by the run's budget: storing takes a share of what is left for it."""
    if run.budget.seconds is None:
        return None
    left = max(run.budget.seconds - run.seconds, 0.0)
    return Clock(lambda: run.seconds, run.budget.seconds - min(_STORING * left + _STORING_LEAST, 0.5 * left))


def fit_liquid(
    scene: TrainingScene,
    backgrounds: dict[str, np.ndarray],
    traced: Traced,
    run: Run,
    span: tuple[float, float] = (0.0, 1.0),
    frozen: Mapping[str, Frozen] | None = None,
    offer: Offer | None = None,
    settled: Callable[[], Views] | None = None,
    room: Callable[[], int] | None = None,
    learned: list[Learned] | None = None,
    keep: Callable[[Learned], None] | None = None,
) -> Reconstruction:
    """Fit the appearance of the liquid of `scene`; returns it, and what hides it from cameras.

    backgrounds: float32 [H, W, 3] of every training view, in [0, 1], and emptied once nobody needs them any more
    (`settled`); or [3] where `frozen` has the background's Gaussians of every view, to be drawn together with the
    liquid's. span: the part of `run`'s progress this takes up. offer: is given, after iterations of the appearance,
    what makes the reconstruction as if the fit ended there, and whether there will be no other for a while. settled:
    where given, `backgrounds` are for the first iterations (`plates_share`), and this gives those for the others, as
    often as it is asked.
    room: where given, the bytes that the liquid may take, asked for at the end. learned: on coarser grids, to begin
    with; taken out of the list, as it is large. keep: is given what was learned of all carriers, where there is any
    photograph.
    """
    config, occlusion = traced.config, traced.observations.occlusion
    if occlusion is not None and frozen is not None:
        occlusion = occlusion.uncut()  # the background's Gaussians hide what is behind them themselves
    composition = config.composition if frozen is not None else "over"

    def reconstruction(
        appearance: Appearance, left: np.ndarray, sensitivity: Sensitivity | None = None, step: float | None = None
    ) -> Reconstruction:
        kept, look = _pruned(traced.track, appearance, left)
        made = (scene.times, kept, look, config.carried, composition, config.between_frames)
        if sensitivity is None or step is None:
            return Liquid.of(*made), occlusion
        return Liquid.of(*made, sensitivity.kept(np.flatnonzero(left)), step), occlusion

    def shown(appearance: Appearance, left: np.ndarray) -> np.ndarray:
        return left & visible_carriers(appearance, config.prune_opacity)

    def as_it_is(appearance: Appearance, left: np.ndarray) -> Reconstruction:
        return reconstruction(appearance, shown(appearance, left))

    def offer_state(state: Callable[[], tuple[Appearance, np.ndarray]], milestone: bool) -> None:
        assert offer is not None
        offer(lambda: as_it_is(*state()), milestone)

    with run.stage("appearance"), one_torch_thread():
        beginning = begin(
            scene, backgrounds, traced, occlusion, frozen, run.seed, run.device, learned, keep is not None
        )
        fit = _fit(
            beginning, traced, backgrounds, run, span, None if offer is None else offer_state, settled, _clock(run)
        )
    appearance = beginning.appearance
    memory.forget()  # what comes has other sizes
    if keep is not None and fit is not None:
        keep(Learned(traced.track, appearance, beginning.look))
    del beginning  # large: its photographs go with the fit, and nobody asks again how they look
    if fit is not None and fit.earned:
        run.decide(iterations_decision(fit.earned, fit.begun + len(fit.losses)))
    if fit is None:
        return reconstruction(appearance, np.ones(traced.track.carriers.count, dtype=bool))
    left = shown(appearance, fit.left)
    sensitivity = fit.sensitivity
    if sensitivity is None and room is not None:
        # The bytes are to be kept, though nobody looked at how much values matter, or the fit ended before that.
        sensitivity = Sensitivity.of_spread(learned_values(appearance))
        fit = replace(fit, sensitivity=sensitivity)
    if sensitivity is None:
        return reconstruction(appearance, left)
    with run.stage("storing"), one_torch_thread():
        memory.give_back()
        taken = 0 if occlusion is None else occlusion.stored_bytes
        within = None if room is None else room() - taken
        stored = _within_tolerance(traced.track, appearance, left, fit, config, run, within)
        del fit  # large: the photographs, and what was known of all carriers
        memory.forget()
        return reconstruction(appearance, stored.kept, sensitivity, stored.step)


def _within_tolerance(
    track: Track,
    appearance: Appearance,
    left: np.ndarray,
    fit: Fit,
    config: SplashSplatConfig,
    run: Run,
    room: int | None,
) -> Stored:
    """How the carriers `left` (bool [count]) are stored. room: where given, the bytes that the liquid may take."""
    storage = Storage(appearance, left, fit, run.seed)
    stored = Stored(left, UNKNOWN_STEP)
    if config.storage_tolerance > 0:
        stored, decision = storage.within_tolerance(config.storage_tolerance)
        run.decide(decision)
    if room is None:
        return stored
    arrays = track_arrays(track, config.carried)
    fixed = _HEADER + packed_bytes(arrays["motion"]) + compressed_bytes(pack_distance(track.phi))

    def other_bytes(kept: np.ndarray) -> int:
        return fixed + packed_bytes(carrier_arrays(track, track.carriers.keep(kept)[0], config.carried))

    stored, spent = storage.within_room(room - _glass_bytes(appearance), stored, other_bytes)
    if spent is not None:
        run.decide(spent)
    return stored


def _glass_bytes(appearance: Appearance) -> int:
    """How much of the files glass takes, at the most."""
    tables = {} if appearance.glass is None else appearance.glass.tables
    return sum(2 * table.numel() for table in tables.values())


def _fit(
    beginning: Beginning,
    traced: Traced,
    backgrounds: dict[str, np.ndarray],
    run: Run,
    span: tuple[float, float],
    offer: Callable[[Callable[[], tuple[Appearance, np.ndarray]], bool], None] | None,
    settled: Callable[[], Views] | None,
    clock: Clock | None,
) -> Fit | None:
    """Fit the appearance of the `beginning` to its photographs, in place; None where there are none. The others: see
    `fit_liquid` and `fit_appearance`."""
    targets, observations = beginning.targets, traced.observations
    if not targets:
        return None

    # Large images are behind the smaller photographs alone until the others teach.
    begins_small = targets[0].coarse is not None
    if settled is not None and begins_small and beginning.settings.plates_share <= beginning.settings.coarse_share:
        release_backgrounds(targets)
        backgrounds.clear()

    def settle() -> None:
        if settled is not None:
            # Nobody needs those of before, which are as large as those to come.
            release_backgrounds(targets)
            backgrounds.clear()
            put = set_backgrounds if targets[0].coarse is None else set_smaller_backgrounds
            put(targets, settled(), run.device)

    def enlarge() -> None:
        if settled is not None and begins_small:
            set_backgrounds(targets, settled(), run.device)

    return fit_appearance(
        beginning.appearance,
        traced.track,
        targets,
        beginning.settings,
        observations.hull_grid.voxel / observations.grid.voxel,
        run.seed,
        lambda done: run.progress(span[0] + (span[1] - span[0]) * done, "appearance"),
        offer,
        settle,
        enlarge,
        clock,
        run.device,
    )


def _pruned(track: Track, appearance: Appearance, kept: np.ndarray) -> tuple[Track, Appearance]:
    """The carriers `kept` (bool [count]) alone, and the glass that can be seen."""
    carriers, rows = track.carriers.keep(kept)
    glass = None if appearance.glass is None else appearance.glass.kept(MIN_ALPHA)
    look = Appearance(appearance.features[rows], appearance.log_scales[rows], appearance.decoder, glass)
    return replace(track, carriers=carriers), look

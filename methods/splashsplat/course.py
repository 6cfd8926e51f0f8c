"""The course of a fit: which part is made when, and what can be shown after each (`run --checkpoints`).

What is behind the liquid, and where the liquid is, do not need each other. Which of both is made first decides how soon
there is something good to see:

- A draft comes first of all where states of the fit are taken (draft.py). Nothing of it enters the fit.
- With coarse grids (coarse_fit.py), the background comes before them where the liquid is transparent, since what is
  behind it is seen then. Else it comes once the fine grids have something to show, and clean plates stand for it.
- Without them, the first iterations have clean plates behind the liquid, or all have the background (`plates_share`).

The parts' results are the same on any number of cores, which decide only what is made beside what.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from splashbench.container.footage_vessel import Standing, standing_about_liquid, standing_roughly
from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.harness.contract import Decision, Run
from splashbench.parallel import thread_count
from splashbench.processes import resident_bytes
from splashbench.render import Frozen, freeze
from splashbench.scene.scene import TrainingScene
from splashbench.scene.small_scene import smaller
from splashbench.selfcalibration import hardly_masked, self_calibration

from .affordable import affords_self_calibration, background_update, within_bytes, within_seconds
from .affordable_memory import within_memory
from .appearance.targets import Views
from .appearance.warm_start import Learned
from .coarse_fit import begins_on_coarse_grids, fit_coarsely
from .draft import State, make_draft
from .fields.container import KnownContainer, known_container
from .fields.observations import Sightings
from .reconstruction import Reconstruction, fit_liquid
from .settings import SplashSplatConfig
from .trace import Traced, trace_liquid
from .transmittance import transmittance

if TYPE_CHECKING:
    from ..scaffold_gs import Background, Plates

#: What lies behind the liquid in each training view, float32 [H, W, 3].
Backgrounds = dict[str, np.ndarray]

# Share of the background that shows through the liquid from which on it comes before coarse grids, and that from which
# on Gaussians show it: it is .6 in clear water, .2 to .4 in dyed water in a tank, and .03 at the most in paint.
_TRANSPARENT, _TRANSMITS = 0.5, 0.1
# Shares of the time that a background takes that comes first, the fit on coarse grids, and everything else before the
# fine appearance, for the progress bar only.
_BACKGROUND, _COARSE, _BEFORE = 0.15, 0.2, 0.35
# Photographs of a draft are smaller than twice this, in pixels: large ones took it two minutes.
_DRAFT_SIDE = 400


class Course:
    """One fit of `scene` by `config`.

    show: is given what makes a state, as if the fit ended there, and whether there will be no other for a while.
    """

    def __init__(
        self,
        scene: TrainingScene,
        config: SplashSplatConfig,
        run: Run,
        show: Callable[[Callable[[], State], bool], None],
    ) -> None:
        self._scene, self._config, self._run = scene, config, run
        self._show = show if run.watched else None
        # Of the process before the fit, which a budget of memory has to know.
        self._loaded = 0 if run.budget.memory_bytes is None else sum(resident_bytes(os.getpid()).values())
        self._masked = not hardly_masked(scene)
        self._known: KnownContainer | None = None
        # What coarse and fine grids are told by the same masks.
        self._sightings: Sightings = {}
        self._plates: Callable[[], Plates] = _plates_of(scene)
        self._transmittance: float | None = None
        # Of its settings, those that a budget asks for.
        self._smaller_background: dict[str, int] = {}
        # What is shown until there is something better; large.
        self._drafted: State | None = None
        # What lies behind the liquid in what is shown, once there is anything.
        self._background: Background | None = None

    def taken(self) -> State:
        """The whole fit."""
        if not self._masked:
            # Without the masks that this finds there is nothing that a draft could be made of.
            self._calibrate()
        if self._show is not None and self._config.draft_cells > 0:
            self._drafted = self._draft(self._show)
            self._background = self._drafted[1]
        if self._masked:
            self._calibrate()
        if begins_on_coarse_grids(self._scene, self._config, self._run):
            return self._from_coarse_grids()
        self._drafted = None
        return self._at_once()

    def _draft(self, show: Callable[[Callable[[], State], bool], None]) -> State:
        run, scene = self._run, smaller(self._scene, _DRAFT_SIDE)
        plates = self._plates if scene is self._scene else _plates_of(scene)
        known = self._rough_container(scene, plates)
        run.progress(0, "draft")
        with run.stage("draft"):
            shows_through = self._shows_through() if scene is self._scene else transmittance(scene, plates())
            opaque, config = shows_through < _TRANSPARENT, _transmission_settled(self._config, shows_through)
            return make_draft(scene, config, run.aside(), known, plates, opaque, show)

    def _calibrate(self) -> None:
        """From now on the scene as it is found to be."""
        run = self._run
        if not self._config.self_calibration or (self._masked and not affords_self_calibration(self._scene, run)):
            return
        with run.stage("self-calibration"):
            found = self_calibration(self._scene, self._plates, lambda what: run.progress(0, what))
        if lines := found.lines(self._scene.cameras):
            run.note("self-calibration", "; ".join(lines))
        if found:
            self._scene, self._known, self._transmittance = found.scene(self._scene), None, None
            self._plates = _plates_of(self._scene)

    def _rough_container(self, scene: TrainingScene, plates: Callable[[], Plates]) -> KnownContainer:
        """For a draft of `scene`, which does not wait for what takes the footage longer to tell."""
        asked = False

        def roughly() -> Standing:
            nonlocal asked
            asked = True
            return standing_roughly(scene, plates())

        known = self._look_for_container(roughly)
        if not asked:
            self._known = known
        return known

    def _container(self) -> KnownContainer:
        """Looked for once, for all traces."""
        if self._known is None:
            self._known = self._look_for_container(lambda: standing_about_liquid(self._scene, self._plates()))
        return self._known

    def _look_for_container(self, standing: Callable[[], Standing]) -> KnownContainer:
        config = self._config
        footage = standing if config.container_footage else None
        with self._run.stage("container"):
            return known_container(self._scene, config.container, config.container_masks, footage)

    def _shows_through(self) -> float:
        """How much of what is behind the liquid shows through it, asked once."""
        if self._transmittance is None:
            self._transmittance = transmittance(self._scene, self._plates())
        return self._transmittance

    def _settle_transmission(self) -> None:
        """Whether Gaussians show what is behind them, from now on."""
        if self._config.transmission != "measured" or self._config.composition == "together":
            return
        share = self._shows_through()
        self._config = _transmission_settled(self._config, share)
        self._run.decide(
            Decision(
                name="transmission",
                basis="scene",
                chosen="Gaussians show what is behind them" if share >= _TRANSMITS else "none",
                because=f"{100 * share:.0f} % of the texture behind the liquid shows through it; from "
                f"{100 * _TRANSMITS:.0f} % on each Gaussian has a share of it",
            )
        )

    def _stand_in(self) -> Backgrounds:
        """What lies behind the liquid of every training view before the background is fitted."""
        from ..scaffold_gs import completed, flat_background

        with self._run.stage("background"):
            flat = flat_background(self._plates())
            self._background = self._background or flat
            return completed(self._plates(), flat)

    def _fitted_background(self, part: Run, shown: bool = False) -> Background:
        """The background. shown: on its way, behind the draft's liquid."""
        from ..scaffold_gs import shared_background

        settings = self._config.background.model_copy(update=self._smaller_background)
        offer = (lambda made: self._offer_behind_draft(made, False)) if shown else None
        with part.stage("background"), one_torch_thread():
            return shared_background(self._scene, settings, part, offer=offer)

    def _offer_behind_draft(self, made: Callable[[], Background], milestone: bool) -> None:
        if self._show is not None and self._drafted is not None:
            liquid, _, occlusion = self._drafted
            self._show(lambda: (liquid, made(), occlusion), milestone)

    def _trace(self, part: Run) -> Traced:
        return trace_liquid(self._scene, self._config, part, self._known, self._sightings)

    def _offer(self, found: Callable[[], Reconstruction], milestone: bool) -> None:
        """Show what was `found`, before the background that there is."""
        assert self._show is not None

        def state() -> State:
            assert self._background is not None
            liquid, occlusion = found()
            return liquid, self._background, occlusion

        self._show(state, milestone)

    def _from_coarse_grids(self) -> State:
        """With coarse grids first."""
        run, behind = self._run, self._stand_in()
        self._settle_transmission()
        share = self._shows_through()
        transparent = share >= _TRANSPARENT
        run.decide(
            Decision(
                name="background",
                basis="scene",
                chosen="before the coarse grids" if transparent else "once fine grids show something",
                because=f"{100 * share:.0f} % of the texture behind the liquid shows through it; from "
                f"{100 * _TRANSPARENT:.0f} % on the background comes first",
            )
        )
        if not transparent:
            self._drafted = None
            learned = self._coarse(behind, self._container(), 0)
            late, traced = run.ahead(self._fitted_background, self._trace, (_COARSE, _COARSE + _BEFORE))
            return self._fine(behind, traced, _COARSE + _BEFORE, late, learned)
        # Who has cores makes the trace beside the background. Nothing is shown then: a state is saved outside the
        # clock, and the other part would go on meanwhile.
        alone = thread_count() == 1
        if not alone:
            self._container()  # for the trace
        late_trace, background = run.ahead(
            self._trace, lambda part: self._fitted_background(part, alone), (0, _BACKGROUND)
        )
        self._offer_behind_draft(lambda: background, True)
        self._background, self._drafted = background, None
        behind = background.seen_by(self._scene)
        learned = self._coarse(behind, self._container(), _BACKGROUND)
        return self._fine(behind, late_trace(), _COARSE + _BEFORE, None, learned)

    def _coarse(self, behind: Backgrounds, container: KnownContainer, start: float) -> list[Learned]:
        """What the coarse grids teach; nothing where they show nothing."""
        offer = None if self._show is None else self._offer
        with self._run.stage("coarse fit"):
            return fit_coarsely(
                self._scene,
                self._config,
                self._run,
                container,
                self._sightings,
                behind,
                offer,
                (start, start + _COARSE),
            )

    def _fine(
        self,
        behind: Backgrounds,
        traced: Traced,
        start: float,
        late: Callable[[], Background] | None = None,
        learned: list[Learned] | None = None,
        frozen: dict[str, Frozen] | None = None,
    ) -> State:
        """The appearance, on the grids that stay. late: gives the background where `behind` has stand-ins for it."""
        run = self._run
        settled: Callable[[], Views] | None = None
        if late is not None:

            def settled() -> Views:
                self._background = late()
                self._plates = _plates_of(self._scene)  # those that were made are large, and nobody asks again
                return self._background.views(self._scene)

        offer = None if self._show is None else self._offer
        span = (start, 1.0)
        liquid, occlusion = fit_liquid(
            self._scene, behind, traced, run, span, frozen, offer, settled, self._room(), learned
        )
        if late is not None:
            self._background = late()  # a fit without any photograph asked for none
        assert self._background is not None
        return liquid, self._background, occlusion

    def _room(self) -> Callable[[], int] | None:
        """Gives the bytes that a budget leaves to the liquid."""
        limit = self._run.budget.storage_bytes
        if limit is None:
            return None

        def left() -> int:
            assert self._background is not None
            return limit - self._background.stored_bytes

        return left

    def _at_once(self) -> State:
        """On the grids that stay from the first iteration on."""
        run = self._run
        together = self._config.composition == "together"
        deferred = self._config.plates_share > 0 and not together
        behind: Backgrounds = self._stand_in() if deferred else {}
        self._settle_transmission()
        # For every trace on the way to the one that is kept; before the background, as both make clean plates.
        known = self._container()
        spent = within_seconds(self._scene, self._config, run, known)
        self._config = spent.config
        self._smaller_background = background_update(self._config, run)

        def trace(part: Run) -> Traced:
            def on(config: SplashSplatConfig) -> Traced:
                return trace_liquid(self._scene, config, part, known, self._sightings)

            first = within_memory(self._scene, self._config, part, self._loaded, on, spent.traced)
            return within_bytes(self._config, part, on, first)

        late, traced = run.ahead(self._fitted_background, trace, (0, _BEFORE))
        if deferred:
            return self._fine(behind, traced, _BEFORE, late)
        background = self._background = late()
        if not together:
            return self._fine(background.seen_by(self._scene), traced, _BEFORE)
        views = {name: self._scene.cameras[name] for name in self._scene.train}
        frozen = {name: freeze(*background.gaussians(camera), camera) for name, camera in views.items()}
        return self._fine(dict.fromkeys(views, background.far_color), traced, _BEFORE, frozen=frozen)


def _transmission_settled(config: SplashSplatConfig, share: float) -> SplashSplatConfig:
    """`config` for a liquid through which `share` of the background's texture shows."""
    if config.transmission != "measured":
        return config
    return config.model_copy(update={"transmission": "always" if share >= _TRANSMITS else "never"})


def _plates_of(scene: TrainingScene) -> Callable[[], Plates]:
    """Makes the clean plates of `scene`, once."""
    from ..scaffold_gs import clean_plates

    return cache(lambda: clean_plates(scene))

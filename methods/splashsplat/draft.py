"""A first reconstruction within seconds, for those who look at a fit on its way. Not in the paper.

It is the method itself on coarse grids: carriers of each frame alone, which nothing moves, fitted for a moment to the
photographs, before one colour at first and then before a background as coarse. A container that only the footage shows
is known roughly. Nothing of it enters the fit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.harness.contract import Run
from splashbench.scene.scene import TrainingScene

from .appearance.targets import Views
from .fields.container import KnownContainer
from .fields.occlusion import LiquidOcclusion
from .model import Liquid
from .reconstruction import Reconstruction, fit_liquid
from .settings import SplashSplatConfig
from .smaller import draft_of
from .trace import trace_liquid

if TYPE_CHECKING:
    from ..scaffold_gs import Background, Plates

# Of the background: a second or two.
_ITERATIONS, _ANCHORS, _LONGEST_SIDE = 80, 5000, 160

#: The liquid, what lies behind it, and what hides the liquid from cameras.
State = tuple[Liquid, "Background", LiquidOcclusion | None]


def make_draft(
    scene: TrainingScene,
    config: SplashSplatConfig,
    run: Run,
    known: KnownContainer,
    plates: Callable[[], Plates],
    opaque: bool,
    offer: Callable[[Callable[[], State], bool], None],
) -> State:
    """Fit a draft of `scene`; returns it.

    config: that of the fit. run: see `Run.aside`. plates: gives what the training views show without the liquid.
    opaque: see `draft_of`. offer: is given what makes the draft as it is, and whether there will be no
    other for a while; at the end, too.
    """
    from ..scaffold_gs import BackgroundSettings, clean_plates, completed, fit_background, flat_background

    first = clean_plates(scene, n_frames=1)
    background = flat_background(first)
    coarse = draft_of(config, opaque)

    def settled() -> Views:
        nonlocal background
        settings = BackgroundSettings(iterations=_ITERATIONS, max_anchors=_ANCHORS, longest_side=_LONGEST_SIDE)
        with one_torch_thread():
            background = fit_background(scene, settings, run)
        # Plates are sharper than so coarse a background.
        return completed(plates(), background).items()

    def offer_state(state: Callable[[], Reconstruction], milestone: bool) -> None:
        offer(lambda: complete(state()), milestone)

    def complete(found: Reconstruction) -> State:
        liquid, occlusion = found
        return liquid, background, occlusion

    traced = trace_liquid(scene, coarse, run, known)
    found = fit_liquid(scene, completed(first, background), traced, run, offer=offer_state, settled=settled)
    offer(lambda: complete(found), True)
    return complete(found)

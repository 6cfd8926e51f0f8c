"""A first reconstruction within seconds, for those who look at a fit on its way. Not in the paper.

It is the method itself on coarse grids: carriers of each frame alone, which nothing moves, fitted for a moment to the
photographs. The background of a fit is not there yet. Before it, the training views have what they show at first, and
others one colour.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from splashbench.harness.contract import Run
from splashbench.scene.scene import TrainingScene

from .fields.container import KnownContainer
from .fields.occlusion import LiquidOcclusion
from .model import Liquid
from .reconstruction import fit_liquid, trace_liquid
from .settings import SplashSplatConfig

if TYPE_CHECKING:
    from ..scaffold_gs import Background


def make_draft(
    scene: TrainingScene, config: SplashSplatConfig, seed: int, known: KnownContainer
) -> tuple[Liquid, Background, LiquidOcclusion | None]:
    """The liquid, a background of one colour, and what hides the liquid from cameras. config: that of the fit."""
    from ..scaffold_gs import flat_background

    background, behind = flat_background(scene, n_frames=1)
    # A run of its own: nothing in it counts as a stage, a note or a part that others may take over.
    run, coarse = Run(seed=seed), config.draft()
    liquid, occlusion = fit_liquid(scene, behind, trace_liquid(scene, coarse, run, known), run)
    return liquid, background, occlusion

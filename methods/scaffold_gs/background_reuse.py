"""The background of runs that share it: variants of a study differ in the liquid, seldom in what lies behind it."""

from __future__ import annotations

from collections.abc import Callable

from splashbench.harness.contract import Run
from splashbench.scene import TrainingScene

from .background import Background, fit_background
from .settings import BackgroundSettings

#: Of the fit; raised when a change alters what it gives, so that none is taken over from before.
VERSION = 5


def shared_background(
    scene: TrainingScene,
    settings: BackgroundSettings,
    run: Run,
    span: tuple[float, float] = (0.0, 1.0),
    offer: Callable[[Callable[[], Background]], None] | None = None,
) -> Background:
    """What `fit_background` gives, or gave an earlier run of the same study (`Run.reuse`); the same renders."""
    return run.reuse(
        "background",
        scene,
        {"settings": settings.model_dump(mode="json"), "version": VERSION},
        lambda: fit_background(scene, settings, run, span, offer),
        Background.save,
        Background.load,
    )

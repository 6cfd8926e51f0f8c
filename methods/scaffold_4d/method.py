"""4D-Scaffold-GS as a method: start, fit, load (Cho et al., "4D Scaffold Gaussian Splatting", arXiv 2411.17044)."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np

from splashbench.gaussians.devices import GaussianMethod
from splashbench.gaussians.fitting import fit_dynamic
from splashbench.gaussians.initialization import camera_extent, initialization
from splashbench.gaussians.mixed_model import MODEL_FILE, MixedFitted, load_tables
from splashbench.gaussians.optimizer import LearningRate
from splashbench.gaussians.photographs import Photographs, unit_time
from splashbench.harness.contract import MethodConfig, Run
from splashbench.scene import TrainingScene

from ..scaffold_gs.model import PER_ANCHOR
from ..scaffold_gs.optimizer import RATES, AnchorOptimizer
from .growth import SpacetimeGrowth
from .model import ROWS, SpacetimeAnchors, SpacetimeAnchorSpec, stored_children
from .settings import Scaffold4DSettings


def rates(settings: Scaffold4DSettings) -> dict[str, LearningRate]:
    """Learning rates by table: those of static anchors, and of the flow."""
    published = {**RATES[settings.rates], "flow_head": LearningRate.constant(1e-3)}
    factor = settings.rate_factor
    published |= {
        name: LearningRate(published[name].first * factor, published[name].last * factor) for name in PER_ANCHOR
    }
    return published if settings.rates == "published" else {name: rate.short() for name, rate in published.items()}


class Scaffold4D(GaussianMethod):
    """Anchors in space-time, decoded into moving Gaussians; background and liquid are one set."""

    id: ClassVar[str] = "scaffold_4d"
    title: ClassVar[str] = "4D-Scaffold-GS"
    version: ClassVar[str] = "4"  # since hulls, where it starts, go on past the sides of images
    torch_optim: ClassVar[bool] = False
    Config: ClassVar[type[MethodConfig]] = Scaffold4DSettings
    mixed: ClassVar[bool] = True

    def fit(self, scene: TrainingScene, config: Scaffold4DSettings, run: Run) -> MixedFitted:
        with initialization(scene, config, run) as (start, rng):
            times = np.array([unit_time(scene, float(seconds)) for seconds in scene.times])
            seconds, frame = float(scene.times[-1] - scene.times[0]) or 1.0, 1 / max(1, scene.n_frames - 1)
            fastest = config.fastest * camera_extent(scene) * seconds
            variant = SpacetimeAnchorSpec(config.children, config.beta, fastest, config.base_color)
            model = SpacetimeAnchors.from_start(
                start,
                variant,
                config.start_opacity,
                config.duration * frame,
                times,
                config.spread_start,
                1.0 if config.volume_unit == "scene" else None,
            )
            model.to(run.device)
            optimizer = AnchorOptimizer(model, rates(config), config.iterations)
            voxel = config.voxel * float(np.median(start.spacing))
            with run.stage("fit"):
                history = fit_dynamic(
                    model,
                    optimizer,
                    SpacetimeGrowth(optimizer, voxel, frame, config, rng),
                    Photographs(scene, config.longest_side, config.views_per_step, rng),
                    lambda done: run.progress(done, f"fitting {len(model)} anchors"),
                    after_step=lambda: run.checkpoint(lambda: MixedFitted(model, scene)),
                )
        return MixedFitted(model, scene, history)

    def load(self, directory: Path, scene: TrainingScene) -> MixedFitted:
        path = directory / MODEL_FILE
        model = SpacetimeAnchors(0, SpacetimeAnchorSpec(stored_children(path)))
        load_tables(path, model, ROWS)
        return MixedFitted(model, scene)

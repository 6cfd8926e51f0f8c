"""SpacetimeGaussians as methods, full and lite (Li et al., "Spacetime Gaussian Feature Splatting", CVPR 2024)."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from splashbench.gaussians.density_control import DensityControl
from splashbench.gaussians.devices import GaussianMethod
from splashbench.gaussians.fitting import fit_dynamic
from splashbench.gaussians.initialization import camera_extent, initialization
from splashbench.gaussians.mixed_model import MODEL_FILE, MixedFitted, load_tables
from splashbench.gaussians.optimizer import LearningRate, RowOptimizer
from splashbench.gaussians.photographs import Photographs, unit_time
from splashbench.harness.contract import MethodConfig, Run
from splashbench.scene import TrainingScene

from .guided import GuidedDensity
from .model import SpacetimeModel
from .settings import SpacetimeSettings


def rates(settings: SpacetimeSettings, extent: float, full: bool) -> dict[str, LearningRate]:
    """Learning rates by table; `extent` of the cameras, scene units."""
    factor, color = settings.rate_factor, settings.color_factor
    position, motion = 1.6e-4 * extent * factor, 2.8e-4 * extent * factor
    published = {
        "positions": LearningRate(position, position / 100),
        "motions": LearningRate.constant(motion),
        "log_scales": LearningRate.constant(5e-3),
        "quaternions": LearningRate.constant(1e-3),
        "spins": LearningRate.constant(1e-4),
        "opacity_logits": LearningRate.constant(0.05),
        "times": LearningRate.constant(1e-4),
        "log_widths": LearningRate.constant(0.03),
        "base": LearningRate.constant(2.5e-3 * color),
    }
    if full:
        published |= {
            "features": LearningRate.constant(2.5e-3 * color),
            "time_features": LearningRate.constant(1e-3 * color),
            "decoder": LearningRate.constant(1e-4 * color),
        }
    if settings.rates == "published":
        return published
    return {name: rate.short() for name, rate in published.items()}


class SpacetimeGaussians(GaussianMethod):
    """Gaussians that fade in and out and move on polynomials; background and liquid are one set."""

    id: ClassVar[str] = "spacetime_gaussians"
    title: ClassVar[str] = "SpacetimeGaussians, full"
    version: ClassVar[str] = "4"  # since hulls, where it starts, go on past the sides of images
    torch_optim: ClassVar[bool] = False
    Config: ClassVar[type[MethodConfig]] = SpacetimeSettings
    mixed: ClassVar[bool] = True
    full: ClassVar[bool] = True

    def fit(self, scene: TrainingScene, config: SpacetimeSettings, run: Run) -> MixedFitted:
        with initialization(scene, config, run) as (start, rng):
            times = np.array([unit_time(scene, float(seconds)) for seconds in scene.times])
            model = SpacetimeModel.from_start(start, self.full, config.start_opacity, config.hull_log_width, times)
            model.to(run.device)
            extent = camera_extent(scene)
            optimizer = RowOptimizer(model, rates(config, extent, self.full), model.rows, config.iterations)
            photographs = Photographs(scene, config.longest_side, config.views_per_step, rng)
            changed = _anywhere if config.new_times == "anywhere" else None
            density = DensityControl(optimizer, config.density(extent), changed)
            with run.stage("fit"):
                history = fit_dynamic(
                    model,
                    optimizer,
                    GuidedDensity(density, model, photographs, config, rng),
                    photographs,
                    lambda done: run.progress(done, f"fitting {len(model.positions)} Gaussians"),
                    after_step=lambda: run.checkpoint(lambda: MixedFitted(model, scene)),
                )
        return MixedFitted(model, scene, history)

    def load(self, directory: Path, scene: TrainingScene) -> MixedFitted:
        model = SpacetimeModel(0, self.full)
        load_tables(directory / MODEL_FILE, model, model.rows)
        return MixedFitted(model, scene)


class SpacetimeGaussiansLite(SpacetimeGaussians):
    """The lite model: a colour per Gaussian instead of features and a decoder."""

    id: ClassVar[str] = "spacetime_gaussians_lite"
    title: ClassVar[str] = "SpacetimeGaussians, lite"
    full: ClassVar[bool] = False


def _anywhere(rows: dict[str, Tensor]) -> None:
    """Gaussians made from others get a time anywhere in the recording."""
    rows["times"] = torch.rand(rows["times"].shape).to(rows["times"])

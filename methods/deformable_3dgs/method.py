"""Deformable-3DGS as a method: start, fit, load (Yang et al., "Deformable 3D Gaussians", CVPR 2024)."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np

from splashbench.files import read_npz
from splashbench.gaussians.density_control import DensityControl
from splashbench.gaussians.devices import GaussianMethod
from splashbench.gaussians.fitting import fit_dynamic
from splashbench.gaussians.initialization import camera_extent, initialization
from splashbench.gaussians.mixed_model import MODEL_FILE, MixedFitted, load_tables
from splashbench.gaussians.optimizer import LearningRate, RowOptimizer
from splashbench.gaussians.photographs import Photographs
from splashbench.harness.contract import MethodConfig, Run
from splashbench.scene import TrainingScene

from .model import ROWS, DeformableModel
from .settings import DeformableSettings

# Steps after which the published rates have come to their end; a fit of a real scene ends before, with 20 000.
_POSITIONS_FALL_FOR, _NETWORK_FALLS_FOR = 30_000, 40_000


def rates(settings: DeformableSettings, extent: float) -> dict[str, LearningRate]:
    """Learning rates by table; `extent` of the cameras, scene units."""
    factor, color = settings.rate_factor, 2.5e-3 * settings.color_factor
    position = 1.6e-4 * extent * factor
    published = {
        "positions": LearningRate(position, position / 100, until=_POSITIONS_FALL_FOR / settings.iterations),
        "log_scales": LearningRate.constant(5e-3),
        "quaternions": LearningRate.constant(1e-3),
        "opacity_logits": LearningRate.constant(0.05),
        "constant": LearningRate.constant(color),
        "rest": LearningRate.constant(color / 20),
    }
    parts = {
        "layers": 1.0,
        "shift": settings.head_factor,
        "turn": settings.head_factor,
        "growth": settings.growth_factor,
    }
    for part, share in parts.items():
        network = settings.network_factor * share
        until = _NETWORK_FALLS_FOR / settings.iterations
        published[f"deformation.{part}"] = LearningRate(8e-4 * network, 1.6e-6 * network, until, settings.warm_up)
    if settings.rates == "published":
        return published
    return {name: rate.short() for name, rate in published.items()}


class Deformable3DGS(GaussianMethod):
    """Canonical Gaussians and a deformation network; background and liquid are one set."""

    id: ClassVar[str] = "deformable_3dgs"
    title: ClassVar[str] = "Deformable-3DGS"
    version: ClassVar[str] = "5"  # since hulls, where it starts, go on past the sides of images
    Config: ClassVar[type[MethodConfig]] = DeformableSettings
    mixed: ClassVar[bool] = True

    def fit(self, scene: TrainingScene, config: DeformableSettings, run: Run) -> MixedFitted:
        # One canonical set for all times: points of several frames would all be there in every one.
        with initialization(scene, config, run, largest_only=True) as (start, rng):
            model = DeformableModel.from_start(
                start, config.start_opacity, config.sh_degree, config.depth, config.width
            )
            model.to(run.device)
            extent = camera_extent(scene)
            turned = ("deformation.layers",) if config.network_steps == "muon" else ()
            optimizer = RowOptimizer(model, rates(config, extent), ROWS, config.iterations, orthogonal=turned)
            photographs = Photographs(scene, config.longest_side, config.views_per_step, rng)
            noise = _TimeNoise(config, scene.n_frames, rng)

            def begin_step(step: int) -> float:
                model.deforms = step >= config.warm_up * config.iterations
                model.active_degree = min(config.sh_degree, step // config.sh_every)
                return noise.at(step, photographs.left)

            def after_step() -> None:
                # What is loaded deforms; before the warm-up's end the network has nothing to say.
                if model.deforms:
                    run.checkpoint(lambda: MixedFitted(model, scene))

            with run.stage("fit"):
                history = fit_dynamic(
                    model,
                    optimizer,
                    DensityControl(optimizer, config.density(extent)),
                    photographs,
                    lambda done: run.progress(done, f"fitting {len(model.positions)} Gaussians"),
                    begin_step,
                    after_step,
                )
        model.deforms, model.active_degree = True, config.sh_degree
        return MixedFitted(model, scene, history)

    def load(self, directory: Path, scene: TrainingScene) -> MixedFitted:
        path = directory / MODEL_FILE
        tables = read_npz(path, {"rest": 3, "deformation.shift.weight": 2})
        degree = round((tables["rest"].shape[1] + 1) ** 0.5) - 1
        with np.load(path, allow_pickle=False) as archive:
            depth = sum(name.startswith("deformation.layers.") and name.endswith("weight") for name in archive.files)
        model = DeformableModel(0, degree, depth, tables["deformation.shift.weight"].shape[1])
        load_tables(path, model, ROWS)
        return MixedFitted(model, scene)


class _TimeNoise:
    """Annealed smoothing of the time (Yang et al. 2024, Eq. 6): Gaussian noise that falls to nothing.

    Its standard deviation is beta dt (1 - step / until), the recording lasting 1. The paper's dt is "the mean time
    interval"; in the official code it is one by the photographs left of the round, so that the last ones of a round
    are blurred most.
    """

    def __init__(self, config: DeformableSettings, n_frames: int, rng: np.random.Generator) -> None:
        self._config, self._n_frames, self._rng = config, n_frames, rng
        self._until = config.time_noise_until * config.iterations

    def at(self, step: int, left: int) -> float:
        """What to add to the time of the next photograph; left: photographs to come in this round, this one too."""
        remaining = max(0.0, 1 - step / self._until)
        if self._n_frames < 2:
            return 0.0
        frames = self._n_frames - 1 if self._config.time_noise_unit == "timestep" else left
        return float(self._rng.normal()) * (self._config.time_noise / frames) * remaining

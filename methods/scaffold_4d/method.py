"""4D-Scaffold-GS as a method: start, fit, load (Cho et al., "4D Scaffold Gaussian Splatting", arXiv 2411.17044)."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from splashbench_methods.gaussian_splatting.fitting import fit_dynamic
from splashbench_methods.gaussian_splatting.mixed import MODEL_FILE, MixedFitted, load_tables
from splashbench_methods.gaussian_splatting.optimizer import Rate
from splashbench_methods.gaussian_splatting.photographs import Photographs, unit_time
from splashbench_methods.gaussian_splatting.start import camera_extent, hull_points, joined, static_points
from splashbench_methods.scaffold_4d.growth import SpacetimeGrowth
from splashbench_methods.scaffold_4d.model import ROWS, SpacetimeAnchors, Variant
from splashbench_methods.scaffold_4d.settings import Settings
from splashbench_methods.scaffold_gs.model import PER_ANCHOR
from splashbench_methods.scaffold_gs.optimizer import RATES, AnchorOptimizer

from splashbench.adapter.contract import Method, MethodConfig, Run
from splashbench.errors import SplashbenchError
from splashbench.files import read_npz
from splashbench.render.torch_threads import one_torch_thread
from splashbench.scene import TrainingScene

_MAX_CHILDREN = 1024


def rates(settings: Settings) -> dict[str, Rate]:
    """Learning rates by table: those of static anchors, and of the flow."""
    found = {**RATES[settings.rates], "flow_head": Rate.constant(1e-3)}
    factor = settings.rate_factor
    found |= {name: Rate(found[name].first * factor, found[name].last * factor) for name in PER_ANCHOR}
    return found if settings.rates == "published" else {name: rate.short() for name, rate in found.items()}


class Scaffold4D(Method):
    """Anchors in space-time, decoded into moving Gaussians; background and liquid are one set."""

    id: ClassVar[str] = "scaffold_4d"
    title: ClassVar[str] = "4D-Scaffold-GS"
    Config: ClassVar[type[MethodConfig]] = Settings
    mixed: ClassVar[bool] = True

    def fit(self, scene: TrainingScene, config: Settings, run: Run) -> MixedFitted:
        rng = np.random.default_rng(run.seed)
        run.progress(0, "collecting points")
        with one_torch_thread(), torch.random.fork_rng(devices=[]):
            torch.manual_seed(run.seed)
            with run.stage("start"):
                static = static_points(scene, config.static_points, config.static, rng)
                start = joined(static, hull_points(scene, config.hull_points))
            times = np.array([unit_time(scene, float(seconds)) for seconds in scene.times])
            seconds, frame = float(scene.times[-1] - scene.times[0]) or 1.0, 1 / max(1, scene.n_frames - 1)
            fastest = config.fastest * camera_extent(scene) * seconds
            variant = Variant(config.children, config.beta, fastest, config.base_color)
            model = SpacetimeAnchors.from_start(start, variant, config.start_opacity, config.duration * frame, times)
            optimizer = AnchorOptimizer(model, rates(config), config.iterations)
            voxel = config.voxel * float(np.median(start.spacing))
            with run.stage("fit"):
                history = fit_dynamic(
                    model,
                    optimizer,
                    SpacetimeGrowth(optimizer, voxel, frame, config, rng),
                    Photographs(scene, config.longest_side, config.views_per_step, rng),
                    lambda done: run.progress(done, f"fitting {len(model)} anchors"),
                )
        return MixedFitted(model, scene, history)

    def load(self, directory: Path, scene: TrainingScene) -> MixedFitted:
        path = directory / MODEL_FILE
        children = read_npz(path, {"offsets": 3})["offsets"].shape[1]
        if not 1 <= children <= _MAX_CHILDREN:
            raise SplashbenchError(f"{path}: {children} Gaussians per anchor make no sense; fit again")
        model = SpacetimeAnchors(0, Variant(children))
        load_tables(path, model, ROWS)
        return MixedFitted(model, scene)

"""From masks to the fitted liquid: observation fields, motion, carriers, appearance (paper, Fig. "pipeline")."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from splashbench_methods.splashsplat.carriers import Carriers, track_carriers
from splashbench_methods.splashsplat.config import SplashSplatConfig
from splashbench_methods.splashsplat.fit import (
    Appearance,
    fit_appearance,
    initial_appearance,
    visible_carriers,
)
from splashbench_methods.splashsplat.model import Liquid, pack_phi, store_precision
from splashbench_methods.splashsplat.targets import collect_targets
from splashbench_methods.splashsplat.velocity import control_shape, fit_velocity

from splashbench.adapter.contract import Run
from splashbench.observe import Grid, Silhouettes, sequence_bounds, signed_distance_frames
from splashbench.observe.kernels import resample
from splashbench.observe.signed_distance import PADDING
from splashbench.render.torch_threads import one_torch_thread
from splashbench.scene.scene import TrainingScene

Report = Callable[[float, str], None]
log = logging.getLogger(__name__)

# Share of the time that everything before the appearance takes, for the progress bar only.
_TRACKING = 0.25


class Stages:
    """Adds up how long each stage takes; stages may interleave."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


class Observations:
    """phi_t of one frame after another, and on the way the motion between them; two frames in memory at a time.

    Iterating yields phi_t on `hull_grid`, float32 in transport voxels. By the time phi_t is yielded, velocities[t - 1]
    (float32 [T - 1, cx, cy, cz, 3], voxels per frame) and packed[t] (int8, see `pack_phi`) are filled in.
    """

    def __init__(self, scene: TrainingScene, config: SplashSplatConfig, stages: Stages, report: Report) -> None:
        self._config, self._stages, self._report = config, stages, report
        with stages("signed distance"):
            self._silhouettes = Silhouettes(scene)
            bounds = sequence_bounds(self._silhouettes).padded(PADDING)
        self.hull_grid, self.grid = Grid.over(bounds, config.hull_cells), Grid.over(bounds, config.transport_cells)
        self.n_frames = scene.n_frames
        control = control_shape(self.grid.shape, config.control_factor)
        self.velocities = np.zeros((self.n_frames - 1, *control, 3), dtype=np.float32)
        self.packed = np.zeros((self.n_frames, *self.grid.shape), dtype=np.int8)

    def __iter__(self) -> Iterator[np.ndarray]:
        config = self._config
        ratio = self.grid.voxel / self.hull_grid.voxel
        frames = signed_distance_frames(self._silhouettes, self.hull_grid, config.distance)
        before: np.ndarray | None = None
        for t in range(self.n_frames):
            with self._stages("signed distance"):
                phi = next(frames) / np.float32(ratio)
                now = resample(phi, self.grid.shape, ratio)
                self.packed[t] = pack_phi(now)
            with self._stages("velocity"):
                if before is not None and config.variant != "per_frame":
                    fit = fit_velocity(before, now, config.control_factor, config.velocity)
                    self.velocities[t - 1] = fit.control
            before = now
            yield phi
            self._report((t + 1) / self.n_frames, "signed distance, velocity, carriers")


def fit_liquid(
    scene: TrainingScene,
    backgrounds: dict[str, np.ndarray],
    config: SplashSplatConfig,
    run: Run,
    span: tuple[float, float] = (0.0, 1.0),
) -> Liquid:
    """Reconstruct the liquid of `scene`.

    backgrounds: float32 [H, W, 3] of every training view, in [0, 1]. span: the part of `run`'s progress this takes up.
    """

    def report(fraction: float, message: str) -> None:
        run.progress(span[0] + (span[1] - span[0]) * fraction, message)

    stages = Stages()
    observations = Observations(scene, config, stages, lambda done, message: report(_TRACKING * done, message))
    grid, factor = observations.grid, config.control_factor
    with stages("tracking, all in all"):
        carriers = track_carriers(
            observations, observations.hull_grid, grid, observations.velocities, factor, config.carriers, run.seed
        )
        carriers = store_precision(carriers, grid)
    with stages("appearance"), one_torch_thread():
        appearance = initial_appearance(carriers.count, grid.voxel, config.optimisation, config.decoder, run.seed)
        positions = [grid.to_scene(carriers.positions[carriers.rows(t)]) for t in range(carriers.n_frames)]
        targets = collect_targets(scene, backgrounds, positions, config.silhouette_norm)
        if targets:
            fit_appearance(
                appearance,
                carriers,
                grid,
                targets,
                config.optimisation,
                observations.hull_grid.voxel / grid.voxel,
                run.seed,
                lambda done: report(_TRACKING + (1 - _TRACKING) * done, "appearance"),
            )
        carriers, appearance = _pruned(carriers, appearance, config.prune_opacity)
    log.info(", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in stages.seconds.items()))
    return Liquid.of(scene.times, grid, carriers, observations.velocities, factor, observations.packed, appearance)


def _pruned(carriers: Carriers, appearance: Appearance, threshold: float) -> tuple[Carriers, Appearance]:
    """Without the carriers that the images made transparent: the phantom volume of the hull."""
    carriers, kept = carriers.keep(visible_carriers(appearance, threshold))
    return carriers, Appearance(appearance.features[kept], appearance.log_scales[kept], appearance.decoder)

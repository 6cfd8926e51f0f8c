"""From masks to the fitted liquid: observation fields, motion, carriers, appearance (paper, Fig. "pipeline")."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.harness.contract import Run
from splashbench.observe.container import solid_distance
from splashbench.scene.scene import TrainingScene

from .appearance.fitting import Appearance, fit_appearance, initial_appearance, visible_carriers
from .appearance.occlusion import Occlusion
from .appearance.targets import collect_targets
from .carriers.tracking import Carriers, Simulation, track_carriers
from .fields.observations import Observations
from .flip.solver import FlipSolver, FlipTransport, gravity_in_voxels
from .model import Liquid, store_precision
from .motion.step import Motion
from .settings import SplashSplatConfig
from .subframe import Track

Report = Callable[[float, str], None]

# Share of the time that everything before the appearance takes, for the progress bar only.
_TRACKING = 0.25


@dataclass(frozen=True)
class _Steps:
    """FLIP by the scene's frame steps."""

    transport: FlipTransport
    durations: np.ndarray
    motion: Motion

    def forecast(self, ids: np.ndarray, deformation: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray]:
        return self.transport.forecast(ids, deformation, float(self.durations[step]), self.motion.step(step))


def _simulation(
    observations: Observations, scene: TrainingScene, seed: int
) -> Callable[[np.ndarray, np.ndarray, np.ndarray], Simulation]:
    """Starts FLIP from the first carriers. Raises SplashbenchError where it is not known how things fall."""
    grid, motion = observations.grid, observations.motion
    gravity = gravity_in_voxels(scene, grid)
    mesh = scene.container_mesh()
    solid = None if mesh is None else solid_distance(mesh, grid)

    def start(phi: np.ndarray, ids: np.ndarray, positions: np.ndarray) -> Simulation:
        solver = FlipSolver(grid.shape, gravity, solid)
        ratio = grid.voxel / observations.hull_grid.voxel
        transport = FlipTransport(solver, phi, ratio, ids, positions, np.random.default_rng([seed, 2]))
        return _Steps(transport, np.diff(scene.times), motion)

    return start


def fit_liquid(
    scene: TrainingScene,
    backgrounds: dict[str, np.ndarray],
    config: SplashSplatConfig,
    run: Run,
    span: tuple[float, float] = (0.0, 1.0),
) -> tuple[Liquid, Occlusion | None]:
    """Reconstruct the liquid of `scene`; and what hides it from cameras.

    backgrounds: float32 [H, W, 3] of every training view, in [0, 1]. span: the part of `run`'s progress this takes up.
    """

    def report(fraction: float, message: str) -> None:
        run.progress(span[0] + (span[1] - span[0]) * fraction, message)

    observations = Observations(scene, config, run, lambda done, message: report(_TRACKING * done, message))
    grid, motion, occlusion = observations.grid, observations.motion, observations.occlusion
    carriers = track_carriers(
        observations,
        observations.hull_grid,
        grid,
        motion,
        config.carriers,
        run.seed,
        observations.seen if config.visible_only else None,
        observations.landed if config.ballistic else None,
        _simulation(observations, scene, run.seed) if config.variant == "flip" else None,
    )
    carriers = store_precision(carriers, grid)
    with run.stage("appearance"), one_torch_thread():
        appearance = initial_appearance(carriers.count, grid.voxel, config.optimisation, config.decoder, run.seed)
        track = Track(grid, carriers, motion, observations.packed)
        targets = collect_targets(
            scene,
            backgrounds,
            track,
            config.silhouette_norm,
            camera_times=config.camera_times,
            trusted=~observations.silhouettes.failed_masks,
            hidden=None if occlusion is None else lambda name, points: occlusion.hidden(scene.cameras[name], points),
        )
        if targets:
            fit_appearance(
                appearance,
                track,
                targets,
                config.optimisation,
                observations.hull_grid.voxel / grid.voxel,
                run.seed,
                lambda done: report(_TRACKING + (1 - _TRACKING) * done, "appearance"),
            )
        carriers, appearance = _pruned(carriers, appearance, config.prune_opacity)
    # What moves the carriers of the other variants is not u_t.
    carried = config.variant in ("full", "no_resampling")
    return Liquid.of(scene.times, grid, carriers, motion, observations.packed, appearance, carried), occlusion


def _pruned(carriers: Carriers, appearance: Appearance, threshold: float) -> tuple[Carriers, Appearance]:
    """Without the carriers that the images made transparent: the phantom volume of the hull."""
    carriers, kept = carriers.keep(visible_carriers(appearance, threshold))
    return carriers, Appearance(appearance.features[kept], appearance.log_scales[kept], appearance.decoder)

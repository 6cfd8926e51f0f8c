"""From masks to the fitted liquid: observation fields, motion, carriers, appearance (paper, Fig. "pipeline")."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from splashbench_methods.splashsplat.carriers import Carriers, Simulation, track_carriers
from splashbench_methods.splashsplat.config import SplashSplatConfig
from splashbench_methods.splashsplat.fit import (
    Appearance,
    fit_appearance,
    initial_appearance,
    visible_carriers,
)
from splashbench_methods.splashsplat.flip import FlipSolver, FlipTransport, gravity_in_voxels
from splashbench_methods.splashsplat.gate import gated
from splashbench_methods.splashsplat.model import Liquid, pack_phi, store_precision
from splashbench_methods.splashsplat.motion import Fall, Motion
from splashbench_methods.splashsplat.occlusion import Occlusion
from splashbench_methods.splashsplat.subframe import Track
from splashbench_methods.splashsplat.survey import Survey, survey
from splashbench_methods.splashsplat.targets import collect_targets
from splashbench_methods.splashsplat.velocity import control_shape, fit_velocity
from splashbench_methods.splashsplat.visibility import seen_by_any

from splashbench.adapter.contract import Run
from splashbench.observe import Grid, Silhouettes, sequence_bounds, signed_distance_frames
from splashbench.observe.container import solid_distance
from splashbench.observe.failures import distrust_failed_masks
from splashbench.observe.kernels import resample
from splashbench.observe.reduced import reduced
from splashbench.observe.shadow import ContainerShadow
from splashbench.observe.signed_distance import PADDING
from splashbench.render.torch_threads import one_torch_thread
from splashbench.scene.scene import TrainingScene

Report = Callable[[float, str], None]

# Share of the time that everything before the appearance takes, for the progress bar only.
_TRACKING = 0.25
# A carrier is seen through at most this many shells of liquid.
SEEN_THROUGH = 1.5


class Observations:
    """phi_t of one frame after another, and on the way the motion between them; two frames in memory at a time.

    Iterating yields phi_t on `hull_grid`, float32 in transport voxels. By the time phi_t is yielded, step t - 1 of
    `motion` and packed[t] (int8, see `pack_phi`) are filled in.
    """

    def __init__(self, scene: TrainingScene, config: SplashSplatConfig, run: Run, report: Report) -> None:
        self._config, self._run, self._report = config, run, report
        self._times = scene.times
        report(0.0, "reading masks")
        with run.stage("signed distance"):
            observed = reduced(scene, config.hull_cells) if config.distance == "silhouette" else scene
            self.silhouettes = Silhouettes(observed, interpolate_times=None if config.camera_times else False)
            self._container = ContainerShadow.of(scene) if config.container else None
        if config.detect_failures:
            report(0.0, "looking for failed masks")
            with run.stage("failed masks"):
                distrust_failed_masks(self.silhouettes, self._container)
        with run.stage("signed distance"):
            bounds = sequence_bounds(self.silhouettes, self._container).padded(PADDING)
        self.hull_grid, self.grid = Grid.over(bounds, config.hull_cells), Grid.over(bounds, config.transport_cells)
        #: what the container hides, where it does
        self.occlusion: Occlusion | None = None
        if self._container is not None and self._container.hides:
            self.occlusion = Occlusion(self._container.mesh, self.hull_grid.voxel)
        cameras = self.silhouettes.cameras
        self._shadows = [None if self.occlusion is None else self.occlusion.depth(camera) for camera in cameras]
        self._survey: Survey | None = None
        if scene.gravity is not None and (config.pool or config.ballistic):
            report(0.0, "looking for the jet and the pool")
            with run.stage("survey"):
                self._survey = survey(
                    self.silhouettes,
                    bounds,
                    self._container,
                    scene.gravity,
                    None if scene.times_source == "nominal" else scene.metres_per_unit,
                    scene.times,
                    self._shadows,
                    find_pool=config.pool,
                    find_jets=config.ballistic,
                )
        self.n_frames = scene.n_frames
        control = control_shape(self.grid.shape, config.control_factor)
        velocities = np.zeros((self.n_frames - 1, *control, 3), dtype=np.float32)
        self.motion = Motion(velocities, config.control_factor, [self._fall(t) for t in range(self.n_frames - 1)])
        self.packed = np.zeros((self.n_frames, *self.grid.shape), dtype=np.int8)

    def __iter__(self) -> Iterator[np.ndarray]:
        config = self._config
        ratio = self.grid.voxel / self.hull_grid.voxel
        frames = signed_distance_frames(self.silhouettes, self.hull_grid, config.distance, self._container)
        before: np.ndarray | None = None
        for t in range(self.n_frames):
            with self._run.stage("signed distance"):
                phi = next(frames)
                if self._survey is not None:
                    phi = self._survey.refined(phi, self.hull_grid, t)
                phi = phi / np.float32(ratio)
                now = resample(phi, self.grid.shape, ratio)
                self.packed[t] = pack_phi(now)
            with self._run.stage("velocity"):
                if before is not None and config.variant != "per_frame":
                    self.motion.velocities[t - 1] = self._fitted(before, now)
            before = now
            with self._run.stage("carriers"):  # what is done with phi until the next is asked for
                yield phi
            self._report((t + 1) / self.n_frames, "signed distance, velocity, carriers")

    def _fitted(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """u_t on the control grid, voxels per frame."""
        config, factor = self._config, self._config.control_factor
        control = fit_velocity(before, after, factor, config.velocity).control
        return gated(control, factor, before, after) if config.gate_motion else control

    def _fall(self, t: int) -> Fall | None:
        """The jet's, from frame `t` to the next."""
        found = self._survey
        if found is None or (jet := found.jets[t]) is None or self._config.variant == "per_frame":
            return None
        return Fall(jet, found.jet_floor(t), found.turn, self.grid, float(self._times[t + 1] - self._times[t]))

    def landed(self, t: int, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Where carriers that fly from `start` to `end` [N, 3] (transport grid) come to rest in frame `t`."""
        return end if self._survey is None else self._survey.landed(self.grid, t, start, end)

    def simulation(self, scene: TrainingScene, seed: int) -> Callable[[np.ndarray, np.ndarray, np.ndarray], Simulation]:
        """Starts FLIP from the first carriers. Raises SplashbenchError where it is not known how things fall."""
        gravity = gravity_in_voxels(scene, self.grid)
        mesh = scene.container_mesh()
        solid = None if mesh is None else solid_distance(mesh, self.grid)

        def start(phi: np.ndarray, ids: np.ndarray, positions: np.ndarray) -> Simulation:
            solver = FlipSolver(self.grid.shape, gravity, solid)
            ratio = self.grid.voxel / self.hull_grid.voxel
            transport = FlipTransport(solver, phi, ratio, ids, positions, np.random.default_rng([seed, 2]))
            return _Steps(transport, np.diff(self._times), self.motion)

        return start

    def seen(self, phi: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Which hull-grid coordinates `points` [N, 3] the training views see in phi (transport voxels): bool [N]."""
        ratio = self.grid.voxel / self.hull_grid.voxel
        limit = SEEN_THROUGH * self._config.shell_depth * ratio
        return seen_by_any(phi, self.hull_grid, points, self.silhouettes.cameras, self._shadows, limit, ratio)


@dataclass(frozen=True)
class _Steps:
    """FLIP by the scene's frame steps."""

    transport: FlipTransport
    durations: np.ndarray
    motion: Motion

    def forecast(self, ids: np.ndarray, deformation: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray]:
        return self.transport.forecast(ids, deformation, float(self.durations[step]), self.motion.step(step))


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
        observations.simulation(scene, run.seed) if config.variant == "flip" else None,
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

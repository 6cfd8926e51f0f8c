"""From masks to carriers through all frames: what is observed, the motion between frames, and what it moves.

It needs no background, and no photograph but for what these say of masks and containers. What the carriers look like
comes later (reconstruction.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from splashbench.files import compressed_bytes
from splashbench.harness.contract import Run
from splashbench.native import memory
from splashbench.observe.container import solid_distance
from splashbench.scene.scene import TrainingScene

from .carriers.coverage import uncovered_by_any
from .carriers.precision import Precision
from .carriers.subframe import Track
from .carriers.tracking import CarrierTracker, Simulation, Tracking
from .carriers.visibility import seen_by_any
from .fields.container import KnownContainer
from .fields.observations import Observations, Sightings, observe
from .fields.sparse_frames import SparseFrames
from .flip.solver import FlipSolver, FlipTransport, gravity_in_voxels
from .motion.observed_frames import observed_frames
from .motion.steps import FrameStep, Motion
from .motion.velocity import control_shape
from .settings import SplashSplatConfig
from .storage.packing import pack_distance, packed_bytes
from .storage.signed_distance import coarse_distance, reach
from .storage.track import stored_track, track_arrays

# A carrier is seen through at most this many shells of liquid.
_SEEN_THROUGH = 1.5


@dataclass
class Traced:
    """The liquid before its appearance: what was observed, and carriers through all frames, what moved them and phi in
    the precision of the files. config: with what the observations decide."""

    observations: Observations
    track: Track
    config: SplashSplatConfig

    @property
    def track_bytes(self) -> dict[str, int]:
        """How much of the files the track takes: "carriers", "motion" and "distance"."""
        arrays = track_arrays(self.track, self.config.carried)
        sizes = {name: packed_bytes(file) for name, file in arrays.items()}
        return sizes | {"distance": compressed_bytes(pack_distance(self.track.phi))}

    def keep(self, chosen: np.ndarray) -> np.ndarray:
        """Go on with the carriers `chosen` (bool [count]) alone; returns the numbers that they had, int64. In place, so
        that nobody holds the others, which are large."""
        carriers, rows = self.track.carriers.keep(chosen)
        self.track = replace(self.track, carriers=carriers)
        return rows


def trace_liquid(
    scene: TrainingScene,
    config: SplashSplatConfig,
    run: Run,
    known: KnownContainer | None = None,
    before: Sightings | None = None,
) -> Traced:
    """Observe the liquid of `scene` and follow it; needs no background. known, before: see `observe`."""
    memory.give_back()
    observations = observe(scene, config.fields, run, run.progress, known, before)
    if observations.in_transparent_container:
        config = config.in_transparent_container()
        sooner = ", and idle carriers are looked for sooner" if config.idle_early else ""
        run.note("shell", f"{config.shell_depth:g} voxels, as the container is transparent{sooner}")
    distance_steps = reach(config.decoder.opacity_slope, config.decoder.opacity_band)
    track = _track(observations, scene, config, run, distance_steps)
    with run.stage("carriers"):
        memory.give_back()
        precision = Precision.of(observations.voxel_pixels)
        run.note("precision", str(precision))
        return Traced(observations, stored_track(track, scene.times, config.carried, precision), config)


def _track(
    observations: Observations,
    scene: TrainingScene,
    config: SplashSplatConfig,
    run: Run,
    distance_steps: int,
) -> Track:
    """Carriers through all frames, what moved them, and the packed phi_t, in `distance_steps` to either side."""
    grid, settings = observations.grid, config.motion
    tracker = CarrierTracker(_tracking(observations, scene, config, run.seed))
    steps: list[FrameStep] = []
    packed = SparseFrames(grid.shape)
    for frame in observed_frames(observations, scene, settings, run, run.progress):
        packed.append(coarse_distance(frame.packed, distance_steps))
        if frame.step is not None:
            steps.append(frame.step)
        with run.stage("carriers"):
            tracker.advance(frame.phi, frame.step, frame.repeated)
        del frame  # on the hull grid, while the next one is carved
    factor = settings.factor(grid.shape)
    return Track(grid, tracker.carriers(), Motion.of(steps, control_shape(grid.shape, factor), factor), packed)


def _tracking(observations: Observations, scene: TrainingScene, config: SplashSplatConfig, seed: int) -> Tracking:
    def seen(phi: np.ndarray, points: np.ndarray) -> np.ndarray:
        cameras, depths = observations.silhouettes.cameras, observations.container_depths
        limit = _SEEN_THROUGH * config.shell_depth * observations.ratio
        return seen_by_any(phi, observations.hull_grid, points, cameras, depths, limit, observations.ratio)

    def uncovered(t: int, phi: np.ndarray) -> np.ndarray:
        return uncovered_by_any(
            phi,
            observations.hull_grid,
            observations.silhouettes,
            t,
            observations.container_depths,
            config.coverage_reach,
            observations.ratio,
        )

    return Tracking(
        observations.hull_grid,
        observations.grid,
        config.carriers,
        seed,
        seen=seen if config.visible_only else None,
        uncovered=uncovered if config.coverage_reach > 0 else None,
        landed=observations.landed if config.ballistic else None,
        simulation=_simulation(observations, scene, seed) if config.variant == "flip" else None,
        keep_deformation=not config.carried,
    )


@dataclass(frozen=True)
class _TimedFlip:
    """FLIP by the scene's frame steps; durations: [T - 1] seconds."""

    transport: FlipTransport
    durations: np.ndarray

    def forecast(
        self, ids: np.ndarray, deformation: np.ndarray, number: int, observed: FrameStep
    ) -> tuple[np.ndarray, np.ndarray]:
        return self.transport.forecast(ids, deformation, float(self.durations[number]), observed)


def _simulation(
    observations: Observations, scene: TrainingScene, seed: int
) -> Callable[[np.ndarray, np.ndarray, np.ndarray], Simulation]:
    """Starts FLIP from the first carriers. Raises SplashbenchError where it is not known how things fall."""
    grid = observations.grid
    gravity = gravity_in_voxels(scene, grid)
    mesh = scene.container_mesh()
    solid = None if mesh is None else solid_distance(mesh, grid)

    def start(phi: np.ndarray, ids: np.ndarray, positions: np.ndarray) -> Simulation:
        solver = FlipSolver(grid.shape, gravity, solid)
        rng = np.random.default_rng([seed, 2])
        transport = FlipTransport(solver, phi, observations.ratio, ids, positions, rng)
        return _TimedFlip(transport, np.diff(scene.times))

    return start

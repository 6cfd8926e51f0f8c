"""From masks to the fitted liquid: observation fields, motion, carriers, appearance (paper, Fig. "pipeline").

Each name stands for a folder: `fields` observes the whole sequence, `motion` gives one observed frame after another
with what moved the liquid there, `carriers` follow frame by frame, and `appearance` is fitted to the photographs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from splashbench.files import compressed_bytes
from splashbench.gaussians.devices import CPU
from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.harness.contract import Run
from splashbench.native import memory
from splashbench.observe.container import solid_distance
from splashbench.render import Frozen
from splashbench.render.constants import MIN_ALPHA
from splashbench.scene.scene import TrainingScene

from .appearance.coarse import HALVINGS, set_smaller_backgrounds, with_smaller
from .appearance.first_look import photographed, take_on
from .appearance.fitting import Appearance, Fit, fit_appearance, initial_appearance, visible_carriers
from .appearance.glass import glass_before
from .appearance.iterations import iterations_decision
from .appearance.schedule import Clock
from .appearance.sensitivity import Sensitivity
from .appearance.targets import collect_targets, set_backgrounds
from .appearance.warm_start import Learned, hand_on
from .carriers.coverage import uncovered_by_any
from .carriers.precision import Precision
from .carriers.subframe import Track
from .carriers.tracking import CarrierTracker, Simulation, Tracking
from .carriers.visibility import seen_by_any
from .fields.container import KnownContainer
from .fields.observations import Observations, Sightings, observe
from .fields.occlusion import LiquidOcclusion
from .flip.solver import FlipSolver, FlipTransport, gravity_in_voxels
from .model import Liquid
from .motion.observed_frames import observed_frames
from .motion.steps import FrameStep, Motion
from .motion.velocity import control_shape
from .settings import SplashSplatConfig
from .storage.signed_distance import reach
from .storage.steps import Storage, Stored
from .storage.track import carrier_arrays, stored_track, track_arrays

Report = Callable[[float, str], None]
#: The liquid, and what hides it from cameras.
Reconstruction = tuple[Liquid, LiquidOcclusion | None]

# Share of the seconds left for the appearance that storing it takes, and seconds beside.
_STORING, _STORING_LEAST = 0.03, 1.0
# Bytes of liquid.json and of the decoder's heads, roundly.
_HEADER = 12_000
# A carrier is seen through at most this many shells of liquid.
_SEEN_THROUGH = 1.5
# Pixels along the longer side of the images for which the setting `glass` is meant.
_GLASS_SIDE = 240


@dataclass(frozen=True)
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
        return {name: compressed_bytes(file) for name, file in arrays.items()}


def _clock(run: Run) -> Clock | None:
    """When the appearance has to be done, by the run's budget: storing takes a share of what is left for it."""
    if run.budget.seconds is None:
        return None
    left = max(run.budget.seconds - run.seconds, 0.0)
    return Clock(lambda: run.seconds, run.budget.seconds - min(_STORING * left + _STORING_LEAST, 0.5 * left))


def trace_liquid(
    scene: TrainingScene,
    config: SplashSplatConfig,
    run: Run,
    known: KnownContainer | None = None,
    before: Sightings | None = None,
) -> Traced:
    """Observe the liquid of `scene` and follow it; needs no background. known, before: see `observe`."""
    observations = observe(scene, config.fields, run, run.progress, known, before)
    if observations.in_transparent_container:
        config = config.in_transparent_container()
        sooner = ", and idle carriers are looked for sooner" if config.idle_early else ""
        run.note("shell", f"{config.shell_depth:g} voxels, as the container is transparent{sooner}")
    track = _track(observations, scene, config, run, run.progress)
    with run.stage("carriers"):
        memory.give_back()
        steps = reach(config.decoder.opacity_slope, config.decoder.opacity_band)
        precision = Precision.of(observations.voxel_pixels)
        run.note("precision", str(precision))
        return Traced(observations, stored_track(track, scene.times, config.carried, steps, precision), config)


def fit_liquid(
    scene: TrainingScene,
    backgrounds: dict[str, np.ndarray],
    traced: Traced,
    run: Run,
    span: tuple[float, float] = (0.0, 1.0),
    frozen: Mapping[str, Frozen] | None = None,
    offer: Callable[[Callable[[], Reconstruction], bool], None] | None = None,
    settled: Callable[[], dict[str, np.ndarray]] | None = None,
    room: Callable[[], int] | None = None,
    learned: list[Learned] | None = None,
    keep: Callable[[Learned], None] | None = None,
) -> Reconstruction:
    """Fit the appearance of the liquid of `scene`; returns it, and what hides it from cameras.

    backgrounds: float32 [H, W, 3] of every training view, in [0, 1], and emptied once there are others (`settled`); or
    [3] where `frozen` has the background's Gaussians of every view, to be drawn together with the liquid's. span: the
    part of `run`'s progress this takes up. offer: is given, after iterations of the appearance, what makes the
    reconstruction as if the fit ended there, and whether there will be no other for a while. settled: where given,
    `backgrounds` are for the first iterations (`plates_share`), and this gives those for the others.
    room: where given, the bytes that the liquid may take, asked for at the end. learned: on coarser grids, to begin
    with; taken out of the list, as it is large. keep: is given what was learned of all carriers, where there is any
    photograph.
    """
    config, observations, track = traced.config, traced.observations, traced.track
    occlusion = observations.occlusion
    if occlusion is not None and frozen is not None:
        occlusion = occlusion.uncut()  # the background's Gaussians hide what is behind them themselves
    composition = config.composition if frozen is not None else "over"

    def reconstruction(
        appearance: Appearance, left: np.ndarray, sensitivity: Sensitivity | None = None, step: float | None = None
    ) -> Reconstruction:
        kept, look = _pruned(track, appearance, left)
        made = (scene.times, kept, look, config.carried, composition, config.between_frames)
        if sensitivity is None or step is None:
            return Liquid.of(*made), occlusion
        return Liquid.of(*made, sensitivity.kept(np.flatnonzero(left)), step), occlusion

    def shown(appearance: Appearance, left: np.ndarray) -> np.ndarray:
        return left & visible_carriers(appearance, config.prune_opacity)

    def as_it_is(appearance: Appearance, left: np.ndarray) -> Reconstruction:
        return reconstruction(appearance, shown(appearance, left))

    def offer_state(state: Callable[[], tuple[Appearance, np.ndarray]], milestone: bool) -> None:
        assert offer is not None
        offer(lambda: as_it_is(*state()), milestone)

    with run.stage("appearance"), one_torch_thread():
        found, fit = _fit_appearance(
            track,
            observations,
            occlusion,
            scene,
            backgrounds,
            frozen,
            config,
            run.seed,
            lambda done: run.progress(span[0] + (span[1] - span[0]) * done, "appearance"),
            None if offer is None else offer_state,
            settled,
            _clock(run),
            run.device,
            learned,
            keep is not None,
        )
    memory.forget()  # what comes has other sizes
    appearance = found.appearance
    if keep is not None and fit is not None:
        keep(found)
    if fit is not None and fit.earned:
        run.decide(iterations_decision(fit.earned, fit.begun + len(fit.losses)))
    if fit is None:
        return reconstruction(appearance, np.ones(track.carriers.count, dtype=bool))
    left = shown(appearance, fit.left)
    sensitivity = fit.sensitivity
    if sensitivity is None:
        return reconstruction(appearance, left)
    with run.stage("storing"), one_torch_thread():
        memory.give_back()
        taken = 0 if occlusion is None else occlusion.stored_bytes
        stored = _within_tolerance(track, appearance, left, fit, config, run, None if room is None else room() - taken)
        del fit, found  # large: the photographs, and what was known of all carriers
        memory.forget()
        return reconstruction(appearance, stored.kept, sensitivity, stored.step)


def _within_tolerance(
    track: Track,
    appearance: Appearance,
    left: np.ndarray,
    fit: Fit,
    config: SplashSplatConfig,
    run: Run,
    room: int | None,
) -> Stored:
    """How the carriers `left` (bool [count]) are stored. room: where given, the bytes that the liquid may take."""
    storage = Storage(appearance, left, fit, run.seed)
    stored, decision = storage.within_tolerance(config.storage_tolerance)
    run.decide(decision)
    if room is None:
        return stored
    arrays = track_arrays(track, config.carried)
    fixed = _HEADER + sum(compressed_bytes(arrays[name]) for name in ("motion", "distance"))

    def other_bytes(kept: np.ndarray) -> int:
        return fixed + compressed_bytes(carrier_arrays(track, track.carriers.keep(kept)[0], config.carried))

    stored, spent = storage.within_room(room - _glass_bytes(appearance), stored, other_bytes)
    if spent is not None:
        run.decide(spent)
    return stored


def _glass_bytes(appearance: Appearance) -> int:
    """How much of the files glass takes, at the most."""
    tables = {} if appearance.glass is None else appearance.glass.tables
    return sum(2 * table.numel() for table in tables.values())


def _track(
    observations: Observations, scene: TrainingScene, config: SplashSplatConfig, run: Run, report: Report
) -> Track:
    """Carriers through all frames, what moved them, and the packed phi_t."""
    grid, settings = observations.grid, config.motion
    tracker = CarrierTracker(_tracking(observations, scene, config, run.seed))
    steps: list[FrameStep] = []
    packed = np.zeros((observations.n_frames, *grid.shape), dtype=np.int8)
    for t, frame in enumerate(observed_frames(observations, scene, settings, run, report)):
        packed[t] = frame.packed
        if frame.step is not None:
            steps.append(frame.step)
        with run.stage("carriers"):
            tracker.advance(frame.phi, frame.step, frame.repeated)
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


def _fit_appearance(
    track: Track,
    observations: Observations,
    occlusion: LiquidOcclusion | None,
    scene: TrainingScene,
    backgrounds: dict[str, np.ndarray],
    frozen: Mapping[str, Frozen] | None,
    config: SplashSplatConfig,
    seed: int,
    progress: Callable[[float], None],
    offer: Callable[[Callable[[], tuple[Appearance, np.ndarray]], bool], None] | None,
    settled: Callable[[], dict[str, np.ndarray]] | None,
    clock: Clock | None,
    device: str,
    learned: list[Learned] | None,
    handed_on: bool,
) -> tuple[Learned, Fit | None]:
    """What was learned of the carriers of `track`, fitted to the photographs whose masks did not fail; None where there
    are none. learned: what it begins with. handed_on: whether another fit begins with what this one learns."""
    voxel = observations.grid.voxel
    appearance = initial_appearance(track.carriers.count, voxel, config.optimisation, config.decoder, seed)
    # Gaussians of the background that are drawn together with the liquid's are prepared for one size.
    longest = max(max(camera.width, camera.height) for camera in scene.cameras.values())
    coarse = frozen is None and config.coarse_share > 0 and longest > config.coarse_side
    memory.give_back()
    targets = collect_targets(
        scene,
        backgrounds,
        track,
        config.silhouette_norm,
        camera_times=config.camera_times,
        trusted=~(observations.silhouettes.failed_masks | observations.repeated[:, None]),
        hidden=None if occlusion is None else lambda name, points: occlusion.hidden(scene.cameras[name], points),
        cut=None if occlusion is None else lambda name, points: occlusion.cut(scene.cameras[name], points),
        frozen=frozen,
        blocks=2**HALVINGS if coarse else 1,
    )
    if coarse:
        nowhere = np.zeros((0, 3))
        cuts = {
            name: None if occlusion is None else occlusion.cut(scene.cameras[name], nowhere) for name in scene.train
        }
        with_smaller(targets, backgrounds, {name: None if cut is None else cut[0] for name, cut in cuts.items()})
    memory.give_back()
    if observations.in_transparent_container and frozen is None:
        # Edges have so many more pixels along them.
        appearance.glass = glass_before(track, round(config.glass * longest / _GLASS_SIDE), seed)
    if not targets:
        return Learned(track, appearance, None), None
    look = photographed(track, targets) if config.first_look else None
    optimisation = replace(config.optimisation, handed_on=handed_on and config.price > 0)
    if learned:
        hand_on(learned.pop(), track, look, appearance, config.base_scale)
        # Of the iterations on these grids, the first ones have stand-ins for the background.
        plates_share = 1 - (1 - config.coarse_grids_share) * (1 - config.plates_share)
        optimisation = replace(optimisation, begun=config.coarse_iterations, plates_share=plates_share)
    elif look is not None:
        take_on(look, appearance.features, appearance.decoder)
    if device != CPU:
        set_backgrounds(targets, backgrounds, device)
        set_smaller_backgrounds(targets, backgrounds, device)
    color_cell = observations.hull_grid.voxel / voxel

    def settle() -> None:
        if settled is not None:
            behind = settled()
            set_backgrounds(targets, behind, device)
            set_smaller_backgrounds(targets, behind, device)
            backgrounds.clear()  # nobody needs those of before, which are large

    fit = fit_appearance(
        appearance,
        track,
        targets,
        optimisation,
        color_cell,
        seed,
        progress,
        offer,
        settle,
        clock,
        device,
    )
    return Learned(track, appearance, look), fit


def _pruned(track: Track, appearance: Appearance, kept: np.ndarray) -> tuple[Track, Appearance]:
    """The carriers `kept` (bool [count]) alone, and the glass that can be seen."""
    carriers, rows = track.carriers.keep(kept)
    glass = None if appearance.glass is None else appearance.glass.kept(MIN_ALPHA)
    look = Appearance(appearance.features[rows], appearance.log_scales[rows], appearance.decoder, glass)
    return replace(track, carriers=carriers), look

"""phi_t of one frame after another, each with the motion that led to it (paper, "Observed motion").

Two frames are in memory at a time. In a study the runs share phi_t and the fitted velocities (`Run.reuse`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from splashbench.harness.contract import Run
from splashbench.scene.scene import TrainingScene

from ..fields.observations import Observations, Report, pack_signed_distance
from ..fields.signed_distance_file import SignedDistanceFile, shared_signed_distances
from .fall import JetFall
from .gate import gated
from .steps import FrameStep
from .velocity import Factor, VelocitySettings, control_shape, factor_of_sides, fit_velocity

# Parts of the progress in a study, which has phi_t of all frames first, then the velocities, then the carriers.
_DISTANCES_DONE, _VELOCITIES_DONE = 0.5, 0.9


@dataclass(frozen=True)
class MotionSettings:
    """control_factor: transport voxels per control cell. gate: see gate.py. moves: False leaves out all motion.

    control_cells: along every side of the box, in place of cubic cells; None for these. carry_on: start the fit of a
    step from the motion of the one before, not from none.
    """

    control_factor: int
    gate: bool = True
    moves: bool = True
    velocity: VelocitySettings = field(default_factory=VelocitySettings)
    control_cells: int | None = None
    carry_on: bool = False

    def factor(self, shape: tuple[int, int, int]) -> Factor:
        """Transport voxels per control cell on a transport grid of `shape`."""
        return self.control_factor if self.control_cells is None else factor_of_sides(shape, self.control_cells)


@dataclass(frozen=True)
class ObservedFrame:
    """One frame.

    phi: phi_t on the hull grid, float32 in transport voxels. packed: int8 on the transport grid, see
    `pack_signed_distance`. step: what moved the liquid since the frame before; None in the first. repeated: whether it
    shows nothing new.
    """

    phi: np.ndarray
    packed: np.ndarray
    step: FrameStep | None
    repeated: bool = False


def observed_frames(
    observations: Observations, scene: TrainingScene, settings: MotionSettings, run: Run, report: Report
) -> Iterator[ObservedFrame]:
    """The frames of `scene` in order. report: hears the share of them that are done with, as the next is asked for."""
    fit = _MotionFit(observations, scene.times, settings, run)
    if run.cache is None:
        what = "signed distance, velocity, carriers" if settings.moves else "carriers"
        yield from _frames(observations, observations.signed_distances(run), fit.control, fit, 0.0, what, report)
        return
    with shared_signed_distances(
        observations, scene, run, lambda done, what: report(_DISTANCES_DONE * done, what)
    ) as distances:
        controls = _shared_controls(distances, observations, scene, fit, report) if settings.moves else None
        yield from _frames(
            observations,
            distances,
            lambda t, before, now: fit.still if controls is None else controls[t],
            fit,
            _VELOCITIES_DONE,
            "carriers",
            report,
        )


def _frames(
    observations: Observations,
    distances: Iterable[np.ndarray],
    control: Callable[[int, np.ndarray, np.ndarray], np.ndarray],
    fit: _MotionFit,
    progress: float,
    what: str,
    report: Report,
) -> Iterator[ObservedFrame]:
    """`distances` with their steps. control: u_t, given t, phi_t and phi_{t+1}. progress: what lies behind."""
    before: np.ndarray | None = None
    for t, stored in enumerate(distances):
        with fit.run.stage("signed distance"):
            phi, now = observations.in_transport_voxels(stored)
            packed = pack_signed_distance(now)
        step = None
        repeated = bool(observations.repeated[t])
        if before is not None and repeated:
            step = FrameStep(fit.still, fit.factor)
        elif before is not None:
            step = FrameStep(control(t - 1, before, now), fit.factor, fit.fall(t - 1))
        before = now
        frame = ObservedFrame(phi, packed, step, repeated)
        del stored, phi, packed, now
        yield frame
        del frame  # large, and the next one comes
        report(progress + (1 - progress) * (t + 1) / observations.n_frames, what)


class _MotionFit:
    """The motion of each step of a sequence; times: [T] seconds."""

    def __init__(self, observations: Observations, times: np.ndarray, settings: MotionSettings, run: Run) -> None:
        self.observations, self.times, self.settings, self.run = observations, times, settings, run
        #: transport voxels per control cell
        self.factor = settings.factor(observations.grid.shape)
        shape = control_shape(observations.grid.shape, self.factor)
        #: no motion, on the control grid
        self.still = np.zeros((*shape, 3), dtype=np.float32)
        # What the frame before has, before it was gated.
        self._last = self.still

    def control(self, t: int, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """u_t on the control grid, float32 [cx, cy, cz, 3] voxels per frame."""
        settings, factor = self.settings, self.factor
        if not settings.moves:
            return self.still
        with self.run.stage("velocity"):
            start = self._last if settings.carry_on else None
            control = self._last = fit_velocity(before, after, factor, settings.velocity, start).control
            return gated(control, factor, before, after) if settings.gate else control

    def fall(self, t: int) -> JetFall | None:
        """The jet's, from frame `t` to the next."""
        cues = self.observations.cues
        if cues is None or (jet := cues.jets[t]) is None or not self.settings.moves:
            return None
        seconds = float(self.times[t + 1] - self.times[t])
        return JetFall(jet, cues.jet_floor(t), cues.turn, self.observations.grid, seconds)


def _shared_controls(
    distances: SignedDistanceFile, observations: Observations, scene: TrainingScene, fit: _MotionFit, report: Report
) -> np.ndarray:
    """u of all steps, float32 [T - 1, cx, cy, cz, 3] voxels per frame."""
    settings = fit.settings

    def fit_all() -> np.ndarray:
        controls = np.zeros((distances.n_frames - 1, *fit.still.shape), dtype=np.float32)
        before: np.ndarray | None = None
        for t, phi in enumerate(distances):
            _, now = observations.in_transport_voxels(phi)
            if before is not None and not observations.repeated[t]:
                controls[t - 1] = fit.control(t - 1, before, now)
            before = now
            done = (t + 1) / distances.n_frames
            report(_DISTANCES_DONE + (_VELOCITIES_DONE - _DISTANCES_DONE) * done, "velocity")
        return controls

    def save(controls: np.ndarray, directory: Path) -> None:
        np.save(directory / "velocities.npy", controls)

    def load(directory: Path) -> np.ndarray:
        return np.load(directory / "velocities.npy")

    key = {**observations.settings.key(), "transport_cells": observations.settings.transport_cells, **asdict(settings)}
    return fit.run.reuse("velocities", scene, key, fit_all, save, load, seeded=False)

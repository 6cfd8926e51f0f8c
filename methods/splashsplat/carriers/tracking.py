"""Carriers through forecast, correct, resample (paper, "Forecast, Correct, Resample", Eq. carrier_union).

Each new observation removes what drifted out of the liquid and refills the shell below its surface. Two bounds the
paper does not mention keep the population finite: crowded cells keep their oldest carriers only, and carriers that
sank below the shell are dropped. A third, by choice, keeps appearance up to date: a carrier lasts a few frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from splashbench.observe.grid import Grid
from splashbench.observe.kernels import sample

from ..motion.steps import FrameStep
from .correction import correct
from .population import Carriers, undeformed
from .resampling import ShellSettings, cell_of, newborns, within_capacity

TrackingVariant = Literal["full", "no_resampling", "per_frame", "flip"]


@dataclass(frozen=True)
class CarrierSettings:
    """Distances in transport voxels.

    lifetime: frames that a carrier lasts on average, None for as long as it stays in the liquid. A new one takes its
    place and learns an appearance of its own. What a carrier shows changes within a few frames, and so does whether it
    is of the liquid or of the hull's phantom volume. `variant` picks the paper's ablations; "full" is the
    method. "no_resampling": carriers of the first liquid only. "per_frame": new ones in every frame, none moved.
    "flip": carriers of the first liquid, moved by a simulation that looks at no other frame (flip/).
    """

    variant: TrackingVariant = "full"
    correction: float = 1.0
    kill_outside: float = 0.5
    kill_inside: float | None = -3.0
    cell_capacity: int | None = 4
    lifetime: int | None = None
    shell: ShellSettings = field(default_factory=ShellSettings)


class Simulation(Protocol):
    """Moves carriers by itself from where it was started."""

    def forecast(
        self, ids: np.ndarray, deformation: np.ndarray, number: int, observed: FrameStep
    ) -> tuple[np.ndarray, np.ndarray]:
        """Positions [N, 3] and F [N, 3, 3] of the carriers `ids` after the frame step `number`, counted from 0.

        observed: the motion that was fitted to that step.
        """
        ...


@dataclass(frozen=True)
class Tracking:
    """What the loop needs besides the frames.

    hull_grid: of phi_t. grid: the transport grid, of carriers and motion. seen: given phi_t and hull-grid coordinates
    [N, 3], which of them a view sees (bool [N]); where given, no carrier is born elsewhere. uncovered: given t and
    phi_t, where (hull-grid coordinates [N, 3]) carriers are born beyond the shell, for pixels without any. landed:
    given t, where carriers are in frame t - 1 and where they fly to, where they come to rest in frame t, all [N, 3].
    keep_deformation: whether `carriers` tells F; where the motion alone makes it, it can be had from that.
    simulation: makes one from phi_t, ids and positions of the first carriers; the variant "flip" needs it.
    """

    hull_grid: Grid
    grid: Grid
    settings: CarrierSettings
    seed: int
    seen: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    uncovered: Callable[[int, np.ndarray], np.ndarray] | None = None
    landed: Callable[[int, np.ndarray, np.ndarray], np.ndarray] | None = None
    simulation: Callable[[np.ndarray, np.ndarray, np.ndarray], Simulation] | None = None
    keep_deformation: bool = True


class CarrierTracker:
    """The loop: `advance` by one frame after another, then `carriers`."""

    def __init__(self, tracking: Tracking) -> None:
        self._tracking, self._settings = tracking, tracking.settings
        self._ratio = np.float32(tracking.grid.voxel / tracking.hull_grid.voxel)
        self._ids = np.zeros(0, dtype=np.int32)
        self._x = np.zeros((0, 3), dtype=np.float32)
        self._F = np.zeros((0, 3, 3), dtype=np.float32)
        # Of every carrier so far, the last frame that it may see.
        self._last_frames = np.zeros(0, dtype=np.int64)
        self._simulation: Simulation | None = None
        self._frames: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []

    def advance(self, phi: np.ndarray, step: FrameStep | None, repeated: bool = False) -> None:
        """To the next frame.

        phi: phi_t on the hull grid, transport voxels. step: the motion since the frame before; None in the first frame.
        repeated: whether the frame shows nothing new, so that carriers stay as they are and do not age.
        """
        t = len(self._frames)
        if repeated and self._settings.variant != "per_frame" and self._simulation is None:
            self._last_frames[self._ids] += 1
            self._frames.append(self._frames[-1])
            return
        if self._settings.variant == "per_frame":
            self._keep(slice(0))
        elif step is not None and self._simulation is not None:
            self._x, self._F = self._simulation.forecast(self._ids, self._F, t - 1, step)
            self._keep(sample(phi, self._x * self._ratio) <= self._settings.kill_outside)
        elif step is not None and len(self._ids):
            self._forecast(t, phi, step)
        # Without resampling, the first frame that shows liquid is the only one that gives carriers.
        born = len(self._last_frames)
        if self._settings.variant not in ("no_resampling", "flip") or born == 0:
            self._resample(t, phi, born)
        self._frames.append((self._ids, self._x, self._F, sample(phi, self._x * self._ratio)))

    def carriers(self) -> Carriers:
        """The carriers of all frames so far."""
        starts = np.concatenate([[0], np.cumsum([len(ids) for ids, *_ in self._frames])]).astype(np.int64)
        columns = list(zip(*self._frames))
        ids, positions, phi = (np.concatenate(columns[number]) for number in (0, 1, 3))
        deformation = np.concatenate(columns[2]) if self._tracking.keep_deformation else undeformed(len(ids))
        self._frames = []
        return Carriers(starts, ids, positions, deformation, phi, len(self._last_frames))

    def _forecast(self, t: int, phi: np.ndarray, step: FrameStep) -> None:
        """Forecast, correct, and drop what left the liquid, outlived its time or crowds a cell."""
        start, settings = self._x, self._settings
        if self._tracking.keep_deformation:
            self._x, self._F = step.forecast(start, self._F)
        else:
            self._x = step.moved(start)
        if self._tracking.landed is not None:
            self._x = self._tracking.landed(t, start, self._x)
        x = self._x = correct(phi, self._x, float(self._ratio), settings.correction)
        alive = _alive(phi, x, self._ratio, settings) & (self._last_frames[self._ids] >= t)
        if settings.cell_capacity is not None:
            cells = cell_of(x[alive], self._tracking.grid)
            alive[alive] = within_capacity(cells, self._ids[alive], settings.cell_capacity)
        self._keep(alive)

    def _resample(self, t: int, phi: np.ndarray, born: int) -> None:
        """New carriers where the shell of phi_t is short of them, numbered from `born`."""
        tracking, settings = self._tracking, self._settings
        rng = np.random.default_rng([tracking.seed, t])
        new = newborns(phi, tracking.grid, float(self._ratio), self._x, settings.shell, rng)
        if tracking.seen is not None:
            new = new[tracking.seen(phi, new * self._ratio)]
        if tracking.uncovered is not None:
            new = np.concatenate([new, tracking.uncovered(t, phi) / self._ratio])
        self._ids = np.concatenate([self._ids, np.arange(born, born + len(new), dtype=np.int32)])
        self._x = np.concatenate([self._x, new])
        self._F = (
            np.concatenate([self._F, undeformed(len(new))])
            if self._tracking.keep_deformation
            else undeformed(len(self._ids))
        )
        ages = _ages(len(new), settings.lifetime, np.random.default_rng([tracking.seed, t, 1]))
        self._last_frames = np.concatenate([self._last_frames, t + ages])
        if tracking.simulation is not None and settings.variant == "flip" and len(self._last_frames):
            self._simulation = tracking.simulation(phi, self._ids, self._x)

    def _keep(self, chosen: np.ndarray | slice) -> None:
        self._ids, self._x = self._ids[chosen], self._x[chosen]
        self._F = self._F[chosen] if self._tracking.keep_deformation else undeformed(len(self._ids))


def _ages(count: int, lifetime: int | None, rng: np.random.Generator) -> np.ndarray:
    """How many frames after its first each of `count` new carriers may last, int64 [count].

    Spread, so that those of one frame do not all go in one frame.
    """
    if lifetime is None:
        return np.full(count, np.iinfo(np.int32).max, dtype=np.int64)
    return rng.integers(0, 2 * lifetime - 1, count)


def _alive(phi: np.ndarray, x: np.ndarray, ratio: np.float32, settings: CarrierSettings) -> np.ndarray:
    """Carriers not left outside, nor sunk below the shell: bool [N]."""
    depth = sample(phi, x * ratio)
    alive = depth <= settings.kill_outside
    if settings.kill_inside is not None:
        alive &= depth >= settings.kill_inside
    return alive

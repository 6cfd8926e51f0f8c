"""Carriers through forecast, correct, resample (paper, "Forecast, Correct, Resample", Eq. carrier_union).

Each new observation removes what drifted out of the liquid and refills the shell below its surface. Two bounds the
paper does not mention keep the population finite: crowded cells keep their oldest carriers only, and carriers that
sank below the shell are dropped. A third, by choice, keeps appearance up to date: a carrier lasts a few frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from splashbench.observe.grid import Grid
from splashbench.observe.kernels import sample

from ..motion.step import Motion
from .resampling import ShellSettings, cell_of, newborns, within_capacity
from .transport import correct

Variant = Literal["full", "no_resampling", "per_frame", "flip"]


@dataclass(frozen=True)
class CarrierSettings:
    """Distances in transport voxels.

    lifetime: frames that a carrier lasts on average, None for as long as it stays in the liquid. A new one takes its
    place and has its own appearance to learn: what a carrier shows, and whether it is of the liquid at all or of the
    phantom volume of the hull, changes within a few frames. `variant` picks the paper's ablations; "full" is the
    method. "no_resampling": carriers of the first liquid only. "per_frame": new ones in every frame, none moved.
    "flip": carriers of the first liquid, moved by a simulation that looks at no other frame (flip.py).
    """

    variant: Variant = "full"
    correction: float = 1.0
    kill_outside: float = 0.5
    kill_inside: float | None = -3.0
    cell_capacity: int | None = 4
    lifetime: int | None = None
    shell: ShellSettings = field(default_factory=ShellSettings)


class Simulation(Protocol):
    """Moves carriers by itself from where it was started."""

    def forecast(self, ids: np.ndarray, deformation: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions [N, 3] and F [N, 3, 3] of the carriers `ids` after the frame step number `step`."""
        ...


@dataclass
class Carriers:
    """All carriers of a sequence, frame by frame.

    starts: int64 [T + 1]; the rows of frame t are starts[t]:starts[t + 1] of the arrays below. ids: int32 [R] carrier
    of each row, ascending within a frame. positions: float32 [R, 3] transport-grid coordinates. deformation: float32
    [R, 3, 3], F. phi: float32 [R] at the carrier, transport voxels. count: number of carriers in all.
    """

    starts: np.ndarray
    ids: np.ndarray
    positions: np.ndarray
    deformation: np.ndarray
    phi: np.ndarray
    count: int

    @property
    def n_frames(self) -> int:
        return len(self.starts) - 1

    def rows(self, t: int) -> slice:
        """Rows of the carriers active in frame `t`."""
        return slice(int(self.starts[t]), int(self.starts[t + 1]))

    def births_and_ends(self) -> tuple[np.ndarray, np.ndarray]:
        """First and last active frame of every carrier, int32 [count] each (b_i and e_i of Eq. carrier_union)."""
        frame = np.repeat(np.arange(self.n_frames, dtype=np.int32), np.diff(self.starts))
        births = np.full(self.count, self.n_frames, dtype=np.int32)
        ends = np.full(self.count, -1, dtype=np.int32)
        np.minimum.at(births, self.ids, frame)
        np.maximum.at(ends, self.ids, frame)
        return births, ends

    def keep(self, wanted: np.ndarray) -> tuple[Carriers, np.ndarray]:
        """Only the carriers with `wanted` (bool [count]), renumbered; and the old number of each, int64."""
        old = np.nonzero(wanted)[0]
        new = np.full(self.count, -1, dtype=np.int32)
        new[old] = np.arange(len(old), dtype=np.int32)
        rows = wanted[self.ids]
        frame = np.repeat(np.arange(self.n_frames), np.diff(self.starts))
        counts = np.bincount(frame[rows], minlength=self.n_frames)
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        kept = Carriers(
            starts,
            new[self.ids[rows]],
            self.positions[rows],
            self.deformation[rows],
            self.phi[rows],
            len(old),
        )
        return kept, old


def track_carriers(
    fields: Iterable[np.ndarray],
    hull_grid: Grid,
    grid: Grid,
    motion: Motion,
    settings: CarrierSettings,
    seed: int,
    seen: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    landed: Callable[[int, np.ndarray, np.ndarray], np.ndarray] | None = None,
    simulation: Callable[[np.ndarray, np.ndarray, np.ndarray], Simulation] | None = None,
) -> Carriers:
    """Run the loop over all frames.

    fields: phi_t on `hull_grid`, one frame after another, in transport voxels. grid: the transport grid. motion: its
    step t - 1 is asked for once phi_t has come. seen: given phi_t and hull-grid
    coordinates [N, 3], which of them a view sees (bool [N]); where given, no carrier is born elsewhere. landed: given
    t, where carriers are in frame t - 1 and where they fly to, where they come to rest in frame t, all [N, 3].
    simulation: makes one from phi_t, ids and positions of the first carriers; the variant "flip" needs it.
    """
    ratio = np.float32(grid.voxel / hull_grid.voxel)
    ids = np.zeros(0, dtype=np.int32)
    x = np.zeros((0, 3), dtype=np.float32)
    F = np.zeros((0, 3, 3), dtype=np.float32)
    lasts = np.zeros(0, dtype=np.int64)  # of every carrier so far, the last frame it may see
    born = 0
    simulated: Simulation | None = None
    frames: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
    for t, phi in enumerate(fields):
        if settings.variant == "per_frame":
            ids, x, F = ids[:0], x[:0], F[:0]
        elif simulated is not None:
            x, F = simulated.forecast(ids, F, t - 1)
            inside = sample(phi, x * ratio) <= settings.kill_outside
            ids, x, F = ids[inside], x[inside], F[inside]
        elif t > 0 and len(ids):
            start = x
            x, F = motion.step(t - 1).forecast(x, F)
            if landed is not None:
                x = landed(t, start, x)
            x = correct(phi, x, float(ratio), settings.correction)
            alive = _alive(phi, x, ratio, settings) & (lasts[ids] >= t)
            if settings.cell_capacity is not None:
                alive[alive] = within_capacity(cell_of(x[alive], grid), ids[alive], settings.cell_capacity)
            ids, x, F = ids[alive], x[alive], F[alive]
        # Without resampling, the first frame that shows liquid is the only one that gives carriers.
        if settings.variant not in ("no_resampling", "flip") or born == 0:
            new = newborns(phi, grid, float(ratio), x, settings.shell, np.random.default_rng([seed, t]))
            if seen is not None:
                new = new[seen(phi, new * ratio)]
            ids = np.concatenate([ids, np.arange(born, born + len(new), dtype=np.int32)])
            x = np.concatenate([x, new])
            F = np.concatenate([F, np.broadcast_to(np.eye(3, dtype=np.float32), (len(new), 3, 3))])
            lasts = np.concatenate([lasts, t + _ages(len(new), settings.lifetime, np.random.default_rng([seed, t, 1]))])
            born += len(new)
            if simulation is not None and settings.variant == "flip" and born:
                simulated = simulation(phi, ids, x)
        frames.append((ids, x, F, sample(phi, x * ratio)))
    starts = np.concatenate([[0], np.cumsum([len(frame[0]) for frame in frames])]).astype(np.int64)
    all_ids, positions, deformation, depth = (np.concatenate(column) for column in zip(*frames))
    return Carriers(starts, all_ids, positions, deformation, depth, born)


def _ages(count: int, lifetime: int | None, rng: np.random.Generator) -> np.ndarray:
    """How many frames after its first each of `count` new carriers may last, int64 [count]; spread, so that those of
    one frame do not all go in one frame."""
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

"""One frame's carriers at any time (paper, supplement, "Sub-frame decoding").

Between two frames carriers are advected by the fraction of the step, forwards or backwards, with the step's u_t,
without correction or resampling, and phi is interpolated linearly between the two observations. What was learned stays
as it is. (The paper goes forwards only; a photograph taken a little before its frame's time is explained by that
frame's own carriers.) How the carriers of two frames show what is between them: between.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from splashbench.observe.grid import Grid
from splashbench.observe.kernels import sample
from splashbench.scene.geometry import STEPS_PER_VOXEL

from ..fields.sparse_frames import Frames
from ..motion.steps import Motion
from .population import Carriers
from .precision import HIGHEST, Precision

# Times nearer to a frame than this fraction of the step are that frame: JSON and the harness round seconds.
_SAME_FRAME = 1e-4


def locate(times: np.ndarray, time: float) -> tuple[int, float]:
    """Frame nearest to `time`, and how far from it `time` lies, clamped to the sequence.

    The distance is a fraction of a step: of the one to the next frame where positive, in (0, 0.5], of the one before
    where negative, in (-0.5, 0).
    """
    times = np.asarray(times, dtype=np.float64)
    if len(times) == 1 or time <= times[0]:
        return 0, 0.0
    if time >= times[-1]:
        return len(times) - 1, 0.0
    t = int(np.searchsorted(times, time, side="right")) - 1
    fraction = float((time - times[t]) / (times[t + 1] - times[t]))
    if fraction < _SAME_FRAME:
        return t, 0.0
    if fraction > 1 - _SAME_FRAME:
        return t + 1, 0.0
    return (t, fraction) if fraction <= 0.5 else (t + 1, fraction - 1)


@dataclass
class CarrierState:
    """What the decoder needs of n active carriers at one instant.

    positions: [n, 3] scene units. deformation: [n, 3, 3], F. phi: [n] transport voxels. visibility: [n] in [0, 1], by
    which opacities are multiplied: less than 1 of carriers that are hidden from the view at hand, or whose frame is not
    the instant's; all are seen by default.
    """

    positions: Tensor
    deformation: Tensor
    phi: Tensor
    visibility: Tensor | None = None

    def to(self, device: str) -> CarrierState:
        """The same on `device`."""
        visibility = None if self.visibility is None else self.visibility.to(device)
        return CarrierState(self.positions.to(device), self.deformation.to(device), self.phi.to(device), visibility)


@dataclass(frozen=True)
class Track:
    """Carriers and what moves them. phi: int8 [T, nx, ny, nz] on `grid`, see `pack_signed_distance`. precision: that
    in which they are stored."""

    grid: Grid
    carriers: Carriers
    motion: Motion
    phi: Frames
    precision: Precision = HIGHEST

    def ids(self, t: int) -> Tensor:
        """Numbers of the carriers of frame `t`, int64 [n]."""
        return torch.from_numpy(self.carriers.ids[self.carriers.rows(t)].astype(np.int64))

    def state(
        self, t: int, fraction: float = 0.0, places: np.ndarray | None = None, phi: np.ndarray | None = None
    ) -> CarrierState:
        """Decoder input of frame `t`'s carriers, a `fraction` in (-1, 1) of a step after the frame; see `locate`.

        places: int64 [n], which of the frame's carriers; None for all. phi: `distances` of all of them, where these are
        known already.
        """
        positions, deformation = self.moved(t, fraction, places)
        if phi is not None:
            phi = _at(phi, places)
        elif fraction != 0 and len(positions):
            phi = self._distances(t, fraction, positions)
        else:
            phi = _at(self.carriers.phi[self.carriers.rows(t)], places)
        places = torch.from_numpy(self.grid.to_scene(positions).astype(np.float32))
        return CarrierState(places, torch.from_numpy(deformation), torch.from_numpy(phi))

    def distances(self, t: int, fraction: float) -> np.ndarray:
        """phi of `state` alone, float32 [n], of all of frame `t`'s carriers."""
        positions, _ = self.moved(t, fraction, None)
        if fraction == 0 or not len(positions):
            return self.carriers.phi[self.carriers.rows(t)]
        return self._distances(t, fraction, positions)

    def _distances(self, t: int, fraction: float, positions: np.ndarray) -> np.ndarray:
        other = t + 1 if fraction > 0 else t - 1
        nearer, farther = (sample(self.phi[frame], positions) / STEPS_PER_VOXEL for frame in (t, other))
        return np.asarray((1 - abs(fraction)) * nearer + abs(fraction) * farther, np.float32)

    def positions(self, t: int, fraction: float = 0.0) -> np.ndarray:
        """The positions of `state` alone, float32 [n, 3]."""
        positions = self.carriers.positions[self.carriers.rows(t)]
        if fraction != 0 and len(positions):
            positions = self.motion.step(t if fraction > 0 else t - 1).moved(positions, fraction)
        return self.grid.to_scene(positions).astype(np.float32)

    def moved(self, t: int, fraction: float, places: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Where frame `t`'s carriers are (transport grid), and their F, a `fraction` of a step after the frame.

        places: as for `state`.
        """
        rows = self.carriers.rows(t)
        positions = _at(self.carriers.positions[rows], places)
        deformation = _floats(self.carriers.deformation[rows], places)
        if fraction == 0 or len(positions) == 0:
            return positions, deformation
        return self.motion.step(t if fraction > 0 else t - 1).forecast(positions, deformation, fraction)


def _at(values: np.ndarray, places: np.ndarray | None) -> np.ndarray:
    """The rows of `values` at `places`; all of them without."""
    return values if places is None else values.take(places, axis=0)


def _floats(values: np.ndarray, places: np.ndarray | None) -> np.ndarray:
    """`_at` in single precision."""
    rows = _at(values, places)
    if places is None or rows.dtype != np.float16:  # all rows are the stored ones, which torch may not take: read-only
        return rows.astype(np.float32, copy=False)
    return torch.from_numpy(rows).to(torch.float32).numpy()  # numpy takes three times as long

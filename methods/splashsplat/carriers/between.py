"""The liquid between two frames, shown by the carriers of both. The paper shows those of the one before, see "forward".

Each frame's carriers are moved to the time, forwards or backwards, and count by the nearness of their frame: at a
frame's own time the other's are gone, and they come and go without a kink there: slow motion does not pulse with the
frames. Three rules say which are moved and how opaque they are.

- Where the liquid keeps its place, as a pool does, carriers stay. What they show keeps its place too. So do those of a
  steady jet whose fall is not known; where it is, they flow.
- What is liquid before and after is liquid in between. Where carriers have moved on and none has come, they stay.
- A carrier is as opaque as its way is near to the liquid: phi is followed along the way, since a drop that moves by
  more than its size is far from both frames' surfaces half way. What gets to where no liquid is fades as it goes.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from scipy.ndimage import uniform_filter
from torch import Tensor

from splashbench.observe.grid import Grid
from splashbench.observe.kernels import sample
from splashbench.scene.geometry import STEPS_PER_VOXEL

from .resampling import cell_of
from .subframe import CarrierState, Track, locate

#: Which frames' carriers show what is between two of them: "both", or the one before, moved "forward".
BetweenFrames = Literal["both", "forward"]

# Side of the box, in transport voxels, in which two frames' liquid is compared, and the overlap from which it stands.
_NEIGHBOURHOOD, _STEADY = 15, 0.7
# Side of the cells, in transport voxels, that hold no carrier where there is a gap.
_GAP = 2.0
# From how far outside the other frame's liquid a carrier fades on its way there, and where it is gone: voxels.
_ASTRAY, _LOST = 1.0, 3.0


def carriers_at(
    track: Track, times: np.ndarray, time: float, shown: BetweenFrames = "both"
) -> list[tuple[Tensor, CarrierState]]:
    """The carriers that show the liquid at `time` (seconds), the frames being at `times` [T]: numbers and states.

    At a frame's time and outside the sequence these are the frame's own. Between frames some stand in the list twice;
    or, with `shown` "forward", those of the frame before are advected by u_t, and phi is interpolated between the two
    observations (supplement, "Sub-frame decoding").
    """
    t, fraction = locate(times, time)
    if fraction == 0:
        return [(track.ids(t), track.state(t))]
    first, share = (t, fraction) if fraction > 0 else (t - 1, 1 + fraction)
    if shown == "forward":
        return [(track.ids(first), track.state(first, share))]
    overlap = steadiness(track.phi[first], track.phi[first + 1])
    return _of_frame(track, first, share, overlap) + _of_frame(track, first + 1, share - 1, overlap)


def steadiness(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """How much of the liquid near each node keeps its place between two frames: float32, intersection over union.

    before, after: packed phi of the frames, see `pack_signed_distance`.
    """
    one, other = (np.clip(0.5 - phi / np.float32(STEPS_PER_VOXEL), 0, 1, dtype=np.float32) for phi in (before, after))
    both, either = (uniform_filter(f(one, other), _NEIGHBOURHOOD, mode="constant") for f in (np.minimum, np.maximum))
    return np.asarray(both / np.maximum(either, 1e-6), dtype=np.float32)


def _of_frame(track: Track, t: int, fraction: float, overlap: np.ndarray) -> list[tuple[Tensor, CarrierState]]:
    """The carriers of frame `t`, moved or not; and those that have left a gap once more, at their frame's place.

    fraction: in (-1, 1), how many steps after the frame the time is. overlap: `steadiness` of this frame and the other.
    """
    ids = track.ids(t)
    if len(ids) == 0:
        return []
    far, other = abs(fraction), t + 1 if fraction > 0 else t - 1
    here, there = track.carriers.positions[track.carriers.rows(t)], track.moved(t, float(np.sign(fraction)))[0]
    stays = (sample(overlap, here) > _STEADY) & (sample(overlap, there) > _STEADY)
    stays[track.motion.step(min(t, other)).falling(here, float(np.sign(fraction)))] = False
    still, moved = track.state(t), track.state(t, fraction)
    # phi along the way, or at the place, whichever is nearer to the surface.
    arrival = (sample(track.phi[other], there) / STEPS_PER_VOXEL).astype(np.float32)
    along = (1 - far) * still.phi + far * torch.from_numpy(arrival)
    phi = torch.where(along.abs() < moved.phi.abs(), along, moved.phi)
    nearness = 1 - float(_eased(np.array(far)))
    fade = 1 - (1 - nearness) * torch.from_numpy(_eased((arrival - _ASTRAY) / (_LOST - _ASTRAY)))
    keep = torch.from_numpy(stays)
    state = CarrierState(
        torch.where(keep[:, None], still.positions, moved.positions),
        torch.where(keep[:, None, None], still.deformation, moved.deformation),
        torch.where(keep, still.phi, phi),
        nearness * torch.where(keep, torch.ones_like(fade), fade),
    )
    now = track.grid.to_voxels(state.positions.numpy())
    gaps = torch.from_numpy(_has_left(here, now, track.grid) & ~stays & (sample(track.phi[other], here) <= 0))
    left = torch.from_numpy(_eased(np.linalg.norm(now - here, axis=1) / _GAP))
    filling = CarrierState(
        still.positions[gaps],
        still.deformation[gaps],
        still.phi[gaps],
        nearness * left[gaps],
    )
    return [(ids, state), (ids[gaps], filling)]


def _eased(share: np.ndarray) -> np.ndarray:
    """From 0 to 1 as `share` does, float32, level at both ends."""
    share = np.clip(share, 0, 1).astype(np.float32)
    return np.asarray(share * share * (3 - 2 * share))


def _has_left(before: np.ndarray, now: np.ndarray, grid: Grid) -> np.ndarray:
    """Which carriers were, at `before` [n, 3], in a cell where none of them is `now` [n, 3]: bool [n]."""
    taken = np.zeros(np.prod(grid.shape), dtype=bool)
    taken[cell_of(now / _GAP, grid)] = True
    return ~taken[cell_of(before / _GAP, grid)]

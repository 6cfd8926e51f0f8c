"""An appearance to begin with that was learned on coarser grids: each carrier looks like the one nearest to it there.

A coarse fit shows most of a liquid within a fraction of the time that a fine trace alone takes. What it learned is not
of its grids: the heads are those of all carriers, and a feature says how the liquid looks at a place and time. Where
photographs show fine carriers in other colours than the coarse one (first_look.py), that is added. Not in the paper.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from ..carriers.subframe import Track
from .decoder import initial_log_scale
from .first_look import GIVEN, Look, features_of
from .fitting import Appearance
from .shared_features import births


@dataclass(frozen=True)
class Learned:
    """What a fit learned of the carriers of `track`, all of them, also those that it left out as transparent. look: how
    photographs show these; None where it did not begin with that."""

    track: Track
    appearance: Appearance
    look: Look | None


@torch.no_grad()
def hand_on(learned: Learned, track: Track, look: Look | None, appearance: Appearance, base_scale: float) -> None:
    """Have `appearance`, of the carriers of `track`, begin with what was `learned`; in place.

    look: how photographs show these carriers. base_scale: extent of a Gaussian at the start, in transport voxels, in
    both.
    """
    nearest = torch.from_numpy(nearest_carriers(learned.track, track))
    known = nearest >= 0
    rows = nearest[known]
    before = learned.appearance
    appearance.features[known] = before.features.index_select(0, rows)
    if look is not None and learned.look is not None:
        appearance.features[known, :GIVEN] += features_of(look)[known] - features_of(learned.look).index_select(0, rows)
    grown = before.log_scales.index_select(0, rows) - initial_log_scale(base_scale, learned.track.grid.voxel)
    appearance.log_scales[known] = initial_log_scale(base_scale, track.grid.voxel) + grown
    appearance.decoder.load_state_dict(before.decoder.state_dict())
    # The finer the grid, the more carriers lie one behind the other.
    appearance.decoder.opacity.bias -= math.log(learned.track.grid.voxel / track.grid.voxel)
    appearance.glass = copy.deepcopy(before.glass)


def nearest_carriers(coarse: Track, fine: Track) -> np.ndarray:
    """For each carrier of `fine` the one of `coarse` that is nearest to it in the frame of its birth, int64 [count];
    where no frame has any, -1. In frames in which `coarse` has none, those of the frame next to it count."""
    found = np.full(fine.carriers.count, -1, dtype=np.int64)
    filled = np.flatnonzero(np.diff(coarse.carriers.starts))
    if len(filled) == 0:
        return found
    born = births(fine.carriers)
    places, frames = fine.grid.to_scene(born[:, :3]), born[:, 3].astype(np.int64)
    for t in np.unique(frames):
        rows = coarse.carriers.rows(int(filled[np.argmin(np.abs(filled - t))]))
        tree = cKDTree(coarse.grid.to_scene(coarse.carriers.positions[rows].astype(np.float64)))
        new = np.flatnonzero(frames == t)
        found[new] = coarse.carriers.ids[rows][tree.query(places[new])[1]]
    return found

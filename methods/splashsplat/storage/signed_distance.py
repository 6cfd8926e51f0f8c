"""phi_t as it is stored: in quarters of a transport voxel, as far as rendering asks, each frame less the one before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splashbench.scene.geometry import MAX_STEPS, STEPS_PER_VOXEL

from ..fields.sparse_frames import Frames

# Steps of the packed phi that one stored step makes up.
_COARSER = STEPS_PER_VOXEL // 4
# Stored steps to either side: as far as carriers fade on their way to where no liquid is (carriers/between.py); and as
# far as packed phi reaches.
_NEAR, _FAR = 13, MAX_STEPS // _COARSER
# A carrier's opacity fades with its depth; from this much of it on, how deep it is makes no difference.
_FADED = 0.999


def reach(opacity_slope: float, opacity_band: float) -> int:
    """Stored steps to either side that rendering can tell apart, with the decoder's fade (Eq. sdf_opacity)."""
    deepest = MAX_STEPS / STEPS_PER_VOXEL
    return _NEAR if 1 / (1 + np.exp(-opacity_slope * (opacity_band - deepest))) > _FADED else _FAR


def coarse_distance(packed: NDArray[np.int8], steps: int) -> NDArray[np.int8]:
    """Packed phi of a frame to the middles of stored steps, at most `steps` of them to either side: packed phi again.

    What is below 0 stays below it, and the other way round.
    """
    whole = np.clip(packed // np.int8(_COARSER), -steps, steps - 1)
    return np.asarray(whole * _COARSER + _COARSER // 2, dtype=np.int8)


def store_distance(packed: Frames) -> NDArray[np.int8]:
    """What `coarse_distance` gave for all frames [T, nx, ny, nz], as it is stored."""
    stored = np.empty(packed.shape, np.int8)
    before = np.zeros(packed.shape[1:], np.int8)
    for t in range(len(packed)):
        whole = packed[t] // np.int8(_COARSER)
        stored[t] = whole - before
        before = whole
    return stored


def read_distance(stored: NDArray[np.int8]) -> NDArray[np.int8]:
    """The packed phi of all frames. Raises ValueError where the numbers are beyond its range."""
    packed = np.empty_like(stored)
    whole = np.zeros(stored.shape[1:], dtype=np.int8)
    for t, change in enumerate(stored):
        wide = whole.astype(np.int16) + change
        if wide.size and (wide.min() < -_FAR - 1 or wide.max() > _FAR):
            raise ValueError("phi is beyond 7.9 voxels")
        whole = wide.astype(np.int8)
        packed[t] = np.minimum(wide * _COARSER + _COARSER // 2, MAX_STEPS).astype(np.int8)
    return packed

"""phi_t as it is stored: in quarters of a transport voxel, as far as rendering asks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splashbench.scene.geometry import MAX_STEPS, STEPS_PER_VOXEL

# Steps of the packed phi that one stored step makes up.
COARSER = STEPS_PER_VOXEL // 4
# Stored steps to either side: as far as carriers fade on their way to where no liquid is (carriers/between.py); and as
# far as packed phi reaches.
_NEAR, FAR = 13, MAX_STEPS // COARSER
# A carrier's opacity fades with its depth; from this much of it on, how deep it is makes no difference.
_FADED = 0.999


def reach(opacity_slope: float, opacity_band: float) -> int:
    """Stored steps to either side that rendering can tell apart, with the decoder's fade (Eq. sdf_opacity)."""
    deepest = MAX_STEPS / STEPS_PER_VOXEL
    return _NEAR if 1 / (1 + np.exp(-opacity_slope * (opacity_band - deepest))) > _FADED else FAR


def coarse_distance(packed: NDArray[np.int8], steps: int) -> NDArray[np.int8]:
    """Packed phi of a frame to the middles of stored steps, at most `steps` of them to either side: packed phi again.

    What is below 0 stays below it, and the other way round.
    """
    whole = np.clip(whole_frame(packed), -steps, steps - 1)
    return packed_frame(whole)


def whole_frame(packed: NDArray[np.int8]) -> NDArray[np.int8]:
    """Stored steps of the packed phi of a frame."""
    return np.asarray(packed // np.int8(COARSER), dtype=np.int8)


def packed_frame(whole: NDArray[np.int8]) -> NDArray[np.int8]:
    """The middles of stored steps, at most `FAR` of them to either side, as packed phi."""
    wide = whole.astype(np.int16) * COARSER + COARSER // 2
    return np.asarray(np.minimum(wide, MAX_STEPS), dtype=np.int8)


def distance_of_changes(stored: NDArray[np.int8]) -> NDArray[np.int8]:
    """The packed phi of all frames, of which files of format 6 and before have each less the one before. Raises
    ValueError where the numbers are beyond its range."""
    packed = np.empty_like(stored)
    whole = np.zeros(stored.shape[1:], dtype=np.int8)
    for t, change in enumerate(stored):
        wide = whole.astype(np.int16) + change
        if wide.size and (wide.min() < -FAR - 1 or wide.max() > FAR):
            raise ValueError("phi is beyond 7.9 voxels")
        whole = wide.astype(np.int8)
        packed[t] = packed_frame(whole)
    return packed

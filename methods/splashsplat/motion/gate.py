"""No motion where the fitted one leads farther away from the observations than none.

Where phantom volume of the hull comes and goes, its surface moves and no liquid does. Not in the paper.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from splashbench.observe.kernels import sample

from .advection import moved
from .velocity import Factor, cell_numbers

# A fit that takes the liquid's nodes so much farther outside, on average, is not believed (voxels). Of a slow surface
# the fit shows no gain, and yet is right: most nodes near it are inside before and after.
_LOSS = 0.01
_SHELL = 3.0


def gated(control: np.ndarray, factor: Factor, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """`control` with zero where it takes the liquid of `before` farther outside `after` than no motion does.

    control: float32 [cx, cy, cz, 3] voxels per frame. before, after: phi_t and phi_{t+1}, float32 [nx, ny, nz] voxels.
    """
    if not np.any(control):
        return control
    coarse = control.shape[0], control.shape[1], control.shape[2]
    size = int(np.prod(coarse))
    gains, counts = np.zeros(size), np.zeros(size)
    # Forwards from what is liquid now, which shows where it leaves, and backwards from what will be, where it arrives.
    for start, end, direction in ((before, after, 1), (after, before, -1)):
        nodes = np.argwhere((start <= 0) & (start >= -_SHELL)).astype(np.float32)
        ends = moved(direction * control, factor, nodes)
        gain = np.maximum(sample(end, nodes), 0) - np.maximum(sample(end, ends), 0)
        cell = cell_numbers(nodes, factor, coarse)
        gains += np.bincount(cell, gain, minlength=size)
        counts += np.bincount(cell, minlength=size)
    gains, counts = (gaussian_filter(values.reshape(coarse), 1.0) for values in (gains, counts))
    believed = gains > -_LOSS * counts  # not where no liquid is counted: 0 is no gain
    return np.where(believed[..., None], control, np.float32(0))

"""Which motion goes where: the jet's where liquid falls, the level set's where it beats standing still, none elsewhere.

The level-set fit (velocity.py) sees the hull's surface only. In a steady jet nothing of that surface moves; where
phantom volume comes and goes, it moves and no liquid does. The paper uses the fit everywhere.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter
from splashbench_methods.splashsplat.ballistic import Jet
from splashbench_methods.splashsplat.transport import forecast

from splashbench.observe.grid import Grid
from splashbench.observe.kernels import sample

# A fit must bring the liquid's nodes so much nearer to the next observation, on average, to be trusted (voxels).
_GAIN = 0.02
_SHELL = 3.0


def control_nodes(shape: tuple[int, int, int], factor: int) -> np.ndarray:
    """Transport-grid coordinates of the nodes of a control grid of `shape`, float64 [cx, cy, cz, 3]."""
    axes = [np.arange(n) * factor + 0.5 * (factor - 1) for n in shape]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def gated(control: np.ndarray, factor: int, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """`control` with zero where it does not bring the liquid of `before` nearer to `after` than no motion does.

    control: float32 [cx, cy, cz, 3] voxels per frame. before, after: phi_t and phi_{t+1}, float32 [nx, ny, nz] voxels.
    """
    if not np.any(control):
        return control
    coarse = control.shape[:3]
    size = int(np.prod(coarse))
    gains, counts = np.zeros(size), np.zeros(size)
    # Forwards from what is liquid now, which shows where it leaves, and backwards from what will be, where it arrives.
    for here, there, direction in ((before, after, 1), (after, before, -1)):
        nodes = np.argwhere((here <= 0) & (here >= -_SHELL)).astype(np.float32)
        identity = np.broadcast_to(np.eye(3, dtype=np.float32), (len(nodes), 3, 3))
        moved, _ = forecast(direction * control, factor, nodes, identity)
        gain = np.maximum(sample(there, nodes), 0) - np.maximum(sample(there, moved), 0)
        cell = np.ravel_multi_index(tuple(np.minimum(nodes.astype(int) // factor, np.array(coarse) - 1).T), coarse)
        gains += np.bincount(cell, gain, minlength=size)
        counts += np.bincount(cell, minlength=size)
    gains, counts = (gaussian_filter(values.reshape(coarse), 1.0) for values in (gains, counts))
    trusted = gains > _GAIN * counts
    return np.where(trusted[..., None], control, np.float32(0))


def with_jet(
    control: np.ndarray, factor: int, grid: Grid, turn: np.ndarray, jet: Jet, floor: float, duration: float
) -> np.ndarray:
    """`control` with the jet's velocity at the nodes about it, above height `floor` (scene units).

    turn: [3, 3] scene axes to upright ones. duration: of the frame, seconds.
    """
    shape = control.shape[:3]
    points = grid.to_scene(control_nodes((shape[0], shape[1], shape[2]), factor)).reshape(-1, 3) @ turn.T
    # All eight nodes about any point of the jet, so that no other motion is mixed in.
    reach = 1.8 * factor * grid.voxel
    near = (jet.distance(points) < reach) & (points[:, 2] > floor + 0.5 * factor * grid.voxel)
    moving = control.reshape(-1, 3).copy()
    moving[near] = jet.velocity(points[near, 2]) @ turn * (duration / grid.voxel)
    return moving.reshape(control.shape)

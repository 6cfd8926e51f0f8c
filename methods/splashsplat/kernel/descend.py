"""A step of the descent that fits a velocity to two signed distances (paper, Eq. velocity_fit), compiled."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np

from splashbench.native.threads import kernel_threads

from .library import KERNEL, DescentStruct


class Descent:
    """What a velocity is fitted to, checked once; `step` as often as there are steps.

    before: float32 [nx, ny, nz, 4], phi_t and its gradient side by side, voxels. after: float32 [nx, ny, nz], phi_{t+1}
    likewise. nodes: int32 [M, 3] of these grids, sorted by control cell; starts: int64 [C + 1], those of cell c are
    starts[c] to starts[c + 1]. shape: of the control grid, C cells; factor: voxels per control cell along each axis.

    Raises TypeError or ValueError naming the argument.
    """

    def __init__(
        self,
        before: np.ndarray,
        after: np.ndarray,
        nodes: np.ndarray,
        starts: np.ndarray,
        shape: tuple[int, int, int],
        factor: Sequence[float],
    ) -> None:
        cells = int(np.prod(shape))
        wanted = {
            "before": (before, np.float32, (*after.shape, 4)),
            "after": (after, np.float32, (*after.shape[:3],)),
            "nodes": (nodes, np.int32, (len(nodes), 3)),
            "starts": (starts, np.int64, (cells + 1,)),
        }
        for name, (array, kind, expected) in wanted.items():
            if array.dtype != kind or not array.flags.c_contiguous:
                raise TypeError(f"{name} is not contiguous {np.dtype(kind)}")
            if array.shape != expected:
                raise ValueError(f"{name} is {list(array.shape)}, not {list(expected)}")
        if after.ndim != 3 or min(*after.shape, *shape) < 2:
            raise ValueError(f"grids of {list(after.shape)} and {list(shape)} nodes have no cell along an axis")
        if len(nodes) and (nodes.min() < 0 or (nodes.max(axis=0) >= after.shape).any()):
            raise ValueError("nodes are outside the grid")
        if starts[0] != 0 or starts[-1] != len(nodes) or (np.diff(starts) < 0).any():
            raise ValueError("starts do not rise from 0 to the number of nodes")
        if not min(factor) > 0:
            raise ValueError(f"factor {tuple(factor)} is not positive")
        self._kept = before, after, nodes, starts  # the kernel reads these
        self.shape, self._count, self._factor = shape, len(nodes), tuple(factor)

    def step(self, control: np.ndarray, size: float) -> tuple[np.ndarray, float]:
        """Displacements summed over each control cell, float32 [*shape, 3] in voxels, and the mean absolute residual.

        control: float32 [*shape, 3], the velocity so far, voxels per frame. size: share of each node's Gauss-Newton
        displacement that is taken.
        """
        if control.shape != (*self.shape, 3):
            raise ValueError(f"control is {list(control.shape)}, not {[*self.shape, 3]}")
        padded = np.zeros((*self.shape, 4), np.float32)
        padded[..., :3] = control
        before, after, nodes, starts = self._kept
        cells = len(starts) - 1
        update, residual = np.empty((*self.shape, 3), np.float32), np.empty(cells, np.float32)
        descent = DescentStruct(
            (ctypes.c_int32 * 3)(*after.shape),
            (ctypes.c_int32 * 3)(*self.shape),
            (ctypes.c_float * 3)(*self._factor),
            size,
            before.ctypes.data,
            after.ctypes.data,
            padded.ctypes.data,
            cells,
            starts.ctypes.data,
            nodes.ctypes.data,
        )
        KERNEL.library.splash_descend(ctypes.byref(descent), update.ctypes.data, residual.ctypes.data, kernel_threads())
        return update, float(residual.sum(dtype=np.float64) / max(self._count, 1))

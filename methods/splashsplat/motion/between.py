"""The signed distance between two frames: that of each, carried to the instant by the step's motion, and blended.

Blending alone would lose a drop that moves by more than its own size: half way it is in neither frame's place.
"""

from __future__ import annotations

import numpy as np

from splashbench.observe.kernels import sample
from splashbench.scene.geometry import MAX_STEPS

from .steps import FrameStep

# Nodes that are handled at once: positions and velocities of a whole grid would take some hundred megabytes.
_AT_ONCE = 1 << 18


def moved_distance(before: np.ndarray, after: np.ndarray, step: FrameStep, share: float) -> np.ndarray:
    """Packed phi `share` of a step after the frame of `before`: int8 [nx, ny, nz].

    before, after: packed phi of the two frames, see `pack_signed_distance`. Where motion is wrong, what one frame has
    and the other has not shrinks as its frame gets farther, as it would if the two were blended.
    """
    result = before.copy()  # which stays where both are far from any surface and say the same
    near = (np.abs(before) < MAX_STEPS) | (np.abs(after) < MAX_STEPS) | ((before < 0) != (after < 0))
    nodes = np.argwhere(near)
    for start in range(0, len(nodes), _AT_ONCE):
        part = nodes[start : start + _AT_ONCE]
        velocity = step.velocity(part.astype(np.float64))
        one = sample(before, (part - share * velocity).astype(np.float32))
        other = sample(after, (part + (1 - share) * velocity).astype(np.float32))
        blended = (1 - share) * one + share * other
        steps = np.rint(np.clip(blended, -MAX_STEPS, MAX_STEPS)).astype(np.int8)
        steps[(steps == 0) & (blended < 0)] = -1
        result[tuple(part.T)] = steps
    return result

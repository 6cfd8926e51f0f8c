"""How precisely the places of carriers are kept: as precisely as photographs can tell. Not in the paper."""

from __future__ import annotations

import math
from dataclasses import dataclass

# Whole steps per voxel that a file may have.
_STEPS = (8, 16, 32)
# A step is at most this part of a pixel, where so many steps are enough for that.
_TOLERABLE = 1 / 9


@dataclass(frozen=True)
class Precision:
    """steps: whole ones per transport voxel, in which positions are stored; velocities are stored in half of one."""

    steps: int = _STEPS[-1]

    @classmethod
    def of(cls, pixels: float | None) -> Precision:
        """That of a voxel which spans so many pixels; the highest one where that is not known."""
        if pixels is None or not 0 < pixels < math.inf:
            return cls()
        return cls(next((steps for steps in _STEPS if pixels / steps <= _TOLERABLE), _STEPS[-1]))

    @classmethod
    def stored(cls, steps: object) -> Precision:
        """That of a file with so many steps. Raises ValueError where no file has them."""
        if isinstance(steps, int) and steps in _STEPS:
            return cls(steps)
        raise ValueError(f"{steps!r} steps of a voxel are none of {', '.join(map(str, _STEPS))}")

    def __str__(self) -> str:
        return f"places in 1/{self.steps} voxel"

    @property
    def velocity_steps(self) -> int:
        """Of a voxel a frame."""
        return 2 * self.steps


#: The highest that there is, where nothing is known of the pixels.
HIGHEST = Precision()

"""How precisely the places of carriers are kept: as precisely as photographs can tell. Not in the paper."""

from __future__ import annotations

import math
from dataclasses import dataclass

# Whole steps per voxel, at the least and at the most.
_FEWEST, _MOST = 8, 32
# A step is so short that one and a half of them are at most this many pixels: how far a carrier may be off where a miss
# of one is not stored.
_TOLERABLE = 1 / 7


@dataclass(frozen=True)
class Precision:
    """steps: whole ones per transport voxel, in which positions are stored, a power of two; velocities in half of one.
    spared: by how many steps the motion may miss a carrier without this being stored."""

    steps: int = _MOST
    spared: int = 0

    @classmethod
    def of(cls, pixels: float | None) -> Precision:
        """That of a voxel which spans so many pixels; the highest one where that is not known."""
        if pixels is None or not 0 < pixels < math.inf:
            return cls()
        wanted = 1.5 * pixels / _TOLERABLE
        steps = min(max(2 ** math.ceil(math.log2(wanted)), _FEWEST), _MOST)
        return cls(steps, 1 if wanted <= steps else 0)

    @classmethod
    def stored(cls, steps: object) -> Precision:
        """That of a file with so many steps. Raises ValueError where no file has them."""
        if steps not in (8, 16, 32):
            raise ValueError(f"{steps!r} steps of a voxel are not 8, 16 or 32")
        return cls(int(str(steps)))

    def __str__(self) -> str:
        spared = "; misses of one are not stored" if self.spared else ""
        return f"places in 1/{self.steps} voxel{spared}"

    @property
    def velocity_steps(self) -> int:
        """Of a voxel a frame."""
        return 2 * self.steps


#: The highest that there is, where nothing is known of the pixels.
HIGHEST = Precision()

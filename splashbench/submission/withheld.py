"""Timesteps withheld from a method, to see how it interpolates (the paper's "Rendering between captured frames").

The paper fits to the even frames and compares with the odd ones.
"""

from __future__ import annotations

from typing import Literal

Withheld = Literal["odd"]


def kept_timesteps(n_frames: int, withheld: Withheld | None) -> tuple[int, ...]:
    """The timesteps of `n_frames` that a method sees, in order."""
    return tuple(range(0, n_frames, 2 if withheld == "odd" else 1))


def scored_timesteps(n_frames: int, withheld: Withheld | None) -> tuple[int, ...]:
    """The timesteps that are scored: all, or those withheld that lie between two that the method saw."""
    return tuple(range(1, n_frames - 1, 2)) if withheld == "odd" else tuple(range(n_frames))

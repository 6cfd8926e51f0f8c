"""Timesteps withheld from a method, to see how it interpolates (the paper's "Rendering between captured frames").

Which ones is said by a word:

    odd                 every second one, as in the paper, which fits to the even frames and compares with the odd ones
    keep_1_of_K         all but each K-th
    drop_P_percent      so many of those between the first and the last, at random: the same ones in every run, and
                        those of a lower percentage are among those of a higher one
"""

from __future__ import annotations

import bisect
import re
from typing import Annotated

import numpy as np
from pydantic import Field

from splashbench.errors import SplashbenchError

#: A word above.
PATTERN = r"^(odd|keep_1_of_([2-9]|[1-9][0-9]{1,2})|drop_[1-9][0-9]?_percent)$"
Withheld = Annotated[str, Field(pattern=PATTERN)]

# Of the draw; a part of what the words mean.
_SEED = 20


def kept_timesteps(n_frames: int, withheld: Withheld | None) -> tuple[int, ...]:
    """The timesteps of `n_frames` that a method sees, in order. Raises SplashbenchError for a word that is none."""
    if withheld is None:
        return tuple(range(n_frames))
    if not re.fullmatch(PATTERN, withheld):
        raise SplashbenchError(
            f"{withheld!r} does not say which timesteps to withhold; give odd, keep_1_of_3 or drop_33_percent"
        )
    if withheld.startswith("drop"):
        between = np.random.default_rng(_SEED).permutation(np.arange(1, n_frames - 1)).tolist()
        dropped = set(between[: round(int(withheld.split("_")[1]) / 100 * n_frames)])
        return tuple(t for t in range(n_frames) if t not in dropped)
    return tuple(range(0, n_frames, 2 if withheld == "odd" else int(withheld.split("_")[-1])))


def scored_timesteps(n_frames: int, withheld: Withheld | None) -> tuple[int, ...]:
    """The timesteps that are scored: all, or those withheld that lie between two that the method saw."""
    if withheld is None:
        return tuple(range(n_frames))
    kept = kept_timesteps(n_frames, withheld)
    return tuple(t for t in range(kept[-1]) if t not in kept)


def seen_around(t: int, n_frames: int, withheld: Withheld | None) -> tuple[int | None, int | None]:
    """The last timestep before `t` that a method sees, and the first one after it; None where there is none."""
    kept = kept_timesteps(n_frames, withheld)
    before, after = bisect.bisect_left(kept, t), bisect.bisect_right(kept, t)
    return kept[before - 1] if before > 0 else None, kept[after] if after < len(kept) else None

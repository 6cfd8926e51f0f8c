"""Dyes: what a liquid's colour is made of, as an absorbing and scattering dielectric (Beer-Lambert).

Light that goes through `length` metres of the liquid keeps exp(-absorption * length) of each channel. What is lost on
the way comes back in part: a layer too thick to see through has the colour `albedo`, as a multiple of the light that
falls on it. The paper's supplement ("Style transfer") calls the first T_c and the second the multiple-scattering term.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.srgb import to_linear

_HEX = re.compile(r"#[0-9a-fA-F]{6}")
# Of a channel that a colour lacks altogether a dye would absorb infinitely much.
_DARKEST, _LIGHTEST = 0.004, 0.98
#: How far light has gone through a dye of density 1 when it has the dye's own colour: 25 mm of `amber` and its like.
REFERENCE_METRES = 0.025
# Of the light that a dye of any colour absorbs, what comes back; of the named ones it is in their albedo.
_RETURNED = 0.55


@dataclass(frozen=True, eq=False)
class Dye:
    """A liquid's optical properties, of red, green and blue each.

    Attributes:
        albedo: float32 [3] in [0, 1], linear: the colour of a layer that hides what is behind it.
        absorption: float32 [3], 1/m: what is absorbed along the way.
    """

    albedo: NDArray[np.float32]
    absorption: NDArray[np.float32]

    def times(self, density: float) -> Dye:
        """The dye at `density` times its concentration: its thick layers keep their colour."""
        return Dye(self.albedo, (self.absorption * np.float32(density)).astype(np.float32))


def _dye(albedo: tuple[float, float, float], absorption: tuple[float, float, float]) -> Dye:
    return Dye(np.array(albedo, np.float32), np.array(absorption, np.float32))


#: The dyes that have a name. `clear` is water, which absorbs red a little (Pope and Fry 1997).
DYES: dict[str, Dye] = {
    "amber": _dye((0.34, 0.17, 0.04), (6.0, 22.0, 55.0)),
    "brown": _dye((0.17, 0.075, 0.03), (26.0, 55.0, 95.0)),
    "green": _dye((0.05, 0.30, 0.09), (60.0, 10.0, 42.0)),
    "blue": _dye((0.035, 0.13, 0.50), (70.0, 30.0, 9.0)),
    "clear": _dye((0.0, 0.0, 0.0), (0.34, 0.06, 0.01)),
}


def dye_named(name: str) -> Dye:
    """The dye called `name`, or the one whose colour is `#rrggbb` (sRGB) where light has gone `REFERENCE_METRES`.

    Raises SplashbenchError for anything else.
    """
    if name in DYES:
        return DYES[name]
    if not _HEX.fullmatch(name):
        raise SplashbenchError(
            f"there is no dye {name[:40]!r}; choose one of {', '.join(DYES)}, or give a color as '#rrggbb'"
        )
    linear = to_linear(np.array([int(name[i : i + 2], 16) for i in (1, 3, 5)]) / 255)
    kept = np.clip(linear, _DARKEST, _LIGHTEST)
    return Dye((_RETURNED * linear).astype(np.float32), (-np.log(kept) / REFERENCE_METRES).astype(np.float32))

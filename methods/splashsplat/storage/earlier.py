"""Models of earlier versions: half-precision tables in four archives, formats 3 and 4 (with glass); and format 5, which
has the coefficients of all carriers in one array."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splashbench.files import read_npz
from splashbench.observe.grid import Grid

from ..appearance.decoder import Decoder
from ..appearance.fitting import Appearance
from ..appearance.glass import Glass
from ..carriers.population import Carriers
from ..carriers.subframe import Track
from ..motion.fall import falls_of
from ..motion.steps import Motion
from ..motion.velocity import Factor
from .looks import GLASS_RANKS
from .values import LEVELS, StoredValues

#: Formats that are read here; the second one has glass.
EARLIER = (3, 4)
#: The format whose coefficients `sorted_by_coarseness` sorts.
UNSORTED = 5
#: Of its appearance, beside what the heads and glass have.
UNSORTED_VALUES: Mapping[str, int] = {"center": 1, "basis": 2, "coarseness": 1, "coefficients": 2}
# Its least coarseness: later formats count from 0.
_LEAST = -2


def sorted_by_coarseness(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The appearance of format `UNSORTED` as later ones have it. Raises ValueError where it does not fit together."""
    others = {name: array for name, array in arrays.items() if name not in UNSORTED_VALUES}
    coarseness = arrays["coarseness"].astype(np.int64) - _LEAST
    if len(coarseness) and not 0 <= coarseness.min() <= coarseness.max() < LEVELS:
        raise ValueError(f"coarseness is not between {_LEAST} and {_LEAST + LEVELS - 1}")
    if arrays["coefficients"].shape[1] != len(coarseness):
        raise ValueError(f"{arrays['coefficients'].shape[1]} coefficients do not fit {len(coarseness)} carriers")
    parts = tuple(arrays["coefficients"][:, coarseness == level] for level in range(LEVELS))
    basis = arrays["basis"] * np.float32(2.0**_LEAST)
    return others | StoredValues(arrays["center"], basis, coarseness.astype(np.uint8), parts).arrays


def read_earlier(
    directory: Path, header: Mapping[str, Any], grid: Grid, times: np.ndarray, factor: Factor, decoder: Decoder
) -> tuple[Track, Appearance]:
    """Track and appearance of a model in one of the formats `EARLIER`; `decoder` gets its weights.

    Raises SplashbenchError for a file that cannot be read, ValueError or RuntimeError where they do not fit together.
    """
    rows = read_npz(directory / "carriers.npz", {"starts": 1, "ids": 1, "positions": 2, "deformation": 3, "phi": 1})
    carriers = Carriers(
        starts=rows["starts"],
        ids=rows["ids"],
        positions=rows["positions"].astype(np.float32) / np.float32(65535 / max(grid.shape)),
        deformation=rows["deformation"].astype(np.float32),
        phi=rows["phi"].astype(np.float32),
        count=int(header["carriers"]),
    )
    moves = read_npz(directory / "velocity.npz", {"velocities": 5, "jets": 2, "turn": 2})
    motion = Motion(moves["velocities"], factor, falls_of(moves["jets"], moves["turn"], grid, times))
    phi = read_npz(directory / "phi.npz", {"phi": 4})["phi"]
    # Models of version 0.1 spell the heads "colour".
    british = "colour_width" in header["decoder"]
    heads = {name: f"heads.{name.replace('color', 'colour') if british else name}" for name in decoder.state_dict()}
    shapes = {heads[name]: value.ndim for name, value in decoder.state_dict().items()}
    with_glass = header["format"] == EARLIER[1]
    panes = {f"glass.{name}": rank for name, rank in GLASS_RANKS.items()} if with_glass else {}
    tables = read_npz(directory / "appearance.npz", {"features": 2, "log_scales": 2, **shapes, **panes})
    glass = Glass.of_tables({name: tables[f"glass.{name}"] for name in GLASS_RANKS}) if with_glass else None
    decoder.load_state_dict({name: torch.from_numpy(tables[stored]) for name, stored in heads.items()})
    features, scales = (torch.from_numpy(tables[name].astype(np.float32)) for name in ("features", "log_scales"))
    return Track(grid, carriers, motion, phi), Appearance(features, scales, decoder, glass)

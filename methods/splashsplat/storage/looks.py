"""The appearance as it is stored: what was learned of carriers by values.py, heads and glass beside it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from splashbench.observe.grid import Grid

from ..appearance.decoder import Decoder
from ..appearance.fitting import Appearance
from ..appearance.glass import Glass
from ..appearance.sensitivity import Sensitivity
from .values import COEFFICIENTS, LEVELS, StoredValues, read_values, store_values

#: Tables of glass, each with its number of dimensions.
GLASS_RANKS: Mapping[str, int] = {
    "positions": 2,
    "log_scales": 2,
    "quaternions": 2,
    "opacities": 1,
    "colors": 2,
    "slopes": 3,
}
_COEFFICIENTS = {f"{COEFFICIENTS}{level}": 2 for level in range(LEVELS)}
#: Arrays of the values of carriers, each with its number of dimensions.
VALUES: Mapping[str, int] = {"center": 1, "basis": 2, "coarseness": 1, **_COEFFICIENTS}
_HEADS, _GLASS = "heads.", "glass."
# Log-scales are the last ones of a carrier's values.
_SCALES = 3
# Of glass, positions are in such parts of a transport voxel.
_GLASS_STEPS = 32


def appearance_ranks(decoder: Decoder, with_glass: bool, values: Mapping[str, int] = VALUES) -> dict[str, int]:
    """Dimensions of all arrays of the file. values: of those of carriers."""
    heads = {f"{_HEADS}{name}": value.ndim for name, value in decoder.state_dict().items()}
    glass = {f"{_GLASS}{name}": rank for name, rank in GLASS_RANKS.items()} if with_glass else {}
    return {**values, **heads, **glass}


def learned_values(appearance: Appearance) -> np.ndarray:
    """Features and log-scales of every carrier side by side, float32 [N, D]."""
    return np.asarray(torch.cat([appearance.features, appearance.log_scales], dim=1).numpy())


def appearance_arrays(
    appearance: Appearance, sensitivity: Sensitivity, step: float, grid: Grid
) -> dict[str, np.ndarray]:
    """What is stored of an appearance; sensitivity, step: see `store_values`.

    Glass stands in half precision, its positions in steps of the transport grid.
    """
    stored = store_values(learned_values(appearance), sensitivity, step)
    heads = {f"{_HEADS}{name}": value.numpy() for name, value in appearance.decoder.state_dict().items()}
    glass: dict[str, np.ndarray] = {}
    if appearance.glass is not None:
        glass = {f"{_GLASS}{name}": table.half().numpy() for name, table in appearance.glass.tables.items()}
        places = (appearance.glass.positions.numpy() - grid.origin) / grid.voxel
        glass[f"{_GLASS}positions"] = np.rint(places * _GLASS_STEPS).astype(np.int32)
    return {**stored.arrays, **heads, **glass}


def read_appearance(arrays: Mapping[str, np.ndarray], decoder: Decoder, grid: Grid) -> Appearance:
    """The appearance of what `appearance_arrays` gave; `decoder` gets its weights.

    Raises ValueError or RuntimeError where it does not fit together.
    """
    stored = StoredValues.of(arrays)
    size = len(stored.center)
    if size != decoder.settings.feature_size + _SCALES:
        raise ValueError(f"{size} values of a carrier are not {decoder.settings.feature_size} + {_SCALES}")
    values = read_values(stored)
    decoder.load_state_dict({name: torch.from_numpy(arrays[f"{_HEADS}{name}"]) for name in decoder.state_dict()})
    glass = None
    if f"{_GLASS}positions" in arrays:
        tables = {name: arrays[f"{_GLASS}{name}"] for name in GLASS_RANKS}
        glass = Glass.of_tables(tables | {"positions": grid.to_scene(tables["positions"] / _GLASS_STEPS)})
    features, scales = (torch.from_numpy(part.copy()) for part in np.split(values, [-_SCALES], axis=1))
    return Appearance(features, scales, decoder, glass)

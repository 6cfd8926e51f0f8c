"""The four archives of a fitted liquid on disk, of this format and of the two before it. FORMAT.md describes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.files import compressed_bytes, read_npz, write_npz

from ..appearance.decoder import Decoder
from ..fields.sparse_frames import Frames
from .earlier import UNSORTED, UNSORTED_VALUES, sorted_by_coarseness
from .looks import VALUES, appearance_ranks
from .packing import (
    CODED,
    NODES,
    pack,
    pack_distance,
    unpack_appearance,
    unpack_carriers,
    unpack_distance,
    unpack_motion,
)
from .signed_distance import distance_of_changes
from .track import CARRIERS, DEFORMATION, DISTANCE, MOTION

T = TypeVar("T")

#: This format; the one before it, whose numbers stand as they are; and before that `UNSORTED`.
FORMAT, UNCODED = 7, 6
AGAIN = "fit the scene again"
_FILES = ("carriers", "motion", "distance", "appearance")


@dataclass(frozen=True)
class Archives:
    """arrays: of carriers, motion and appearance, by file and name. phi: packed, of all frames."""

    arrays: Mapping[str, Mapping[str, np.ndarray]]
    phi: Frames

    def _written(self, name: str) -> Mapping[str, np.ndarray]:
        return pack_distance(self.phi) if name == "distance" else pack(self.arrays[name])

    @property
    def stored_bytes(self) -> int:
        """How much `write` writes, to within some kilobytes."""
        return sum(compressed_bytes(self._written(name)) for name in _FILES)

    def write(self, directory: Path) -> None:
        """Write the four files."""
        for name in _FILES:
            write_npz(directory / f"{name}.npz", self._written(name))


@dataclass(frozen=True)
class Stated:
    """What liquid.json says of the archives: format (5 to 7), the shape [T, nx, ny, nz] of phi, whether the motion is
    what moved the carriers, and whether there is glass; and a decoder of the right sizes."""

    format: int
    shape: tuple[int, int, int, int]
    carried: bool
    glass: bool
    decoder: Decoder


def read_archives(directory: Path, stated: Stated) -> Archives:
    """What `Archives.write` wrote, or an earlier version. Raises SplashbenchError naming the file at fault."""
    values = UNSORTED_VALUES if stated.format == UNSORTED else VALUES
    ranks: dict[str, dict[str, int]] = {
        "carriers": {**CARRIERS, **({} if stated.carried else DEFORMATION)},
        "motion": dict(MOTION),
        "distance": dict(DISTANCE),
        "appearance": appearance_ranks(stated.decoder, stated.glass, values),
    }
    coded = stated.format == FORMAT
    if coded:
        ranks = {
            name: {each: 1 if each in CODED else rank for each, rank in file.items()} for name, file in ranks.items()
        }
        ranks["motion"][NODES] = 1
        ranks["distance"]["ends"] = 1
    paths = {name: directory / f"{name}.npz" for name in _FILES}
    arrays = {name: read_npz(paths[name], ranks[name]) for name in _FILES}
    if not coded:
        if stated.format == UNSORTED:
            look = arrays["appearance"]
            arrays["appearance"] = fitting(paths["appearance"], lambda: sorted_by_coarseness(look))
        phi = arrays.pop("distance")["phi"]
        return Archives(arrays, fitting(paths["distance"], lambda: _uncoded(phi, stated.shape)))
    carriers = fitting(paths["carriers"], lambda: unpack_carriers(arrays["carriers"]))
    count = len(carriers["lives"])
    return Archives(
        {
            "carriers": carriers,
            "motion": fitting(paths["motion"], lambda: unpack_motion(arrays["motion"], max(stated.shape[0] - 1, 0))),
            "appearance": fitting(paths["appearance"], lambda: unpack_appearance(arrays["appearance"], count)),
        },
        fitting(paths["distance"], lambda: unpack_distance(arrays["distance"], stated.shape)),
    )


def _uncoded(changes: np.ndarray, shape: tuple[int, int, int, int]) -> Frames:
    if changes.dtype != np.int8 or changes.shape != shape:
        raise ValueError(f"phi is {changes.dtype} {changes.shape}, not int8 of {shape}")
    return distance_of_changes(changes)


def fitting(path: Path, read: Callable[[], T]) -> T:
    """What `read` returns; SplashbenchError where the files at `path` do not fit together, or liquid.json."""
    try:
        return read()
    except (IndexError, KeyError, MemoryError, OverflowError, RuntimeError, TypeError, ValueError) as error:
        raise SplashbenchError(f"{path} does not fit liquid.json ({error}); {AGAIN}") from None

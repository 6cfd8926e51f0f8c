"""A liquid's signed distance over time: geometry that a method hands in beside its particles (geometry.npz)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import atomic_path, read_npz

#: Resolution of the stored distance; 8 bits then reach 7.9 voxels to either side.
STEPS_PER_VOXEL = 16
MAX_STEPS = 127
#: Of phi, unpacked: 50 frames of 276 nodes a side.
MAX_BYTES = 1 << 30
_LARGEST = 1e9


@dataclass
class SignedDistance:
    """Signed distance to the liquid's surface on T grids of nodes at `origin + voxel * (i, j, k)`, negative inside.

    Attributes:
        phi: [T, nx, ny, nz] int8, in 1/16 voxel, clipped to +-7.9 voxels; liquid is where it is below 0.
        origin: [3] float64, position of node (0, 0, 0), scene units.
        voxel: spacing of the nodes, scene units.

    Raises ValueError for other shapes and types, and for what is not finite.
    """

    phi: NDArray[np.int8]
    origin: NDArray[np.float64]
    voxel: float

    def __post_init__(self) -> None:
        self.origin, self.voxel = np.asarray(self.origin, dtype=np.float64), float(self.voxel)
        if self.phi.ndim != 4 or self.phi.dtype != np.int8 or min(self.phi.shape[1:]) < 2:
            raise ValueError(
                f"phi is {self.phi.dtype} {self.phi.shape}, not int8 [T, nx, ny, nz] with two nodes a side or more"
            )
        if self.phi.nbytes > MAX_BYTES:
            raise ValueError(f"phi has {self.phi.nbytes} bytes, more than {MAX_BYTES}")
        if self.origin.shape != (3,) or not (np.abs(self.origin) <= _LARGEST).all():
            raise ValueError(f"origin {self.origin.tolist()} must be three numbers of at most {_LARGEST:g}")
        if not 1 / _LARGEST <= self.voxel <= _LARGEST:
            raise ValueError(f"voxel is {self.voxel:g}, not between {1 / _LARGEST:g} and {_LARGEST:g}")

    @classmethod
    def of(cls, voxels: NDArray[np.floating], origin: NDArray[np.float64], voxel: float) -> SignedDistance:
        """From distances in voxels, floats [T, nx, ny, nz]. What is below 0 stays below it."""
        if not np.isfinite(voxels).all():
            raise ValueError("the distances have NaN or infinite entries")
        steps = np.rint(np.clip(voxels * STEPS_PER_VOXEL, -MAX_STEPS, MAX_STEPS)).astype(np.int8)
        steps[(steps == 0) & (voxels < 0)] = -1
        return cls(steps, origin, voxel)

    @property
    def n_frames(self) -> int:
        """T, the number of instants."""
        return self.phi.shape[0]

    def save(self, path: Path) -> None:
        """Write an .npz without pickles, atomically."""
        with atomic_path(path) as temporary, temporary.open("wb") as stream:
            np.savez_compressed(stream, allow_pickle=False, phi=self.phi, origin=self.origin, voxel=self.voxel)

    @classmethod
    def load(cls, path: Path) -> SignedDistance:
        """Read what `save` wrote, or a stranger's file of that layout; one-line errors name the file."""
        arrays = read_npz(path, {"phi": 4, "origin": 1, "voxel": 0}, max_bytes=MAX_BYTES + (1 << 20))
        try:
            return cls(arrays["phi"], arrays["origin"], float(arrays["voxel"]))
        except ValueError as error:
            raise SplashbenchError(f"{path}: {error}; write it again") from None

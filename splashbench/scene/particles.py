"""Particles over time: a method's carriers, or the ground truth of a synthetic scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import atomic_path, read_npz

#: Of the arrays of a file, unpacked: 800 000 particles in single precision over 100 timesteps.
MAX_BYTES = 1 << 30
#: Rows of a file: each is sorted and looked at once per timestep.
MAX_PARTICLES = 2_000_000
# Of a row at an instant: position, velocity, whether it is active.
_ROW_BYTES = 4 * 3 + 4 * 3 + 1


def most_particles(n_frames: int) -> int:
    """How many particles over `n_frames` instants, with velocities, a file may hold; it has a few headers besides."""
    return min(MAX_PARTICLES, (MAX_BYTES - (1 << 16)) // (_ROW_BYTES * max(n_frames, 1)))


def even_share(count: int, most: int) -> NDArray[np.int64]:
    """Numbers of at most `most` of `count` rows, ascending and evenly apart, int64 [n]."""
    return np.arange(count) if count <= most else np.arange(most) * count // most


@dataclass
class Particles:
    """Positions of N particles at T instants; a row is one particle followed through time.

    Attributes:
        positions: [T, N, 3] float32, scene units; entries of inactive particles are finite but meaningless.
        active: [T, N] bool, whether the particle exists at that instant.
        velocities: [T, N, 3] float32, scene units per second, or None where they are not known.
    """

    positions: NDArray[np.float32]
    active: NDArray[np.bool_]
    velocities: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        self.positions = np.asarray(self.positions, dtype=np.float32)
        self.active = np.asarray(self.active, dtype=bool)
        shape = self.positions.shape
        if len(shape) != 3 or shape[2] != 3 or self.active.shape != shape[:2]:
            raise ValueError(f"positions {shape} and active {self.active.shape} must be [T, N, 3] and [T, N]")
        if self.velocities is not None:
            self.velocities = np.asarray(self.velocities, dtype=np.float32)
            if self.velocities.shape != shape:
                raise ValueError(f"velocities {self.velocities.shape} must be shaped like positions {shape}")

    @property
    def n_frames(self) -> int:
        """T, the number of instants."""
        return self.positions.shape[0]

    @property
    def count(self) -> int:
        """N, the number of rows."""
        return self.positions.shape[1]

    def share(self, most: int) -> Particles:
        """These where they are `most` rows or fewer, else an even share of them."""
        if self.count <= most:
            return self
        rows = even_share(self.count, most)
        velocities = None if self.velocities is None else self.velocities[:, rows]
        return Particles(self.positions[:, rows], self.active[:, rows], velocities)

    def at(self, t: int) -> NDArray[np.float32]:
        """Positions [n, 3] of the particles that exist at instant `t`."""
        return self.positions[t][self.active[t]]

    def save(self, path: Path) -> None:
        """Write an .npz without pickles, atomically."""
        arrays: dict[str, NDArray] = {"positions": self.positions, "active": self.active}
        if self.velocities is not None:
            arrays["velocities"] = self.velocities
        with atomic_path(path) as temporary, temporary.open("wb") as stream:
            np.savez_compressed(stream, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: Path) -> Particles:
        """Read what `save` wrote, or a stranger's file of that layout; one-line errors name the file."""
        arrays = read_npz(path, {"positions": 3, "active": 2}, optional={"velocities": 3}, max_bytes=MAX_BYTES)
        if arrays["positions"].shape[1] > MAX_PARTICLES:
            raise SplashbenchError(f"{path} has more than {MAX_PARTICLES} particles; write fewer")
        try:
            with np.errstate(over="ignore"):
                particles = cls(arrays["positions"], arrays["active"], arrays.get("velocities"))
            for name in ("positions", "velocities"):
                values = getattr(particles, name)
                if values is not None and not np.isfinite(values).all():
                    raise ValueError(f"{name} has entries beyond the range of float32")
            return particles
        except ValueError as error:
            raise SplashbenchError(f"{path}: {error}; write it again") from None

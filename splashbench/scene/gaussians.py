"""Gaussians at one instant: what a model hands to viewers and exports, whatever it is made of inside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass
class Gaussians:
    """N Gaussians as they are at one instant, coloured as one place sees them.

    Attributes:
        means: float32 [N, 3], scene units.
        factors: float32 [N, 3, 3], B of the covariances B B^T, scene units.
        opacities: float32 [N] in [0, 1].
        colors: float32 [N, 3], sRGB in [0, 1].

    Raises ValueError for arrays that do not fit together.
    """

    means: NDArray[np.float32]
    factors: NDArray[np.float32]
    opacities: NDArray[np.float32]
    colors: NDArray[np.float32]

    def __post_init__(self) -> None:
        n = len(self.means)
        shapes = {"means": (n, 3), "factors": (n, 3, 3), "opacities": (n,), "colors": (n, 3)}
        for name, shape in shapes.items():
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float32)
            if array.shape != shape:
                raise ValueError(f"{name} have shape {array.shape}, not {shape}")
            setattr(self, name, array)

    def __len__(self) -> int:
        return len(self.means)

    @classmethod
    def none(cls) -> Gaussians:
        """No Gaussian at all."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros((0, 3)))  # type: ignore[arg-type]

    def kept(self, chosen: NDArray) -> Gaussians:
        """Those that `chosen` picks: bool [N], or indices."""
        return Gaussians(self.means[chosen], self.factors[chosen], self.opacities[chosen], self.colors[chosen])

    @property
    def covariances(self) -> NDArray[np.float32]:
        """B B^T, float32 [N, 3, 3], squared scene units."""
        return np.asarray(self.factors @ self.factors.transpose(0, 2, 1), np.float32)

    def axes(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Standard deviations [N, 3] along the principal axes, scene units, and the axes as unit quaternions [N, 4].

        Quaternions are w x y z, of the rotation from the axes to the scene. So do 3DGS files have Gaussians.
        """
        from scipy.spatial.transform import Rotation

        if len(self) == 0:
            return np.zeros((0, 3), np.float32), np.zeros((0, 4), np.float32)
        rotation, deviations, _ = np.linalg.svd(self.factors.astype(np.float64))
        rotation[np.linalg.det(rotation) < 0, :, 2] *= -1  # a mirror is no rotation
        quaternions = Rotation.from_matrix(rotation).as_quat()[:, [3, 0, 1, 2]]
        return deviations.astype(np.float32), quaternions.astype(np.float32)

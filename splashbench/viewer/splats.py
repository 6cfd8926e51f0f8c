"""Gaussians as viser's client takes them: few enough, in its number formats, and none that are no numbers.

The client holds covariances in 16-bit floats, whose smallest step is 6e-8. Liquids in scene units have variances of
that size, so each group of Gaussians is sent in a unit of its own and scaled back by its scene node.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.scene import Gaussians
from splashbench.submission import to_8bit

# The largest standard deviation in the unit that is sent, but for a few larger ones. Its square leaves the 16-bit float
# (65504) room for those and for later frames, and standard deviations down to a 2000th keep all of its digits.
_LARGEST = 16.0
_MOST = 250.0
# Percent of the Gaussians that the unit suits: one of a stranger's may be huge, and the others would vanish beside it.
_SUITED = 99.0


@dataclass(frozen=True)
class PackedGaussians:
    """N Gaussians in a unit of `scale` scene units.

    Attributes:
        centers: float32 [N, 3]. covariances: float32 [N, 3, 3], squared units. Both in the unit that is sent.
        colors: uint8 [N, 3], sRGB. opacities: uint8 [N, 1].
        scale: scene units in one unit.
        left_out: how many of the model's are not among them, to save work.
    """

    centers: NDArray[np.float32]
    covariances: NDArray[np.float32]
    colors: NDArray[np.uint8]
    opacities: NDArray[np.uint8]
    scale: float
    left_out: int = 0

    def __len__(self) -> int:
        return len(self.centers)

    def arguments(self) -> dict[str, NDArray]:
        """Arguments of viser's `add_gaussian_splats` and `set_gaussians`."""
        return {
            "centers": self.centers,
            "covariances": self.covariances,
            "rgbs": self.colors,
            "opacities": self.opacities,
        }

    def padded(self, number: int) -> PackedGaussians:
        """`number` of them, the added ones invisible: a group that keeps its size is exchanged without a flash.

        Raises ValueError where there are more already.
        """
        missing = number - len(self)
        if missing < 0:
            raise ValueError(f"there are {len(self)} Gaussians, more than {number}")
        middle = self.centers.mean(axis=0) if len(self) else np.zeros(3)
        return PackedGaussians(
            np.concatenate([self.centers, np.tile(middle.astype(np.float32), (missing, 1))]),
            np.concatenate([self.covariances, np.zeros((missing, 3, 3), np.float32)]),
            np.concatenate([self.colors, np.zeros((missing, 3), np.uint8)]),
            np.concatenate([self.opacities, np.zeros((missing, 1), np.uint8)]),
            self.scale,
            self.left_out,
        )


def unit_of(gaussians: Gaussians) -> float:
    """The unit to send `gaussians` in, scene units: a power of two, so that no place is rounded by it."""
    variances = np.trace(gaussians.covariances, axis1=1, axis2=2, dtype=np.float64)
    variances = variances[variances > 0]
    if not len(variances):
        return 1.0
    large = math.sqrt(float(np.percentile(variances, _SUITED, method="lower")))
    return 2.0 ** math.ceil(math.log2(large / _LARGEST))


def sound(gaussians: Gaussians) -> Gaussians:
    """Those of `gaussians` that are numbers: a stranger's model may hold others, which a browser cannot sort."""
    if not len(gaussians):
        return gaussians
    finite = np.isfinite(gaussians.opacities)
    with np.errstate(over="ignore", invalid="ignore"):
        covariances = gaussians.covariances
    for array in (gaussians.means, gaussians.factors, gaussians.colors, covariances):
        finite &= np.isfinite(array.reshape(len(gaussians), -1)).all(axis=1)
    return gaussians if finite.all() else gaussians.kept(finite)


def pack(gaussians: Gaussians, scale: float, most: int) -> PackedGaussians:
    """At most `most` of `gaussians`, all finite, in units of `scale` scene units: those that are seen the most.

    A Gaussian too large for the format is made as large as the format allows.
    """
    shown = gaussians.kept(most_visible(gaussians, most)) if len(gaussians) > most else gaussians
    covariances = shown.covariances.astype(np.float64) / scale**2
    spread = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    too_large = spread > _MOST
    covariances[too_large] *= (_MOST / spread[too_large, None, None]) ** 2
    return PackedGaussians(
        shown.means / np.float32(scale),
        covariances.astype(np.float32),
        to_8bit(shown.colors),
        to_8bit(shown.opacities)[:, None],
        scale,
        len(gaussians) - len(shown),
    )


def most_visible(gaussians: Gaussians, number: int) -> NDArray[np.int64]:
    """Indices, rising, of the `number` Gaussians with the largest opacity times size (the sum of their variances)."""
    weight = gaussians.opacities * np.trace(gaussians.covariances, axis1=1, axis2=2)
    if number >= len(weight):
        return np.arange(len(weight))
    return np.sort(np.argpartition(weight, len(weight) - number)[len(weight) - number :])

"""Gaussians merged where viser's client would leave them out for being small.

The client draws no Gaussian whose opacity times the determinant of its covariance on the screen, in pixels and blurred
by .3, is below .25. A model of many faint small ones all but disappears from some way off. Here those that would be
left out are replaced by one for each cell of a grid as wide as a few pixels, with the same mean, covariance and colour
in all, and the opacity that covers as much, blurred as all renderers of Gaussians do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.scene import Gaussians

# Of viser 1.1's shader: what a Gaussian needs there, with room for covariances as 16-bit floats; and its blur.
_LEAST, _BLUR = 0.25 * 1.05, 0.3
# Widths of the cells, pixels: what is left out of one after merging is merged in the next.
_CELLS = (1.5, 3.0, 6.0)
_MOST_OPAQUE = 0.99


@dataclass(frozen=True)
class Lookout:
    """Where Gaussians are looked at from: eye [3] in scene units, and the angle that a pixel covers, radians."""

    eye: NDArray[np.float64]
    angle: float

    def pixel(self, places: NDArray) -> NDArray[np.float64]:
        """How wide a pixel is at `places` [N, 3], scene units."""
        distance = np.linalg.norm(np.asarray(places, np.float64) - self.eye, axis=-1)
        return np.asarray(self.angle * np.maximum(distance, 1e-9))


def merged(gaussians: Gaussians, lookout: Lookout) -> Gaussians:
    """`gaussians`, the ones that the client would leave out merged. Those that it draws stay as they are, first."""
    parts = [gaussians]
    for cell in _CELLS:
        last = parts.pop()
        drawn = _drawn(last, lookout)
        parts.append(last.kept(drawn))
        if drawn.all():
            break
        parts.append(_by_cells(last.kept(~drawn), lookout, cell))
    return _joined(parts)


def _drawn(gaussians: Gaussians, lookout: Lookout) -> NDArray[np.bool_]:
    """Whether the client draws each: bool [N]. Its covariance on the screen is taken to be that of its mean width."""
    return np.asarray(gaussians.opacities * _covered(gaussians.covariances, gaussians.means, lookout) ** 2 >= _LEAST)


def _covered(covariances: NDArray, means: NDArray, lookout: Lookout) -> NDArray[np.float64]:
    """What each covers on the screen, blurred, as a mean over all directions: [N] pixels, up to one factor."""
    # The mean of the squared areas of its three shadows along the axes: its principal 2x2 minors.
    c = covariances.astype(np.float64)
    minors = [c[:, i, i] * c[:, j, j] - c[:, i, j] ** 2 for i, j in ((0, 1), (0, 2), (1, 2))]
    return np.asarray(np.sqrt(np.maximum(np.mean(minors, axis=0), 0)) / lookout.pixel(means) ** 2 + _BLUR)


def _by_cells(gaussians: Gaussians, lookout: Lookout, cell: float) -> Gaussians:
    """One Gaussian for each cell that has some, `cell` pixels wide as seen from there, to a power of two."""
    level = np.ceil(np.log2(cell * lookout.pixel(gaussians.means)))
    group, number = _numbered(np.column_stack([level, np.floor(gaussians.means / np.exp2(level)[:, None])]))
    covariances = gaussians.covariances.astype(np.float64)
    # Covered pixels times optical depth: what a mixture keeps. A faint one weighs little in everything.
    depth = -np.log1p(-np.minimum(gaussians.opacities.astype(np.float64), _MOST_OPAQUE))
    weight = np.maximum(depth * _covered(covariances, gaussians.means, lookout), 1e-300)
    total = np.bincount(group, weight, number)
    share = weight / total[group]

    def mean(values: NDArray) -> NDArray[np.float64]:
        columns = values.reshape(len(values), -1).T
        return np.stack([np.bincount(group, share * column, number) for column in columns], axis=-1)

    means = mean(gaussians.means.astype(np.float64))
    apart = gaussians.means - means[group]
    spread = mean(covariances + apart[:, :, None] * apart[:, None, :]).reshape(number, 3, 3)
    flat = 1e-6 * np.trace(spread, axis1=1, axis2=2) + 1e-30  # one that is a disc has no factor of this kind
    factors = np.linalg.cholesky(spread + flat[:, None, None] * np.eye(3))
    opacities = 1 - np.exp(-total / _covered(spread, means, lookout))
    colors = mean(gaussians.colors.astype(np.float64))
    return Gaussians(means, factors, np.minimum(opacities, _MOST_OPAQUE), colors)  # type: ignore[arg-type]


def _numbered(rows: NDArray[np.float64]) -> tuple[NDArray[np.int64], int]:
    """A number from 0 for each different row of whole numbers [N, K], [N]; and how many there are."""
    group = np.zeros(len(rows), np.int64)
    number = 1
    for column in rows.T:
        _, place = np.unique(column, return_inverse=True)
        _, group = np.unique(group * (int(place.max()) + 1) + place.ravel(), return_inverse=True)
        group = group.ravel()
        number = int(group.max()) + 1
    return group, number


def _joined(parts: list[Gaussians]) -> Gaussians:
    return Gaussians(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("means", "factors", "opacities", "colors")
        )
    )

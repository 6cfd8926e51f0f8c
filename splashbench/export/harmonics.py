"""View-dependent colours as spherical harmonics: fitted to what a model shows from many places.

A model may decide a Gaussian's colour in any way; files of Gaussians have spherical harmonics of the direction from the
eye to the Gaussian (Kerbl et al. 2023, Sec. 4). What matters most is how it looks from where the cameras were and from
between them. Places all around count little: they keep the fit from going astray where nobody has looked.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
from numpy.typing import NDArray

from splashbench.export.sphere import even_directions
from splashbench.gaussians.spherical_harmonics import basis
from splashbench.gaussians.torch_threads import one_torch_thread

MAX_DEGREE = 3
# Of places: between cameras at most, all around, and what one of the latter counts for.
_BETWEEN, _AROUND, _AROUND_WEIGHT = 16, 16, 0.1
# Of squared coefficients beyond the constant, against the mean squared error. Ten times as much costs .1 dB.
_DAMPING = 1e-3
# Gaussians that are solved for at once.
_AT_ONCE = 1 << 14


@dataclass(frozen=True)
class Viewpoints:
    """Places to look from, [E, 3], and how much each counts, [E], which sums to one."""

    places: NDArray[np.float64]
    weights: NDArray[np.float64]


def viewpoints(cameras: Sequence[NDArray[np.float64]], middle: NDArray[np.float64]) -> Viewpoints:
    """Where to look from at `middle` [3]: from the `cameras`' places [3], from between two of them, and from around."""
    arms = np.asarray(cameras, dtype=np.float64) - middle
    lengths = np.linalg.norm(arms, axis=1)
    arms, lengths = arms[lengths > 0], lengths[lengths > 0]
    if not len(arms):
        arms, lengths = np.eye(3), np.ones(3)  # a camera within: any direction is as good
    between = list(_between(arms / lengths[:, None], lengths))
    if len(between) > _BETWEEN:
        between = [between[i] for i in np.linspace(0, len(between) - 1, _BETWEEN).round().astype(int)]
    around = even_directions(_AROUND) * lengths.mean()
    places = middle + np.concatenate([arms, np.reshape(between, (-1, 3)), around])
    weights = np.ones(len(places))
    weights[-_AROUND:] = _AROUND_WEIGHT
    return Viewpoints(places, weights / weights.sum())


def _between(directions: NDArray[np.float64], lengths: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """Arms half way between each two of `directions` [C, 3], in angle and in length."""
    for i, j in combinations(range(len(directions)), 2):
        bisector = directions[i] + directions[j]
        norm = np.linalg.norm(bisector)
        if norm > 1e-6:  # else they look at one another
            yield bisector / norm * (lengths[i] + lengths[j]) / 2


def fit_harmonics(means: NDArray, colors: NDArray, points_of_view: Viewpoints, degree: int) -> NDArray[np.float32]:
    """Coefficients [N, (degree + 1)^2, 3] of colours as files of Gaussians have them: 0.5 + their sum with the basis.

    Args:
        means: [N, 3]. colors: [E, N, 3] that the places see. degree: 0 to MAX_DEGREE.

    Weighted least squares; coefficients beyond the constant are damped, since few places tell of many directions.
    """
    count = (degree + 1) ** 2
    found = np.empty((len(means), count, 3), np.float32)
    damping = torch.full((count,), _DAMPING, dtype=torch.float64)
    damping[0] = 0
    weights = torch.from_numpy(points_of_view.weights)[:, None, None]
    with torch.no_grad(), one_torch_thread():
        for start in range(0, len(means), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            directions = unit_directions(means[part], points_of_view.places)
            shape = (*directions.shape[:2], count)
            values = basis(torch.from_numpy(directions.reshape(-1, 3)), degree).reshape(shape)
            wanted = torch.from_numpy(np.asarray(colors[:, part], dtype=np.float64)) - 0.5
            normal = torch.einsum("enk,enl->nkl", values * weights, values) + torch.diag(damping)
            right = torch.einsum("enk,enc->nkc", values * weights, wanted)
            found[part] = torch.linalg.solve(normal, right).numpy()
    return found


def unit_directions(means: NDArray, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vectors [E, N, 3] from `places` [E, 3] to `means` [N, 3]; x where a mean lies in the place itself."""
    arms = np.asarray(means, dtype=np.float64)[None] - places[:, None]
    lengths = np.linalg.norm(arms, axis=-1, keepdims=True)
    return np.where(lengths > 0, arms / np.where(lengths > 0, lengths, 1), [1.0, 0.0, 0.0])

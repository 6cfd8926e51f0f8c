"""The level surface that things stand on: the plane that most of what stands still about the liquid lies in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.arrays import Floats

# Planes through three points that are tried, and the points by which they are compared.
_TRIED, _COMPARED = 400, 20_000
# Rounds of the last fit to the points that lie in the plane.
_ROUNDS = 3
_LEAST_POINTS = 200


@dataclass(frozen=True, eq=False)
class Support:
    """normal: unit vector [3], upwards. offset: normal @ p of its points p, scene units. share: of the points it was
    found in, those that lie in it."""

    normal: Floats
    offset: float
    share: float

    def heights(self, points: NDArray) -> Floats:
        """How far points [..., 3] lie above it, scene units."""
        return np.asarray(points @ self.normal - self.offset)


def find_support(points: Floats, centers: Floats, up: Floats, degrees: float, tolerance: float) -> Support | None:
    """The plane in which the most of `points` [N, 3] lie to within `tolerance`, all in scene units.

    centers: of cameras [V, 3], which are above it. up: [3], within so many `degrees` of its normal. None where there
    are too few points, or no such plane.
    """
    points = points[np.isfinite(points).all(axis=1)]
    length = float(np.linalg.norm(up))
    if len(points) < _LEAST_POINTS or length == 0:
        return None
    up, least = up / length, np.cos(np.deg2rad(degrees))
    rng = np.random.default_rng(0)
    compared = points[rng.permutation(len(points))[:_COMPARED]]
    best: tuple[int, Floats, float] | None = None
    for first, second, third in compared[rng.integers(len(compared), size=(_TRIED, 3))]:
        normal = np.cross(second - first, third - first)
        length = float(np.linalg.norm(normal))
        if length == 0:
            continue
        normal = normal * (np.sign(normal @ up) / length)
        offset = float(normal @ first)
        if normal @ up < least or (centers @ normal <= offset).any():
            continue
        count = int((np.abs(compared @ normal - offset) < tolerance).sum())
        if best is None or count > best[0]:
            best = count, normal, offset
    if best is None or best[0] < _LEAST_POINTS * len(compared) / len(points):
        return None
    _, normal, offset = best
    for _ in range(_ROUNDS):
        within = points[np.abs(points @ normal - offset) < tolerance]
        middle = within.mean(axis=0)
        spread = (within - middle).T @ (within - middle)
        across = np.linalg.eigh(spread)[1][:, 0]
        normal = across * np.sign(across @ normal)
        offset = float(normal @ middle)
    share = float((np.abs(points @ normal - offset) < tolerance).mean())
    return Support(normal, offset, share)

"""The upright body that views show, as numbers that a search can change: where it stands, its height, its radii.

Circular rings come first, then superellipses, from ellipses to boxes with rounded corners.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import minimize

from splashbench.arrays import Floats
from splashbench.container.outline_views import DepthView
from splashbench.container.standing import ContainerView, Place
from splashbench.container.vessel_body import VesselBody, superellipse

# Radii of the body, from the foot to the rim, with points of a ring: radii change linearly in between, so that these
# rings are all that silhouettes need. Rings of the mesh, those among them.
_RADII, _ANGLES, MESH_RINGS = 5, 48, 33
#: Numbers of a body with circular rings: where it stands [2], its height, its radii. Others have three more.
CIRCULAR = 3 + _RADII
#: Which of them are the height, and the radii.
HEIGHT, ALL_RADII = 2, slice(3, CIRCULAR)
# Widths of the foot that are tried, as shares of the rim's.
_FEET = (0.5, 0.8, 1.0)
#: What `bend` costs.
BEND = 0.02
# Steps of the search, as shares of the size; evaluations. It ends where numbers change by less than this share of them.
_STEP, _EVALUATIONS, _SETTLED = 0.12, 500, 0.005
# From this cover on circles will do; what a box is tried with: exponents, aspects and turns.
_GOOD, _EXPONENT, _ASPECTS, _TURNS = 0.95, 8.0, (0.0, 0.3), 4


class BodySearch:
    """Looks for the body on `place` that `views` show. size: of each number, those of the outline included."""

    def __init__(self, place: Place, views: Sequence[ContainerView]) -> None:
        self.place = place
        self._shown = [DepthView.of(view) for view in views]
        self._speaking = sum(view.speaking for view in self._shown)
        self._first, self.size = _first_body(views)

    def held(self, numbers: Floats) -> float:
        """Of the pixels that speak for the container, the share within the silhouettes of the body of `numbers`, less
        those that speak against it."""
        drawn = rings(self.place, numbers)
        return sum(view.held(drawn) for view in self._shown) / self._speaking

    def found(self) -> tuple[Floats, int]:
        """The numbers of the body that holds most, and how many of them, the first ones, were changed."""

        def misses(numbers: Floats) -> float:
            return BEND * bend(numbers) - self.held(numbers)

        step, first = _STEP * self.size, self._first
        starts = [first + np.concatenate([np.zeros(3), first[3] * np.linspace(foot - 1, 0, _RADII)]) for foot in _FEET]
        circles = [np.concatenate([start, [0.0, 2.0, 0.0]]) for start in starts]
        found = max((best_about(misses, start, step[:CIRCULAR], _EVALUATIONS) for start in circles), key=self.held)
        if self.held(found) >= _GOOD:
            return found, CIRCULAR
        boxes = [
            np.concatenate([found[:CIRCULAR], [aspect, _EXPONENT, turn]])
            for aspect in _ASPECTS
            for turn in np.arange(_TURNS) * (np.pi / (_TURNS if aspect else 2 * _TURNS))
        ]
        box = best_about(misses, max(boxes, key=self.held), step, _EVALUATIONS)
        return (box, len(box)) if self.held(box) > self.held(found) else (found, CIRCULAR)


def _first_body(views: Sequence[ContainerView]) -> tuple[Floats, Floats]:
    """The numbers of a cylinder about what the views show, and how large each number is, that of outlines included."""
    points = np.concatenate([view.points for view in views])
    low, high = np.quantile(points[:, :2], [0.03, 0.97], axis=0)
    middle = 0.5 * (low + high)
    radius = float(np.quantile(np.linalg.norm(points[:, :2] - middle, axis=1), 0.95))
    height = float(np.quantile(points[:, 2], 0.97))
    first = np.concatenate([middle, [height], np.full(_RADII, radius)])
    return first, np.concatenate([[radius, radius, height], np.full(_RADII, radius), [1.0, 16.0, 1.6]])


def body(place: Place, numbers: Floats, count: int = _RADII) -> VesselBody:
    """The body of `numbers`: where it stands [2], its height, radii from foot to rim, and the outline's aspect,
    exponent and turn. count: of its rings."""
    heights = np.linspace(0, numbers[2], count)
    radii = np.interp(heights, np.linspace(0, numbers[2], _RADII), numbers[ALL_RADII])
    aspect, exponent, turn = numbers[CIRCULAR:]
    outline = superellipse(float(aspect), float(np.clip(exponent, 2, 30)), float(turn), _ANGLES)
    return VesselBody(place.origin + numbers[:2] @ place.frame[:2], place.frame, outline, heights, radii)


def rings(place: Place, numbers: Floats) -> Floats:
    """The rings of the body of `numbers`, [K, N, 3]."""
    drawn = body(place, numbers)
    return drawn.rings(drawn.radii)


def beside(numbers: Floats) -> float:
    """How far from the axis the place's origin is, in radii of the widest ring."""
    return float(np.linalg.norm(numbers[:2]) / numbers[ALL_RADII].max())


def grown(numbers: Floats, share: float) -> Floats:
    """The numbers of the body of which height and radii are `share` times as large."""
    larger = numbers.copy()
    larger[HEIGHT:CIRCULAR] *= share
    return larger


def narrowed(numbers: Floats, by: float) -> Floats:
    """The numbers of the body of which radii are less by so much, scene units, and half of that the height; never by
    more than half of what they are."""
    smaller = numbers.copy()
    smaller[ALL_RADII] -= np.minimum(by, 0.5 * smaller[ALL_RADII])
    smaller[HEIGHT] -= min(0.5 * by, 0.5 * smaller[HEIGHT])
    return smaller


def bend(numbers: Floats) -> float:
    """How much a profile bends: the sum of squares of its second differences, by the largest radius."""
    radii = numbers[ALL_RADII]
    return float((np.diff(radii, 2) ** 2).sum() / radii.max() ** 2)


def best_about(cost: Callable[[Floats], float], first: Floats, steps: Floats, evaluations: int) -> Floats:
    """The numbers about `first` of least cost. steps: of the leading numbers, which may change."""
    free = len(steps)

    def moved(by: Floats) -> Floats:
        return np.concatenate([first[:free] + by * steps, first[free:]])

    def tried(by: Floats) -> float:
        numbers = moved(by)
        return cost(numbers) if (numbers[HEIGHT:CIRCULAR] > 0).all() else 1e3

    found = minimize(
        tried,
        np.zeros(free),
        method="Nelder-Mead",
        options={
            "initial_simplex": np.vstack([np.zeros(free), np.eye(free)]),
            "maxfev": evaluations,
            "xatol": _SETTLED,
            "fatol": 1e-5,
        },
    )
    return moved(found.x)

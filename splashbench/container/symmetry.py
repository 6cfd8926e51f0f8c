"""Turns about a container's vertical axis that its outlines cannot tell apart.

A bowl looks the same at any turn, a box after half a turn. Which of the turns that look alike is taken follows a rule.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from splashbench.arrays import Floats
from splashbench.container.contours import Contour, find_contour
from splashbench.container.mask_views import MaskView
from splashbench.container.stance import Axis, CentredMesh, Stance
from splashbench.scene.container import ContainerMesh

Turn = Literal["determined", "repeats", "free"]

# Turns whose outlines differ by less than a pixel of the image, or this share of the container, cannot be told apart.
_SAME_OUTLINE = 0.005
_SAME_POINTS = 98  # percentile of the outline's points
_TURN_STEP_DEGREES, _BROAD_STEP_DEGREES = 3, 15
# Added to the preferred turn, so that a container that stands square to the scene's axes never lies between two turns.
_TIE_DEGREES = 10.0


def settle_turn(
    body: CentredMesh, mesh: ContainerMesh, views: Sequence[MaskView], stance: Stance, axis: Axis, preferred: Floats
) -> tuple[Turn, int, Stance, Floats]:
    """How far the outlines tell the turn about the vertical axis, and the stance at the turn to take.

    preferred: rotation [3, 3]; of the turns that look alike, the nearest to it is taken.

    Returns what the outlines tell, how many turns look alike (0: all), the stance turned, and the vertical axis in the
    scene [3].
    """
    axis_of_mesh = body.vertical(axis)
    outlines = [find_contour(np.isfinite(view.depth(mesh, stance))) for view in views]

    def alike(degrees: int) -> bool:
        return _looks_alike(mesh, views, outlines, stance.turned(axis_of_mesh, float(np.deg2rad(degrees))))

    vertical = stance.rotation @ axis_of_mesh
    # The turn that brings the rotation nearest to the preferred one: the largest trace of preferred^T A(turn) R.
    between = stance.rotation @ preferred.T
    skew = np.array([between[2, 1] - between[1, 2], between[0, 2] - between[2, 0], between[1, 0] - between[0, 1]])
    nearest = np.arctan2(-vertical @ skew, np.trace(between) - vertical @ between @ vertical)
    # These compose to every turn that is tried below.
    fine, broad = range(_TURN_STEP_DEGREES, _BROAD_STEP_DEGREES, _TURN_STEP_DEGREES), range(0, 360, _BROAD_STEP_DEGREES)
    if all(alike(degrees) for degrees in (*fine, *broad)):
        return "free", 0, stance.turned(axis_of_mesh, float(nearest)), vertical
    angles = np.arange(0, 360, _TURN_STEP_DEGREES)
    runs = _runs(np.array([alike(degrees) for degrees in angles.tolist()]))
    if len(runs) < 2:
        return "determined", 1, stance, vertical
    target = nearest + np.deg2rad(_TIE_DEGREES)
    options = [np.deg2rad(angles[run[len(run) // 2]]) for run in runs]
    chosen = max(options, key=lambda angle: float(np.cos(angle - target)))
    return "repeats", len(runs), stance.turned(axis_of_mesh, float(chosen)), vertical


def _looks_alike(mesh: ContainerMesh, views: Sequence[MaskView], outlines: Sequence[Contour], stance: Stance) -> bool:
    for view, unturned in zip(views, outlines):
        turned = find_contour(np.isfinite(view.depth(mesh, stance)))
        if not len(turned.points) or not len(unturned.points):
            continue
        tolerance = max(view.factor, _SAME_OUTLINE * float(np.ptp(unturned.points, axis=0).max()))
        for one, other in ((turned, unturned), (unturned, turned)):
            if np.percentile(one.distances_to(other), _SAME_POINTS) > tolerance:
                return False
    return True


def _runs(alike: NDArray[np.bool_]) -> list[list[int]]:
    """Indices of each run of True around a circle; the one that holds the first entry, which is True, comes first."""
    breaks = np.flatnonzero(~alike)
    if not len(breaks):
        return [list(range(len(alike)))]
    order = np.roll(np.arange(len(alike)), -int(breaks[-1]) - 1)
    runs: list[list[int]] = []
    for position, index in enumerate(order.tolist()):
        if not alike[index]:
            continue
        if position and alike[order[position - 1]]:
            runs[-1].append(index)
        else:
            runs.append([index])
    return sorted(runs, key=lambda run: 0 not in run)

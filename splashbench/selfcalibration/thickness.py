"""How far the training cameras' clocks are apart, by how thick liquid is: told from masks, to a third of a timestep.

A plane through the line between two cameras is a line in either image (an epipolar plane). Whatever liquid is in the
plane, both cameras see it on their lines at the same time. How much they see is not the same, as they look from other
sides, but it comes and goes together: when a splash rises into the plane, or beads of a stream fall through it. So the
offset of two clocks is the one by which these courses over time agree best, over all planes together. It asks for
nothing that is small or apart, as droplets are (clocks.py), and is known for any liquid that moves.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from splashbench.scene import Camera

# Masks are looked at in images so large along their longest side, and planes so many of its pixels apart.
_SIDE, _WIDTH = 240, 1.5
#: Offsets that are looked for, in timesteps, either way; fewer where there are few frames.
REACH = 8
# Frames that have to be seen by both cameras with any offset.
_LEAST_FRAMES = 6
# Planes over which courses are smoothed. Unsmoothed ones agree best where offsets are whole timesteps. Beads that fall
# by more than their own size in a timestep are told from each other by smooth ones alone where they are not.
_SMOOTH = (0.0, 4.0)
# A pair is clear where courses agree (correlation) by so much more than at any offset two or more timesteps away, as a
# share of what is missing to full agreement.
_CLEAR = 0.15
# A pair that is off by more timesteps than this from what all pairs together say has no say.
_ASTRAY = 0.5
# Pairs that have to agree about a camera, and cameras that have to agree with each other.
_LEAST_PAIRS, _LEAST_CAMERAS = 2, 3


@dataclass(frozen=True)
class Lag:
    """Of a pair of cameras. timesteps: by how much later than told the second takes its photographs, beside the first.
    agreement: of what both see, with that offset in whole timesteps. clarity: see `_CLEAR`."""

    timesteps: float
    agreement: float
    clarity: float


@dataclass(frozen=True, eq=False)
class Thickness:
    """What one view sees of the liquid. wet: float32 [T, h * w], the share of each pixel of `camera` that is liquid."""

    camera: Camera
    wet: NDArray[np.float32]

    @classmethod
    def of(cls, masks: Iterable[NDArray[np.bool_]], camera: Camera) -> Thickness:
        """masks: bool [H, W] of all frames."""
        factor = min(_SIDE / max(camera.width, camera.height), 1.0)
        small = camera.scaled(factor)
        size = small.width, small.height
        wet = [cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA).ravel() for mask in masks]
        return cls(small, np.stack(wet))


def rough_offsets(seen: Mapping[str, Thickness]) -> dict[str, float]:
    """By how many timesteps later than told each camera takes its photographs, beside the others; cameras of which that
    is not clear have none. What all are off by together is not known, and left at anything."""
    lags = {}
    for first, second in combinations(seen, 2):
        lag = lag_of(seen[first], seen[second])
        if lag is not None and lag.clarity >= _CLEAR:
            lags[first, second] = lag
    return _solved(lags)


def lag_of(first: Thickness, second: Thickness) -> Lag | None:
    """How far the clocks of two cameras are apart; None where they see nothing in common that moves."""
    seen = courses(first, second)
    if seen is None:
        return None
    reach = min(REACH, len(first.wet) - _LEAST_FRAMES)
    if reach < 2:
        return None
    found = []
    for smooth in _SMOOTH:
        here, there = seen
        if smooth:
            here, there = gaussian_filter1d(here, smooth, axis=1), gaussian_filter1d(there, smooth, axis=1)
        agreeing = np.array([agreement(here, there, lag) for lag in range(-reach, reach + 1)])
        if (clearest := _clearest(agreeing, reach)) is not None:
            found.append(clearest)
    return max(found, key=lambda lag: lag.clarity, default=None)


def _clearest(agreement: NDArray[np.float64], reach: int) -> Lag | None:
    """The lag at which courses agree best. agreement: at -reach to reach frames."""
    best = int(np.argmax(agreement))
    if not 0 < best < 2 * reach or not agreement[best] > 0:
        return None
    apart = np.abs(np.arange(len(agreement)) - best) >= 2
    clarity = float((agreement[best] - agreement[apart].max()) / (1.01 - agreement[best]))
    before, now, after = agreement[best - 1 : best + 2]
    # Agreement falls in proportion to the time between on either side, as what is seen comes and goes at once.
    slope = 0.5 * (after - before) / max(now - 0.5 * (after + before), 1e-9)
    # What the second shows so many frames later than the first, it is told to see that much too late.
    return Lag(-float(best - reach + slope / (1 + abs(slope))), float(now), clarity)


def agreement(here: NDArray[np.float64], there: NDArray[np.float64], lag: int) -> float:
    """Correlation of what one sees with what the other sees `lag` frames later, [T, n] of all planes."""
    count, start = len(here) - abs(lag), max(0, -lag)
    one, other = here[start : start + count], there[start + lag : start + lag + count]
    one, other = one - one.mean(axis=0), other - other.mean(axis=0)
    return float((one * other).sum() / max(np.sqrt((one**2).sum() * (other**2).sum()), 1e-9))


def courses(first: Thickness, second: Thickness) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """How much each of two views sees in each plane between the first and the last in which both see liquid: float64
    [T, n] twice."""
    base = second.camera.center - first.camera.center
    length = float(np.linalg.norm(base))
    if length < 1e-9:
        return None
    base = base / length
    ahead = first.camera.w2c[2, :3] + second.camera.w2c[2, :3]
    ahead = ahead - base * (ahead @ base)
    if np.linalg.norm(ahead) < 1e-6:
        return None  # one looks at the other: every plane is seen edge on
    axes = np.stack([ahead / np.linalg.norm(ahead), np.cross(base, ahead / np.linalg.norm(ahead))])
    step = _WIDTH / max(first.camera.K[0, 0], second.camera.K[0, 0])
    planes = []
    for view in (first, second):
        ever = np.flatnonzero(view.wet.any(axis=0))
        if not len(ever):
            return None
        planes.append((_planes(view.camera, axes, step)[ever], view.wet[:, ever]))
    lowest = max(int(number.min()) for number, _ in planes)
    highest = min(int(number.max()) for number, _ in planes)
    if highest < lowest:
        return None
    seen = []
    for number, wet in planes:
        common = (number >= lowest) & (number <= highest)
        sums = np.zeros((highest - lowest + 1, len(wet)))
        np.add.at(sums, number[common] - lowest, wet[:, common].T)
        # Its root, as thick liquid would drown out what is thin otherwise.
        seen.append(np.sqrt(sums.T))
    return seen[0], seen[1]


def _planes(camera: Camera, axes: NDArray[np.float64], step: float) -> NDArray[np.intp]:
    """The number of the plane that each pixel's line of sight lies in: [h * w]."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)], axis=1)
    rays = pixels @ np.linalg.inv(camera.K).T @ camera.w2c[:3, :3]
    return np.floor(np.arctan2(rays @ axes[1], rays @ axes[0]) / step).astype(np.intp)


def _solved(lags: Mapping[tuple[str, str], Lag]) -> dict[str, float]:
    """The offsets that explain `lags` best, of cameras about which enough of these agree."""
    lags = dict(lags)
    while lags:
        offsets = _explained(lags)
        astray = {pair: abs(offsets[pair[1]] - offsets[pair[0]] - lag.timesteps) for pair, lag in lags.items()}
        worst = max(astray, key=lambda pair: astray[pair])
        if astray[worst] > _ASTRAY:
            del lags[worst]
            continue
        weak = {name for name in offsets if sum(name in pair for pair in lags) < _LEAST_PAIRS}
        if not weak:
            return offsets if len(offsets) >= _LEAST_CAMERAS else {}
        lags = {pair: lag for pair, lag in lags.items() if not weak & set(pair)}
    return {}


def _explained(lags: Mapping[tuple[str, str], Lag]) -> dict[str, float]:
    """Offsets by the least sum of absolute errors, by reweighting; clear pairs count more."""
    names = sorted({name for pair in lags for name in pair})
    design = np.array([[(name == b) - (name == a) for name in names] for a, b in lags], dtype=np.float64)
    wanted = np.array([lag.timesteps for lag in lags.values()])
    trust = np.array([min(lag.clarity, 1.0) for lag in lags.values()])
    weight = trust.copy()
    solution = np.zeros(len(names))
    for _ in range(30):
        root = np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq(design * root, wanted * root[:, 0], rcond=None)[0]
        weight = trust / np.maximum(np.abs(design @ solution - wanted), 0.02)
    return dict(zip(names, (float(value) for value in solution)))

"""The speed of a falling jet from its shape: liquid in the air falls freely. Where nobody told how strong gravity is,
its ends tell both (falls.py).

The hull's surface says little of how fast a steady stream runs through it: nothing visible moves. Its shape does. In
free fall the path of a steady jet bends by g / (2 v_h^2), and its level cross-section thins as 1 / vertical speed. Its
first drop and its last fall as any stone does. One vertical speed w at one height explains all of these. It is found by
trying speeds, the horizontal motion following linearly. Where a jet breaks into beads, what is thick in one frame is
thick in the next where it has fallen to, which tells the speed to a few per cent. Not in the paper, which fits all
motion by level sets.

Coordinates are upright (vessel.py): horizontal two, then height. Scene units and seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from splashbench.scene.camera import Camera

from .falls import MOST, SLICES_AT_LEAST, Ends, FreeFall, Unscaled

STANDARD_GRAVITY = 9.81  # m/s^2
# What the cues are worth: standard deviations of a slice's middle (voxels), of the logarithm of its area, and of its
# radius (voxels).
_MIDDLE, _AREA, _RADIUS = 0.1, 0.2, 0.5
# Neighbouring slices err alike: so many of them count as one.
_ALIKE = 4
# Slices are no jet's where their middles lie off its axis by this many voxels, or the logarithm of what passes through
# them differs by so much, in the median.
_ASTRAY, _UNEVEN = 0.5, 0.3
# A body of liquid is so many times as wide, in area, as the stream above it.
_BODY = 4.0
# A jet is taken as steady over so many frames.
_STEADY = 3
# Above its top a jet is no slower than this share of its speed there.
_SLOWEST = 0.2
# Beads tell a speed where thickness agrees between frames by so much more (correlation) than at most speeds. Two smooth
# jets agree by .05 more at the most, four beaded ones by .38 to .69.
_BEADED = 0.2
# And by so many standard deviations of what chance has.
_CHANCE = 4.0
# Of what is seen in a frame, this share was seen in the one before.
_SEEN = 0.4
# Beads that follow each other closely agree at other speeds, too. Looked at are those within this factor of the one
# that explains the jet's shape.
_ALIKE_BEADS = 2.0
# Of the speed at which beads agree, shares that are tried about it, as speeds are tried coarsely.
_FINER = np.linspace(0.93, 1.07, 29)
# Speeds tried, up to so many times that of a fall through all that is seen.
_SPEEDS, _FASTEST = 80, 4.0
# Where gravity is not known: shares of the speed at which the agreement of beads is as usual.
_USUAL = np.geomspace(0.5, 2, 19)


@dataclass(frozen=True)
class Slices:
    """The airborne part of one frame's hull, cut by height.

    height: [n] of the slices, scene units, ascending. middle: [n, 2]. area: [n], square scene units.
    """

    height: np.ndarray
    middle: np.ndarray
    area: np.ndarray

    def above(self, floor: float) -> Slices:
        """The slices higher than `floor`."""
        high = self.height > floor
        return Slices(self.height[high], self.middle[high], self.area[high])


def slices_of(points: np.ndarray, filled: np.ndarray, voxel: float) -> Slices:
    """Cut a hull into slices one voxel thick, at the same heights in every frame.

    points: [N, 3] nodes of a grid, upright, `voxel` apart. filled: [N] share of each node's voxel within the hull.
    """
    if len(points) == 0:
        return Slices(np.zeros(0), np.zeros((0, 2)), np.zeros(0))
    number = np.floor(points[:, 2] / voxel).astype(np.int64)
    lowest = int(number.min())
    count = np.bincount(number - lowest, filled)
    used = np.nonzero(count > 0.5)[0]
    middle = np.stack([np.bincount(number - lowest, filled * points[:, a])[used] / count[used] for a in (0, 1)], axis=1)
    return Slices((lowest + used + 0.5) * voxel, middle, count[used] * voxel**2)


def open_floor(frames: Sequence[Slices], voxel: float) -> float:
    """Height above which the liquid is a stream and no body, where no container tells: scene units, inf for none.

    Going down from the top, the stream ends where the usual cross-section is several times what it was above.
    """
    usual = _merged(list(frames), voxel)
    for n in range(len(usual.height) - SLICES_AT_LEAST, -1, -1):
        if usual.area[n] > _BODY * np.median(usual.area[n + 1 :]):
            return float(usual.height[n] + 2 * voxel)
    return float(usual.height[0]) if len(usual.height) else float("inf")


def framed(slices: Slices, cameras: Sequence[Camera], turn: np.ndarray) -> Slices:
    """The slices that all cameras see whole: the others are cut by the edge of an image, and say too little.

    turn: [3, 3] scene axes to upright ones.
    """
    seen = np.ones(len(slices.height), dtype=bool)
    radius = np.sqrt(slices.area / np.pi)
    for rise in (-1.0, 1.0):
        points = np.concatenate([slices.middle, (slices.height + rise * radius)[:, None]], axis=1) @ turn
        for camera in cameras:
            pixels, depth = camera.project(points)
            reach = 1.5 * radius * camera.K[0, 0] / np.maximum(depth, 1e-9)
            size = np.array([camera.width, camera.height])
            seen &= (depth > 0) & ((pixels > reach[:, None]) & (pixels < size - reach[:, None])).all(axis=1)
    return Slices(slices.height[seen], slices.middle[seen], slices.area[seen])


@dataclass(frozen=True)
class Jet:
    """A steady jet. At height `top` its liquid passes `middle` [2] with velocity (`drift` [2], -`speed`).

    gravity: scene units / s^2. radius: of its cross-section at the top, scene units.
    """

    top: float
    middle: np.ndarray
    drift: np.ndarray
    speed: float
    gravity: float
    radius: float

    def fall_time(self, height: np.ndarray) -> np.ndarray:
        """Seconds from `top` down to `height` (negative above it, as far as the jet can have risen)."""
        return (np.sqrt(np.maximum(self._square(height), (_SLOWEST * self.speed) ** 2)) - self.speed) / self.gravity

    def velocity(self, height: np.ndarray) -> np.ndarray:
        """[..., 3] upright velocity of its liquid at `height` [...]."""
        down = self.speed + self.gravity * self.fall_time(height)
        return np.stack([np.full_like(down, self.drift[0]), np.full_like(down, self.drift[1]), -down], axis=-1)

    def growth(self, height: np.ndarray) -> np.ndarray:
        """[...] how fast the downward speed grows with the depth at `height` [...], 1 / s."""
        down = self.speed + self.gravity * self.fall_time(height)
        return np.where(self._square(height) > (_SLOWEST * self.speed) ** 2, self.gravity / down, 0.0)

    def _square(self, height: np.ndarray) -> np.ndarray:
        """Of the downward speed at `height` [...]; negative where the jet does not rise so high."""
        return np.asarray(self.speed**2 + 2 * self.gravity * (self.top - np.asarray(height)))

    def axis(self, height: np.ndarray) -> np.ndarray:
        """[..., 2] middle of the jet at `height` [...]."""
        return self.middle + self.fall_time(height)[..., None] * self.drift

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance of upright `points` [N, 3] to the jet's side, negative within, scene units (horizontal)."""
        down = self.speed + self.gravity * self.fall_time(points[:, 2])
        radius = self.radius * np.sqrt(self.speed / np.maximum(down, 1e-9))
        return np.linalg.norm(points[:, :2] - self.axis(points[:, 2]), axis=1) - radius


def fit_jets(
    frames: list[Slices],
    times: np.ndarray,
    gravity: float | None,
    voxel: float,
    lowest: Sequence[float] | None = None,
) -> list[Jet | None]:
    """The jet in each frame; None where no frame nearby shows one.

    All frames share the speed at one height; the nozzle may wander, so that its place and the drift are found for
    every few frames. gravity: scene units / s^2; None where it is not known, and has to be told by how the jet's ends
    fall. voxel: scene units. lowest: see `Ends.of`.
    """
    groups = [_merged(frames[start : start + _STEADY], voxel) for start in range(0, len(frames), _STEADY)]
    used = [number for number, group in enumerate(groups) if len(group.height) >= SLICES_AT_LEAST]
    if not used:
        return [None] * len(frames)
    streams = [groups[number] for number in used]
    top = max(float(stream.height[-1]) for stream in streams)
    bottom = min(float(stream.height[0]) for stream in streams)
    ends = Ends.of([frame.height for frame in frames], times, voxel, top, bottom, lowest)
    beads = _Beads.of(frames, times, voxel)
    if gravity is None:
        fall = _unscaled_fall(streams, ends, beads, times, top, bottom, voxel)
    else:
        fall = _fall(streams, ends, beads, top, bottom, gravity, voxel)
    if fall is None:
        return [None] * len(frames)
    _, paths = _explained(streams, fall, voxel)
    path_of_group = {number: path for number, path in zip(used, paths) if path is not None}
    jets: list[Jet | None] = []
    for t in range(len(frames)):
        near = [number for number in path_of_group if abs(number - t // _STEADY) <= 1]
        if near:
            path, radius = path_of_group[min(near, key=lambda number: abs(number - t // _STEADY))]
            jets.append(Jet(top, path[0], path[1], fall.speed, fall.gravity, radius))
        else:
            jets.append(None)
    return jets


def _fall(
    streams: list[Slices], ends: Ends, beads: _Beads, top: float, bottom: float, gravity: float, voxel: float
) -> FreeFall | None:
    """The fall that explains the jet's shape, ends and beads; None where any speed will do."""
    fastest = _FASTEST * np.sqrt(2 * gravity * (top - bottom + voxel))
    falls = [FreeFall(top, float(speed), gravity) for speed in np.geomspace(fastest / 300, fastest, _SPEEDS)]
    costs = [_explained(streams, fall, voxel)[0] + ends.misfit(fall) for fall in falls]
    best = falls[int(np.argmin(costs))]
    near = [fall for fall in falls if abs(np.log(fall.speed / best.speed)) <= np.log(_ALIKE_BEADS)]
    clearest = beads.clearest(near, near)
    if clearest is not None:
        return beads.best([replace(clearest, speed=clearest.speed * factor) for factor in _FINER])
    # At the fastest and the slowest nothing bends, thins or falls.
    return None if best in (falls[0], falls[-1]) else best


def _unscaled_fall(
    streams: list[Slices], ends: Ends, beads: _Beads, times: np.ndarray, top: float, bottom: float, voxel: float
) -> FreeFall | None:
    """`_fall` where gravity is not known; None where the ends do not tell how fast they fall."""
    if not ends.runs:
        return None
    # Those of the speeds that are tried where gravity is known, from the straightest on.
    shapes = np.geomspace(1, 300**2, _SPEEDS) / (2 * _FASTEST**2 * (top - bottom + voxel))
    costs = np.array([_explained(streams, FreeFall(top, 1.0, float(shape)), voxel)[0] for shape in shapes])
    tried = Unscaled.of(shapes, costs, ends, times, top, bottom)
    if not tried.known:
        return None
    best = tried.best()
    clearest = beads.clearest(tried.as_good(), [best.faster(factor) for factor in _USUAL])
    return best if clearest is None else beads.best([clearest.faster(factor) for factor in _FINER])


def _merged(frames: list[Slices], voxel: float) -> Slices:
    """The slices of several frames as one frame's, by their medians."""
    height = np.concatenate([frame.height for frame in frames])
    middle, area = np.concatenate([frame.middle for frame in frames]), np.concatenate([frame.area for frame in frames])
    levels, number = np.unique(np.round(height / voxel, 3), return_inverse=True)
    middles = [np.median(middle[number == n], axis=0) for n in range(len(levels))]
    areas = [np.median(area[number == n]) for n in range(len(levels))]
    return Slices(levels * voxel, np.array(middles).reshape(-1, 2), np.array(areas))


Path = tuple[np.ndarray, float]


def _explained(groups: list[Slices], fall: FreeFall, voxel: float) -> tuple[float, list[Path | None]]:
    """How badly `fall` explains what all groups look like, and each one's path and radius; None for a group whose
    slices are no jet's, but drops at different places, or a lump."""
    cost = 0.0
    paths: list[Path | None] = []
    for group in groups:
        tau = fall.lasted(group.height)
        design = np.stack([np.ones_like(tau), tau], axis=1)
        path = _robust(design, group.middle, _MIDDLE * voxel)
        error = np.linalg.norm(group.middle - design @ path, axis=1) / (_MIDDLE * voxel)
        # Slices are level: what passes through one is its area times the vertical speed.
        thinning = np.log(group.area * fall.down(group.height))
        # A hull's radius is uncertain by a pixel or so, which means more in a thin jet.
        doubt = np.hypot(_AREA, 2 * _RADIUS * voxel / np.sqrt(group.area / np.pi))
        unlike = np.abs(thinning - np.median(thinning))
        spread = unlike / doubt
        cost += float((np.minimum(error**2, MOST) + np.minimum(spread**2, MOST)).sum()) / _ALIKE
        # The volume that passes is one at all heights: it gives the radius at the top.
        area = np.exp(np.median(thinning)) / fall.speed
        steady = np.median(error) * _MIDDLE < _ASTRAY and np.median(unlike) < _UNEVEN
        paths.append((path, float(np.sqrt(area / np.pi))) if steady else None)
    return cost, paths


def _robust(design: np.ndarray, values: np.ndarray, sigma: float) -> np.ndarray:
    """Least squares with outliers weighted down (Cauchy): drops that fly beside the jet."""
    weight = np.ones(len(design))
    for _ in range(8):
        root = np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq(design * root, values * root, rcond=None)[0]
        residual = np.linalg.norm(values - design @ solution, axis=1)
        weight = 1 / (1 + (residual / sigma) ** 2)
    return solution


@dataclass(frozen=True, eq=False)
class _Beads:
    """How thick a jet is at each height in each frame, against what is usual there.

    height: [n], ascending. thickness: [T, n], the area by its mean at that height, less 1; NaN above and below the jet.
    """

    times: np.ndarray
    height: np.ndarray
    thickness: np.ndarray

    @classmethod
    def of(cls, frames: list[Slices], times: np.ndarray, voxel: float) -> _Beads:
        lowest = min((float(frame.height[0]) for frame in frames if len(frame.height)), default=0.0)
        levels = [np.rint((frame.height - lowest) / voxel).astype(int) for frame in frames]
        count = 1 + max((int(level[-1]) for level in levels if len(level)), default=0)
        areas = np.full((len(frames), count), np.nan)
        for area, frame, level in zip(areas, frames, levels):
            if len(level):
                area[level[0] : level[-1] + 1] = 0  # between beads there may be nothing
                area[level] = frame.area
        there = np.isfinite(areas)
        usual = np.where(there, areas, 0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
        with np.errstate(invalid="ignore"):
            thickness = np.where(usual > 0, areas / np.where(usual > 0, usual, 1) - 1, np.nan)
        return cls(times, lowest + voxel * np.arange(count), thickness)

    def clearest(self, falls: list[FreeFall], others: list[FreeFall]) -> FreeFall | None:
        """The one of `falls` by which beads agree, where they do so by far more than by most `others`."""
        agreement, count = np.array([self.agreement(fall) for fall in falls]).T
        usual = agreement if others is falls else np.array([self.agreement(fall)[0] for fall in others])
        if not np.isfinite(agreement).any() or not np.isfinite(usual).any():
            return None
        best = int(np.nanargmax(agreement))
        chance = _CHANCE * np.sqrt(_ALIKE / max(count[best], 1))
        return falls[best] if agreement[best] - np.nanmedian(usual) >= max(_BEADED, chance) else None

    def best(self, falls: list[FreeFall]) -> FreeFall:
        """The one of `falls` by which beads agree most."""
        return falls[int(np.argmax(np.nan_to_num([self.agreement(fall)[0] for fall in falls])))]

    def agreement(self, fall: FreeFall) -> tuple[float, int]:
        """Correlation of each frame's thickness with that of the frame before where it fell from by `fall`, NaN where
        hardly any of it was seen then; and of how many slices."""
        fallen = -fall.lasted(self.height)  # rises with the height
        together = first = second = 0.0
        looked, seen = 0, 0
        for t in range(len(self.times) - 1):
            now, then = self.thickness[t + 1], self.thickness[t]
            wet, was = np.isfinite(now), np.isfinite(then)
            if min(wet.sum(), was.sum()) < SLICES_AT_LEAST:
                continue
            from_where = fallen[wet] + (self.times[t + 1] - self.times[t])
            expected = np.interp(from_where, fallen[was], then[was], left=np.nan, right=np.nan)
            known = np.isfinite(expected)
            looked, seen = looked + len(known), seen + int(known.sum())
            together += float(expected[known] @ now[wet][known])
            first += float(expected[known] @ expected[known])
            second += float(now[wet][known] @ now[wet][known])
        return together / max(float(np.sqrt(first * second)), 1e-12) if seen > _SEEN * looked else np.nan, seen

"""How far the training cameras' clocks are apart, by droplets that fly: told from masks, to a hundredth of a timestep.

A droplet and the line between two cameras span a plane, and both cameras have to see the droplet in the same plane at
the same time (the epipolar constraint). So a droplet that crosses planes tells when one camera saw it where the other
did. Nobody knows which droplet is which: every two that fly alike in both views have a vote, and those that are the
same agree, while all others scatter (a Hough transform over the offset).

Where it is known roughly how far clocks are apart (thickness.py), droplets are asked for the rest. Cameras of which
they do not tell keep what is known roughly.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from splashbench.scene import Camera

from .exposure import standard_of

# All in pixels of an image of 240, which are scaled to the image at hand: a droplet's area at most, how far it flies in
# a timestep, at most and at least, and how far from falling freely its path may be.
_LARGEST, _FASTEST, _SLOWEST, _OFF_PATH = 60.0, 45.0, 2.0, 1.0
# How fast droplets fall at the most, in pixels for each timestep squared; the scale is not known, so that the clearest
# of these is taken.
_FALLS = (2.0, 5.0, 12.0, 30.0)
# Where there is liquid in more than this share of the masks, or this many pixels beside, there is a stream.
_OFTEN, _BESIDE = 0.35, 1.5
# Two droplets fly alike where their speeds across planes differ by less, and their accelerations.
_ALIKE, _ALIKE_FALL = 0.5, 0.8
#: Offsets that are looked for, in timesteps, either way; and about offsets that are known roughly.
REACH, NEAR_REACH = 2.5, 1.0
# Width of a bin and of the smoothing, in timesteps.
_BIN, _SMOOTH = 0.01, 0.02
# Votes at the peak below which nothing is known, how many times as high it has to be as the votes beside it, and as the
# votes for the clock as it is told.
_LEAST, _ABOVE, _CLEARER = 9.0, 3.0, 1.5
# Votes, as a share of the most that any offset has, with which one nearer to the clock as told is taken.
_NEARLY = 0.5
# How much clearer offsets have to be that do not start from the clocks as told.
_MUCH_CLEARER = 1.3
# Cameras that have to agree, for one to be off.
_LEAST_CAMERAS = 3
# Offsets below are no offsets, in timesteps; and offsets that are known roughly.
_SAME, _ROUGHLY_SAME = 0.03, 0.35
# Of one mask, the largest droplets that are looked at at most; and flights through one frame of a view, those first
# that are mistaken for the fewest others. Flights take the cube of droplets, and votes the square of flights.
_MOST_DROPLETS, _MOST_FLIGHTS = 80, 400
# Part of a timestep within which two views' flights meet, or are none of each other.
_NEAR = 0.52


@dataclass(frozen=True)
class Offset:
    """Of one camera's clock. timesteps: by how much later than told it takes its photographs. votes: of droplets for
    it, beside how many for the clock as told and how many for any other offset, on average; none where they do not
    tell."""

    timesteps: float
    votes: float = 0.0
    votes_as_told: float = 0.0
    votes_elsewhere: float = 0.0


@dataclass(frozen=True)
class _Flights:
    """Droplets of one view that were seen in three frames in a row. frame: int [N], the middle one. places: float64
    [N, 3, 2], pixels. alike: int [N], how many flights the same droplet in the middle may be on."""

    frame: NDArray[np.intp]
    places: NDArray[np.float64]
    alike: NDArray[np.intp]


def clock_offsets(
    droplets: Mapping[str, Sequence[NDArray[np.float64]]],
    cameras: Mapping[str, Camera],
    down: NDArray[np.float64],
    roughly: Mapping[str, float] | None = None,
) -> dict[str, Offset]:
    """The offset of each camera, by its `droplets_of` of all frames; cameras that nothing is known of have none.

    down: the direction of gravity, roughly, a unit vector [3]. roughly: `rough_offsets` of the cameras that have one.
    """
    roughly = roughly or {}
    known = bool(roughly)
    middle = _middle(roughly)
    # Whole timesteps are taken out beforehand.
    whole = {name: round(roughly[name] - middle) if name in roughly else 0 for name in droplets}
    shifted = {name: _shifted(drops, whole[name]) for name, drops in droplets.items()}
    rest = {name: value - middle - whole[name] for name, value in roughly.items()}
    found = _by_droplets(shifted, cameras, down, NEAR_REACH if known else REACH)
    if known:
        # What droplets say of a camera otherwise than all liquid does is a mistake.
        between = {name: offset.timesteps - rest[name] for name, offset in found.items() if name in rest}
        gauge = float(np.median(list(between.values()))) if between else 0.0
        found = {
            name: offset for name, offset in found.items() if abs(between.get(name, gauge) - gauge) <= _ROUGHLY_SAME
        }
        found = {**{name: Offset(value + gauge) for name, value in rest.items()}, **found}
    offsets = {name: replace(offset, timesteps=offset.timesteps + whole[name]) for name, offset in found.items()}
    if len(offsets) < _LEAST_CAMERAS:
        return {}
    middle = _middle({name: offset.timesteps for name, offset in offsets.items()})
    # Of the cameras on that clock droplets know better when it is.
    exact = [offset.timesteps for offset in offsets.values() if offset.votes]
    exact = [value for value in exact if abs(value - middle) <= _ROUGHLY_SAME]
    middle = standard_of(np.array(exact)) if exact else middle
    moved = {name: replace(offset, timesteps=offset.timesteps - middle) for name, offset in offsets.items()}
    return {
        name: offset
        for name, offset in moved.items()
        if abs(offset.timesteps) > (_SAME if offset.votes else _ROUGHLY_SAME)
    }


def _middle(offsets: Mapping[str, float]) -> float:
    return standard_of(np.array(list(offsets.values()))) if offsets else 0.0


def _shifted(drops: Sequence[NDArray[np.float64]], later: int) -> list[NDArray[np.float64]]:
    """Droplets of all frames of a camera that takes each of them `later` timesteps later than told, by when it does."""
    nothing = np.zeros((0, 2))
    return [drops[t - later] if 0 <= t - later < len(drops) else nothing for t in range(len(drops))]


def _by_droplets(
    droplets: Mapping[str, Sequence[NDArray[np.float64]]],
    cameras: Mapping[str, Camera],
    down: NDArray[np.float64],
    reach: float,
) -> dict[str, Offset]:
    """The offsets, no more than `reach`, of the cameras of which droplets tell. All may be off by as much together."""
    views = tuple(droplets)
    scale = {name: _scale(cameras[name]) for name in views}
    best: _Election | None = None
    for fall in _FALLS:
        flights = {name: _flights(droplets[name], cameras[name], down, fall, scale[name]) for name in views}
        votes = {
            (a, b): _votes(cameras[a], cameras[b], flights[a], flights[b], max(scale[a], scale[b]), reach)
            for a, b in combinations(views, 2)
        }
        election = _Election(views, votes, reach)
        best = election if best is None or election.clarity > best.clarity else best
    assert best is not None
    return best.result()


class _Election:
    """What droplets that fall at most so fast say. votes: of each two views. clarity: how much clearer than chance."""

    def __init__(
        self, views: tuple[str, ...], votes: Mapping[tuple[str, str], NDArray[np.float64]], reach: float
    ) -> None:
        self.views, self.votes, self.reach = views, votes, reach
        told = dict.fromkeys(views, 0.0)
        # Told clocks may be right but for one, or not right at all: from both the best is looked for.
        self.offsets, linked = self._improved(told), self._improved(self._linked())
        self.clarity, other = self._agreement(self.offsets), self._agreement(linked)
        if other > _MUCH_CLEARER * self.clarity:
            self.offsets, self.clarity = linked, other

    def _linked(self) -> dict[str, float]:
        """Offsets along the clearest pairs that join all views."""
        peaks = {pair: _peak(found, self.reach) for pair, found in self.votes.items()}
        offsets = {self.views[0]: 0.0}
        while len(offsets) < len(self.views):
            ways = [pair for pair in peaks if (pair[0] in offsets) != (pair[1] in offsets)]
            a, b = max(ways, key=lambda pair: _clarity(peaks[pair]))
            if a in offsets:
                offsets[b] = offsets[a] + peaks[a, b].timesteps
            else:
                offsets[a] = offsets[b] - peaks[a, b].timesteps
        return {name: offsets[name] for name in self.views}

    def _improved(self, offsets: Mapping[str, float]) -> dict[str, float]:
        """`offsets`, one after the other moved to where most votes are, the clearest gain first."""
        offsets = dict(offsets)
        for _ in range(2 * len(self.views)):
            gains = {}
            for name in self.views:
                found = _peak(self._of(name, offsets), self.reach)
                if abs(found.timesteps) > _SAME and _is_clear(found):
                    gains[name] = found
            if not gains:
                break
            best = max(gains, key=lambda name: gains[name].votes - gains[name].votes_as_told)
            offsets[best] += gains[best].timesteps
        for name in self.views:
            offsets[name] += _peak(self._of(name, offsets), reach=0.1).timesteps if offsets[name] else 0.0
        return offsets

    def _agreement(self, offsets: Mapping[str, float]) -> float:
        """How much clearer than chance the votes for `offsets` are, all cameras together."""
        return sum(_clarity(_peak(self._of(name, offsets), reach=_SAME)) for name in self.views)

    def _of(self, name: str, offsets: Mapping[str, float]) -> NDArray[np.float64]:
        """All votes for what camera `name` is off by beyond `offsets`, with what they count."""
        mine = []
        for (a, b), found in self.votes.items():
            if name in (a, b):
                beyond = found[:, 0] - offsets[b] + offsets[a]
                mine.append(np.stack([beyond if b == name else -beyond, found[:, 1]], axis=1))
        return np.concatenate(mine)

    def result(self) -> dict[str, Offset]:
        """The offsets of the cameras whose droplets agree."""
        clear = {}
        for name in self.views:
            now = _peak(self._of(name, self.offsets), reach=_SAME)
            told = _peak(self._of(name, {**self.offsets, name: 0.0}), reach=_SAME).votes
            found = Offset(self.offsets[name], now.votes, told, now.votes_elsewhere)
            if _is_clear(found, compared=abs(self.offsets[name]) > _SAME):
                clear[name] = found
        return clear if len(clear) >= _LEAST_CAMERAS else {}


def _flights(
    drops: Sequence[NDArray[np.float64]], camera: Camera, down: NDArray[np.float64], most: float, scale: float
) -> _Flights:
    # Where the image has what falls in the world; as in the middle of the image everywhere.
    fall = (camera.w2c[:3, :3] @ down)[:2]
    length = max(float(np.linalg.norm(fall)), 1e-6)
    frames, places, alike = [], [], []
    for t in range(1, len(drops) - 1):
        before, now, after = drops[t - 1], drops[t], drops[t + 1]
        if not (len(before) and len(now) and len(after)):
            continue
        first, second = np.nonzero(_flown(before, now, scale))
        bend = after[None] - (2 * now[second] - before[first])[:, None]
        fallen = np.clip(bend @ fall / length, -0.5 * scale, most * scale)
        astray = np.linalg.norm(bend - fallen[..., None] * fall / length, axis=-1)
        which, third = np.nonzero((astray < _OFF_PATH * scale) & _flown(now, after, scale)[second])
        others = np.bincount(second[which], minlength=len(now))[second[which]]
        if len(which) > _MOST_FLIGHTS:
            kept = np.sort(np.argsort(others, kind="stable")[:_MOST_FLIGHTS])
            which, third, others = which[kept], third[kept], others[kept]
        frames.append(np.full(len(which), t))
        places.append(np.stack([before[first[which]], now[second[which]], after[third]], axis=1))
        alike.append(others)
    if not frames:
        return _Flights(np.zeros(0, np.intp), np.zeros((0, 3, 2)), np.zeros(0, np.intp))
    return _Flights(np.concatenate(frames), np.concatenate(places), np.concatenate(alike))


def _flown(first: NDArray[np.float64], second: NDArray[np.float64], scale: float) -> NDArray[np.bool_]:
    """Which of `first` [n, 2] may be which of `second` [m, 2] a timestep later: bool [n, m]."""
    away = np.linalg.norm(second[None] - first[:, None], axis=-1)
    return (away > _SLOWEST * scale) & (away < _FASTEST * scale)


def _scale(camera: Camera) -> float:
    """How many times as large as 240 pixels an image is."""
    return max(camera.width, camera.height) / 240


def droplets_of(masks: Iterable[NDArray[np.bool_]], camera: Camera) -> list[NDArray[np.float64]]:
    """Of each liquid mask [H, W] of a camera the middles [n, 2] of the parts that are small and whole, in pixels.

    Parts where there is liquid in many masks are left out: the beads of a stream look alike, and seem to go backwards
    like the spokes of a wheel.
    """
    scale = _scale(camera)
    found, often = [], np.zeros((camera.height, camera.width), dtype=np.int32)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(_BESIDE * scale) + 1,) * 2)
    for mask in masks:
        image = mask.astype(np.uint8)
        _, _, stats, middles = cv2.connectedComponentsWithStats(image, connectivity=8)
        left, top, width, height, area = stats.T
        whole = (left > 0) & (top > 0) & (left + width < mask.shape[1]) & (top + height < mask.shape[0])
        small = whole & (area <= _LARGEST * scale**2)
        small[0] = False  # what is not liquid
        if small.sum() > _MOST_DROPLETS:
            largest = np.argsort(np.where(small, -area, 1), kind="stable")[:_MOST_DROPLETS]
            small = np.zeros_like(small)
            small[largest] = True
        found.append(np.asarray(middles[small] + 0.5))
        often += cv2.dilate(image, disc)
    most = max(2.0, _OFTEN * len(found))
    return [drops[often[drops[:, 1].astype(int), drops[:, 0].astype(int)] <= most] for drops in found]


def _votes(
    first: Camera, second: Camera, of_first: _Flights, of_second: _Flights, scale: float, most: float
) -> NDArray[np.float64]:
    """By how many timesteps later than `first` told `second` saw what may be the same droplet, and how much
    that counts: float64 [n, 2]. most: timesteps that are looked at."""
    base = second.center - first.center
    if not len(of_first.frame) or not len(of_second.frame) or np.linalg.norm(base) < 1e-9:
        return np.zeros((0, 2))
    base = base / np.linalg.norm(base)
    ahead = first.w2c[2, :3] + second.w2c[2, :3]
    ahead = ahead - base * (ahead @ base)
    if np.linalg.norm(ahead) < 1e-6:
        return np.zeros((0, 2))  # one looks at the other: every plane is seen edge on
    axes = np.stack([ahead / np.linalg.norm(ahead), np.cross(base, ahead / np.linalg.norm(ahead))])
    here = _plane(first, of_first.places, axes)
    there = _plane(second, of_second.places, axes)
    found = []
    reach = int(most) + 1
    for t in np.unique(of_first.frame):
        mine = here[of_first.frame == t]
        place, speed, fall = mine[:, 1], (mine[:, 2] - mine[:, 0]) / 2, mine[:, 2] - 2 * mine[:, 1] + mine[:, 0]
        for n in range(-reach, reach + 1):
            other = there[of_second.frame == t + n]
            if not len(other):
                continue
            other_pace = (other[:, 2] - other[:, 0]) / 2
            other_fall = other[:, 2] - 2 * other[:, 1] + other[:, 0]
            # Most fly otherwise whenever they meet, and are left out before it is asked when.
            rows, columns = np.nonzero(
                (np.abs(other_fall - fall[:, None]) < _ALIKE_FALL * scale)
                & (np.abs(other_pace - speed[:, None]) < (_ALIKE + 1e-6) * scale + _NEAR * np.abs(fall)[:, None])
            )
            distance, began, bent = other[columns, 1] - place[rows], speed[rows], fall[rows]
            after = np.zeros(len(rows))
            for _ in range(4):  # Newton's steps to where the path crosses the plane
                pace = began + bent * after
                pace = np.where(np.abs(pace) < 0.3 * scale, np.copysign(0.3 * scale, pace), pace)
                gone = began * after + 0.5 * bent * after**2
                after = np.clip(after - (gone - distance) / pace, -1, 1)
            pace = began + bent * after
            alike = (
                (np.abs(after) <= _NEAR)
                & (np.abs(pace) > _SLOWEST * scale)
                & (np.abs(other_pace[columns] - pace) < _ALIKE * scale)
            )
            mine_too, others_too = np.flatnonzero(of_first.frame == t), np.flatnonzero(of_second.frame == t + n)
            chosen = after[alike] - n, mine_too[rows[alike]], others_too[columns[alike]]
            found.append(np.stack(chosen, axis=1))
    if not found:
        return np.zeros((0, 2))
    votes = np.concatenate(found)
    # A droplet has one vote, which it shares out: those of a jet look alike, and would outvote all others.
    shares = []
    for column in (1, 2):
        _, which, count = np.unique(votes[:, column], return_inverse=True, return_counts=True)
        flights = (of_first, of_second)[column - 1]
        shares.append(1 / count[which] / flights.alike[votes[:, column].astype(int)])
    return np.stack([votes[:, 0], np.minimum(*shares)], axis=1)


def _plane(camera: Camera, places: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """The angle about the base line of `places` [N, 3, 2], as pixels of `camera`: [N, 3]."""
    rays = np.concatenate([places, np.ones((*places.shape[:2], 1))], axis=-1) @ np.linalg.inv(camera.K).T
    rays = rays @ camera.w2c[:3, :3]
    return np.asarray(np.arctan2(rays @ axes[1], rays @ axes[0]) * camera.K[0, 0])


def _peak(votes: NDArray[np.float64], reach: float = REACH) -> Offset:
    """Where most of `votes` are, within `reach`."""
    edges = np.arange(-round((REACH + 0.2) / _BIN), round((REACH + 0.2) / _BIN) + 2) * _BIN - _BIN / 2
    counts = np.histogram(votes[:, 0], edges, weights=votes[:, 1])[0]
    # Of as many votes as a bin of the smoothing's width holds.
    smooth = gaussian_filter1d(counts, _SMOOTH / _BIN, mode="constant") * (_SMOOTH / _BIN) * np.sqrt(2 * np.pi)
    middles = (edges[:-1] + edges[1:]) / 2
    within = np.abs(middles) <= reach + 1e-9
    # A stream that breaks up regularly looks the same a little later: the smallest of offsets that are nearly as good.
    peaks = np.flatnonzero(within & (smooth >= np.roll(smooth, 1)) & (smooth >= np.roll(smooth, -1)))
    peaks = peaks if len(peaks) else np.flatnonzero(within)
    peaks = peaks[smooth[peaks] >= _NEARLY * smooth[peaks].max()]
    best = int(peaks[np.argmin(np.abs(middles[peaks]))])
    place = float(middles[best])
    for _ in range(5):
        near = votes[np.abs(votes[:, 0] - place) < 3 * _SMOOTH]
        place = float(np.average(near[:, 0], weights=near[:, 1])) if len(near) else place
    told = float(smooth[np.abs(middles) <= _SAME].max())
    return Offset(place, float(smooth[best]), told, float(np.median(smooth[np.abs(middles) <= REACH])))


def _clarity(found: Offset) -> float:
    """By how many standard deviations the votes are more than chance would have."""
    return (found.votes - found.votes_elsewhere) / np.sqrt(found.votes_elsewhere + 1)


def _is_clear(found: Offset, compared: bool = True) -> bool:
    """compared: whether it has to be clearer than the clock as told, too."""
    beside = max(found.votes_elsewhere, 0.5)
    enough = found.votes >= _LEAST and found.votes >= _ABOVE * beside
    return enough and not (compared and found.votes - beside < _CLEARER * max(found.votes_as_told - beside, 0.0))

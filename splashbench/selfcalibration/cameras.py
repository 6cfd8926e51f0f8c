"""Where the training cameras stood and how they saw, by what they show in common: a bundle adjustment.

Points alone do not say whether all cameras turned or the world did. So it is asked in turn whether cameras that were
turned explain the points, or lenses that bend, or other focal lengths, principal points or places, or several of these;
the first answer that is as good as any is taken, and what is left open changes the least (an L1 norm over cameras, by
iterated reweighting). Test cameras are not looked at, and stay.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from splashbench.scene import Camera

from .features import Tracks
from .landmarks import Landmarks
from .stacked import StackedCameras

# Points below which cameras are left as told: of all, and in each view that is changed.
_LEAST_POINTS, _LEAST_OF_A_VIEW = 60, 15
# Points that have a say, at the most, and others that tell whether they are better explained.
_MOST_POINTS = 300
# Reprojection errors beyond this many times their median count for little.
_OUTLIER = 3.0
# Typical reprojection errors of the best matches there are, in pixels of an image of 240.
_FINEST = 0.05
# Changes of a camera below so many pixels cost as their square, above as their size.
_SMALL = 0.05
# Rounds of reweighting, and with landmarks, whose planes are looked up anew in each; evaluations in each; the step of
# derivatives in pixels; and sights of points that are computed at once for these, which bounds the memory.
_ROUNDS, _ROUNDS_HELD, _STEPS, _STEP, _AT_ONCE = 4, 8, 8, 1e-4, 500_000
# Cameras stay as told where they change by no more than this share of what the most changed one does.
_STAYS = 0.25
# What changes cost, against the points' errors; and where landmarks leave less open.
_PRIOR, _PRIOR_HELD = 0.1, 0.01
# Landmarks that typical points are further beside are none of this place, in pixels of an image of 240.
_ELSEWHERE = 2.0
# Cameras are right where a typical point is off by less, in pixels of an image of 240; and they are changed only where
# points that had no say in it are off by this share at most, afterwards.
_RIGHT, _BETTER = 0.12, 0.7
# An answer is as good as the best where points are off by no more than this times as much, and this many pixels.
_AS_GOOD, _AS_GOOD_PIXELS = 1.1, 0.006


@dataclass(frozen=True)
class CameraCorrection:
    """What was found of one camera: how far it is turned (degrees) and away (scene units), by how much its focal length
    is longer (a share), and how far its principal point is away (pixels)."""

    turned: float
    moved: float
    longer: float
    shifted: float


@dataclass(frozen=True)
class FittedCameras:
    """cameras: by name, as fitted. distortion: k1 of all views (OpenCV's model), 0 where there is none. kinds: what was
    changed. before, after: the `typical_error` in pixels of points that had no say in the fit. points: how many views
    have in common."""

    cameras: Mapping[str, Camera]
    distortion: float
    kinds: tuple[str, ...]
    before: float
    after: float
    points: int


def reprojection(tracks: Tracks, cameras: Mapping[str, Camera], k1: float = 0.0) -> NDArray[np.float64]:
    """Reprojection errors [N, V, 2] in pixels of the points of `tracks`, each placed where the rays of its views meet
    best; NaN where a view shows none."""
    stack = StackedCameras.of(cameras, tracks.views, k1)
    return stack.errors(tracks, stack.placed(tracks))


# Of each camera: turn (3), move (3), focal length (1), principal point (2); and k1 of all.
_OF_A_CAMERA = 9
_PARTS = {
    "turned": np.arange(0, 3),
    "moved": np.arange(3, 6),
    "longer": np.arange(6, 7),
    "shifted": np.arange(7, 9),
}
#: What is asked in turn, the simplest first.
_ANSWERS: tuple[tuple[str, ...], ...] = (
    ("turned",),
    ("bent",),
    ("longer",),
    ("shifted",),
    ("moved",),
    ("turned", "bent"),
    ("turned", "longer"),
    ("turned", "moved"),
    ("turned", "moved", "longer", "shifted", "bent"),
)


class _Problem:
    """The unknowns, each in pixels at the image, and what they make of the cameras as told."""

    def __init__(self, tracks: Tracks, told: Mapping[str, Camera]) -> None:
        self.tracks, self.told = tracks, told
        self.count = _OF_A_CAMERA * len(tracks.views) + 1
        self._stacked = StackedCameras.of(told, tracks.views)
        self._depth = _depths(self._stacked)
        self._half = np.array([[0.5 * max(told[name].width, told[name].height)] for name in tracks.views])

    def with_tracks(self, tracks: Tracks) -> _Problem:
        """The same unknowns, of other tracks of the same views."""
        other = copy(self)
        other.tracks = tracks
        return other

    def stack(self, values: NDArray[np.float64]) -> StackedCameras:
        """What `values` [..., count] make of the cameras."""
        of_cameras = values[..., :-1].reshape(*values.shape[:-1], len(self.tracks.views), _OF_A_CAMERA)
        turn, move, focal, point = np.split(of_cameras, (3, 6, 7), axis=-1)
        told, pixel = self._stacked, 1 / self._stacked.K[:, 0, 0]
        K = np.broadcast_to(told.K, (*of_cameras.shape[:-1], 3, 3)).copy()
        # Never below 0, wherever the search goes.
        K[..., [0, 1], [0, 1]] *= np.exp(np.clip(focal / self._half, -1, 1))
        K[..., :2, 2] += point
        turned = Rotation.from_rotvec((turn * pixel[:, None]).reshape(-1, 3)).as_matrix()
        R = turned.reshape(*turn.shape[:-1], 3, 3) @ told.R
        centers = told.centers + move * (self._depth * pixel)[:, None]
        return StackedCameras(K, R, centers, values[..., -1] * self._bend)

    def cameras(self, values: NDArray[np.float64]) -> tuple[dict[str, Camera], float]:
        """The cameras, and k1 of all, that `values` [count] make."""
        stack, found = self.stack(values), {}
        for number, name in enumerate(self.tracks.views):
            w2c = self.told[name].w2c.copy()
            w2c[:3, :3], w2c[:3, 3] = stack.R[number], -stack.R[number] @ stack.centers[number]
            found[name] = replace(self.told[name], K=stack.K[number], w2c=w2c)
        return found, float(stack.k1)

    def pixels_per_unit(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """How many pixels a scene unit at `points` [N, 3] is in the views that show them, on average, [N]."""
        far = np.linalg.norm(points[:, None] - self._stacked.centers, axis=-1)
        pixels, seen = self._stacked.K[:, 0, 0] / np.maximum(far, 1e-9), self.tracks.seen
        return np.asarray((pixels * seen).sum(axis=1) / np.maximum(seen.sum(axis=1), 1))

    @property
    def _bend(self) -> float:
        """k1 that bends a corner by about a pixel."""
        camera = self.told[self.tracks.views[0]]
        radius = 0.5 * max(camera.width, camera.height) / camera.K[0, 0]
        return float(1 / (camera.K[0, 0] * radius**3))

    def groups(self, kinds: Collection[str]) -> list[NDArray[np.intp]]:
        """The unknowns of `kinds` that change together, of each camera; "bent" is that of all."""
        views = range(len(self.tracks.views))
        found = [_OF_A_CAMERA * number + part for kind, part in _PARTS.items() if kind in kinds for number in views]
        return found + ([np.array([self.count - 1])] if "bent" in kinds else [])


def _depths(cameras: StackedCameras) -> NDArray[np.float64]:
    """How far what the views look at is from each [V], about: where the middle rays meet."""
    axes = cameras.R[:, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle = np.linalg.lstsq(across.sum(axis=0), np.einsum("vij,vj->i", across, cameras.centers), rcond=None)[0]
    return np.maximum(np.linalg.norm(middle - cameras.centers, axis=1), 1e-6)


def typical_error(tracks: Tracks, cameras: Mapping[str, Camera], k1: float = 0.0) -> float:
    """Median reprojection error in pixels, of the view where it is the largest; NaN where no view shows enough."""
    lengths = np.linalg.norm(reprojection(tracks, cameras, k1), axis=-1)
    medians = [np.median(view[known]) for view in lengths.T if (known := np.isfinite(view)).sum() >= _LEAST_OF_A_VIEW]
    return float(max(medians, default=np.nan))


def _selected(tracks: Tracks) -> Tracks:
    """Those that say the most, which many views show, and some of each view at least."""
    order = np.argsort(-tracks.seen.sum(axis=1), kind="stable")
    of_each = [order[tracks.seen[order, number]][: 4 * _LEAST_OF_A_VIEW] for number in range(len(tracks.views))]
    return tracks.kept(np.unique(np.concatenate([order[: 2 * _MOST_POINTS], *of_each])))


def fit_cameras(
    tracks: Tracks,
    told: Mapping[str, Camera],
    sparse_points: Callable[[], NDArray[np.floating] | None] = lambda: None,
    again: Callable[[Mapping[str, Camera]], Tracks] | None = None,
) -> FittedCameras | None:
    """The cameras that explain `tracks`, or None where there are too few points, or where cameras are right as told.

    Every other point has no say, and tells whether the others are better explained for it. sparse_points: gives those
    of the still surroundings, [N, 3 or more]: they say where the world is (landmarks.py) where no cameras do that stay
    as told. again: finds the tracks that given cameras allow. Cameras that were told wrong hide some; once it is known
    how they are wrong, all points have a say.
    """
    if len(tracks) < 2 * _LEAST_POINTS:
        return None
    scale = max(max(camera.width, camera.height) for camera in told.values()) / 240
    chosen = _selected(tracks)
    heard, asked = (chosen.kept(np.arange(first, len(chosen), 2)) for first in (0, 1))
    before = typical_error(asked, told)
    if not np.isfinite(before) or before < _RIGHT * scale:
        return None
    problem = _Problem(heard, told)
    answers: list[tuple[float, NDArray[np.float64], tuple[str, ...]]] = []
    for kinds in _ANSWERS:
        values = _fitted(problem, problem.groups(kinds), scale)
        error = typical_error(asked, *problem.cameras(values))
        answers.append((float(np.nan_to_num(error, nan=np.inf)), values, kinds))
    as_good = _AS_GOOD * min(answer[0] for answer in answers) + _AS_GOOD_PIXELS * scale
    after, values, kinds = next(answer for answer in answers if answer[0] <= as_good)
    if not after < _BETTER * before:
        return None
    whole = problem if again is None else problem.with_tracks(again(problem.cameras(values)[0]))
    if len(whole.tracks) >= 2 * _LEAST_POINTS:
        for landmarks in (None if _some_stay(problem, values) else Landmarks.of(sparse_points()), None):
            finer = _fitted(whole, whole.groups(kinds), scale, values, landmarks)
            # Landmarks that points are beside are of another place, or in another frame.
            if landmarks is None or _typically_off(whole, landmarks, finer) < _ELSEWHERE * scale:
                break
        if typical_error(asked, *problem.cameras(finer)) <= as_good:
            values = finer
    cameras, k1 = problem.cameras(values)
    few = [name for number, name in enumerate(tracks.views) if heard.seen[:, number].sum() < _LEAST_OF_A_VIEW]
    return FittedCameras(cameras | {name: told[name] for name in few}, k1, kinds, before, after, len(tracks))


def _some_stay(problem: _Problem, values: NDArray[np.float64]) -> bool:
    """Whether most cameras are as told by `values`: then these say where the world is. Where all are wrong, changes
    that are the least on the whole leave one or two at most, and none by much."""
    changes = np.linalg.norm(values[:-1].reshape(-1, _OF_A_CAMERA), axis=1)
    return bool(2 * (changes <= _STAYS * changes.max()).sum() > len(changes))


def _beside(
    problem: _Problem, landmarks: Landmarks, points: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.float64], float]:
    """The planes of `landmarks` that `points` [N, 3] belong to [N], how many pixels a scene unit is there [N], and how
    many a typical point is beside its plane: infinite where there is none."""
    planes, pixels = landmarks.nearest(points), problem.pixels_per_unit(points)
    off = np.abs(landmarks.off(points, planes) * pixels)[planes >= 0]
    return planes, pixels, float(np.median(off)) if len(off) else np.inf


def _typically_off(problem: _Problem, landmarks: Landmarks, values: NDArray[np.float64]) -> float:
    """How far in pixels a typical point is beside `landmarks`, with the cameras that `values` make."""
    return _beside(problem, landmarks, problem.stack(values).placed(problem.tracks))[2]


def _fitted(
    problem: _Problem,
    groups: list[NDArray[np.intp]],
    scale: float,
    start: NDArray[np.float64] | None = None,
    landmarks: Landmarks | None = None,
) -> NDArray[np.float64]:
    """The unknowns, of which those in `groups` are free; from `start` on, and held by `landmarks`."""
    values, free = np.zeros(problem.count) if start is None else start.copy(), np.concatenate(groups)
    seen = problem.tracks.seen
    for _ in range(_ROUNDS if landmarks is None else _ROUNDS_HELD):
        stack = problem.stack(values)
        points = stack.placed(problem.tracks)
        lengths = np.linalg.norm(stack.errors(problem.tracks, points), axis=-1)[seen]
        spread = max(float(np.median(np.nan_to_num(lengths))), 0.02 * scale)
        bound = _OUTLIER * spread
        prior = np.zeros(problem.count)
        for group in groups:
            # The larger a change is, the less a pixel of it costs: a sum of sizes.
            prior[group] = min(spread, _FINEST * scale) / np.sqrt(np.linalg.norm(values[group]) / scale + _SMALL)
        prior *= np.sqrt((_PRIOR if landmarks is None else _PRIOR_HELD) * seen.sum() / len(groups))
        prior[-1] = 0.0  # a bend of all lenses leaves nothing open

        held = None if landmarks is None else _Held.by(problem, landmarks, points, spread)
        told = (problem, values, free, bound, prior[free] / scale, held)
        # With derivatives of its own, as releases of SciPy differ in whether evaluations for them count.
        values[free] = least_squares(
            _residual, values[free], _slopes, method="lm", x_scale=1.0, max_nfev=_STEPS, args=told
        ).x
    return values


@dataclass(frozen=True)
class _Held:
    """What landmarks say of points. planes: [N], of `landmarks`. weight: [N], of what a scene unit beside them costs in
    pixels."""

    landmarks: Landmarks
    planes: NDArray[np.intp]
    weight: NDArray[np.float64]

    @classmethod
    def by(cls, problem: _Problem, landmarks: Landmarks, points: NDArray[np.float64], spread: float) -> _Held:
        """What `landmarks` say of `points` [N, 3] that are seen to within `spread` pixels. A typical one counts as much
        as a reprojection error that is typical, as nobody knows how true to surfaces sparse points are."""
        planes, pixels, typical = _beside(problem, landmarks, points)
        return cls(landmarks, planes, np.where(planes >= 0, pixels * spread / max(typical, spread), 0.0))

    def errors(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far `points` [..., N, 3] are beside their planes, as pixels of reprojection count."""
        return self.landmarks.off(points, self.planes) * self.weight


def _residual(
    changed: NDArray[np.float64],
    problem: _Problem,
    values: NDArray[np.float64],
    free: NDArray[np.intp],
    bound: float,
    prior: NDArray[np.float64],
    held: _Held | None,
) -> NDArray[np.float64]:
    """What is left of points, by Cauchy's loss beyond `bound` pixels, what landmarks say of them, likewise, and of the
    `prior` on what was `changed` [..., F]: [..., M]."""
    values = np.broadcast_to(values, (*changed.shape[:-1], len(values))).copy()
    values[..., free] = changed
    stack = problem.stack(values)
    points = stack.placed(problem.tracks)
    parts = [_damped(stack.errors(problem.tracks, points)[..., problem.tracks.seen, :], bound)]
    if held is not None:
        parts.append(_damped(held.errors(points)[..., None], bound))
    flat = [part.reshape(*part.shape[:-2], -1) for part in parts]
    return np.concatenate([*flat, prior * changed], axis=-1)


def _damped(errors: NDArray[np.float64], bound: float) -> NDArray[np.float64]:
    """`errors` [..., N, D], each scaled to the root of its loss."""
    # Rays that never meet, as those of two cameras in one place, say nothing.
    errors = np.nan_to_num(errors, nan=0.0, posinf=0.0, neginf=0.0)
    lengths = np.linalg.norm(errors, axis=-1, keepdims=True)
    return np.asarray(errors * bound * np.sqrt(np.log1p((lengths / bound) ** 2)) / np.maximum(lengths, 1e-12))


def _slopes(changed: NDArray[np.float64], *told: Any) -> NDArray[np.float64]:
    """Derivatives of `_residual`, by forward differences, of many unknowns at once."""
    start, slopes = _residual(changed, *told), []
    tracks = told[0].tracks
    at_once = max(1, _AT_ONCE // max(tracks.seen.size, 1))
    for first in range(0, len(changed), at_once):
        beside = changed + _STEP * np.eye(len(changed))[first : first + at_once]
        slopes.append((_residual(beside, *told) - start) / _STEP)
    return np.ascontiguousarray(np.concatenate(slopes).T)


def corrections(fitted: FittedCameras, told: Mapping[str, Camera]) -> dict[str, CameraCorrection]:
    """What `fitted` says of each camera."""
    found = {}
    for name, camera in fitted.cameras.items():
        before = told[name]
        turn = Rotation.from_matrix(camera.w2c[:3, :3] @ before.w2c[:3, :3].T).magnitude()
        found[name] = CameraCorrection(
            float(np.degrees(turn)),
            float(np.linalg.norm(camera.center - before.center)),
            float(camera.K[0, 0] / before.K[0, 0] - 1),
            float(np.linalg.norm(camera.K[:2, 2] - before.K[:2, 2])),
        )
    return found

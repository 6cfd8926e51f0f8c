"""Where the training cameras stood and how they saw, by what they show in common: a bundle adjustment.

Points alone do not say whether all cameras turned or the world did. So it is asked in turn whether cameras that were
turned explain the points, or lenses that bend, or other focal lengths, principal points or places, or several of these;
the first answer that is as good as any is taken, and what is left open changes the least (an L1 norm over cameras, by
iterated reweighting). Test cameras are not looked at, and stay.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from splashbench.scene import Camera

from .features import Tracks

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
# Rounds of reweighting, evaluations in each, and the step of derivatives in pixels.
_ROUNDS, _STEPS, _STEP = 4, 8, 1e-4
# What changes cost, against the points' errors.
_PRIOR = 0.1
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
    pixels, seen = tracks.pixels, tracks.seen
    centers = np.stack([cameras[name].center for name in tracks.views])
    rays = np.full((*pixels.shape[:2], 3), np.nan)
    for number, name in enumerate(tracks.views):
        camera = cameras[name]
        straight = _straight(camera, pixels[:, number], k1)
        rays[:, number] = straight @ camera.w2c[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    across = np.where(seen[..., None, None], np.eye(3) - rays[..., :, None] * rays[..., None, :], 0)
    right = np.einsum("nvij,vj->ni", across, centers)
    points = np.linalg.solve(across.sum(axis=1) + 1e-12 * np.eye(3), right[..., None])[..., 0]
    errors = np.full(pixels.shape, np.nan)
    for number, name in enumerate(tracks.views):
        errors[:, number] = _seen_at(cameras[name], points, k1) - pixels[:, number]
    return errors


def _straight(camera: Camera, pixels: NDArray[np.float64], k1: float) -> NDArray[np.float64]:
    """Rays [N, 3] of `pixels` in the camera's frame, without the distortion k1."""
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ np.linalg.inv(camera.K).T
    bent = rays[:, :2]
    straight = bent.copy()
    for _ in range(8 if k1 else 0):
        straight = bent / (1 + k1 * (straight**2).sum(axis=1, keepdims=True))
    return np.concatenate([straight, rays[:, 2:]], axis=1)


def _seen_at(camera: Camera, points: NDArray[np.float64], k1: float) -> NDArray[np.float64]:
    """Pixels [N, 2] of `points`, with the distortion k1."""
    local = points @ camera.w2c[:3, :3].T + camera.w2c[:3, 3]
    flat = local[:, :2] / np.where(np.abs(local[:, 2:]) < 1e-9, 1e-9, local[:, 2:])
    flat = flat * (1 + k1 * (flat**2).sum(axis=1, keepdims=True))
    return np.asarray(flat @ camera.K[:2, :2].T + camera.K[:2, 2])


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
        self.depth = _depths(tracks, told)
        self.count = _OF_A_CAMERA * len(tracks.views) + 1

    def cameras(self, values: NDArray[np.float64]) -> tuple[dict[str, Camera], float]:
        found = {}
        for number, name in enumerate(self.tracks.views):
            turn, move, focal, point = np.split(values[_OF_A_CAMERA * number : _OF_A_CAMERA * (number + 1)], (3, 6, 7))
            found[name] = self._changed(self.told[name], self.depth[name], turn, move, float(focal[0]), point)
        return found, float(values[-1]) * self._bend

    @property
    def _bend(self) -> float:
        """k1 that bends a corner by about a pixel."""
        camera = self.told[self.tracks.views[0]]
        radius = 0.5 * max(camera.width, camera.height) / camera.K[0, 0]
        return float(1 / (camera.K[0, 0] * radius**3))

    @staticmethod
    def _changed(
        camera: Camera,
        depth: float,
        turn: NDArray[np.float64],
        move: NDArray[np.float64],
        focal: float,
        point: NDArray[np.float64],
    ) -> Camera:
        pixel = 1 / camera.K[0, 0]
        K = camera.K.copy()
        # Never below 0, wherever the search goes.
        K[[0, 1], [0, 1]] *= np.exp(np.clip(focal / (0.5 * max(camera.width, camera.height)), -1, 1))
        K[:2, 2] += point
        w2c = camera.w2c.copy()
        w2c[:3, :3] = Rotation.from_rotvec(turn * pixel).as_matrix() @ camera.w2c[:3, :3]
        w2c[:3, 3] = -w2c[:3, :3] @ (camera.center + move * depth * pixel)
        return replace(camera, K=K, w2c=w2c)

    def groups(self, kinds: Collection[str]) -> list[NDArray[np.intp]]:
        """The unknowns of `kinds` that change together, of each camera; "bent" is that of all."""
        views = range(len(self.tracks.views))
        found = [_OF_A_CAMERA * number + part for kind, part in _PARTS.items() if kind in kinds for number in views]
        return found + ([np.array([self.count - 1])] if "bent" in kinds else [])


def _depths(tracks: Tracks, cameras: Mapping[str, Camera]) -> dict[str, float]:
    """How far what the views look at is from each, about: where the middle rays meet."""
    axes = np.stack([cameras[name].w2c[2, :3] for name in tracks.views])
    centers = np.stack([cameras[name].center for name in tracks.views])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle = np.linalg.lstsq(across.sum(axis=0), np.einsum("vij,vj->i", across, centers), rcond=None)[0]
    return {name: max(float(np.linalg.norm(middle - cameras[name].center)), 1e-6) for name in tracks.views}


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


def fit_cameras(tracks: Tracks, told: Mapping[str, Camera]) -> FittedCameras | None:
    """The cameras that explain `tracks`, or None where there are too few points, or where cameras are right as told.

    Every other point has no say, and tells whether the others are better explained for it.
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
    answers: list[tuple[float, dict[str, Camera], float, tuple[str, ...]]] = []
    for kinds in _ANSWERS:
        cameras, k1 = problem.cameras(_fitted(problem, problem.groups(kinds), scale))
        answers.append((float(np.nan_to_num(typical_error(asked, cameras, k1), nan=np.inf)), cameras, k1, kinds))
    best = min(answer[0] for answer in answers)
    as_good = _AS_GOOD * best + _AS_GOOD_PIXELS * scale
    after, cameras, k1, kinds = next(answer for answer in answers if answer[0] <= as_good)
    if not after < _BETTER * before:
        return None
    few = [name for number, name in enumerate(tracks.views) if heard.seen[:, number].sum() < _LEAST_OF_A_VIEW]
    return FittedCameras(cameras | {name: told[name] for name in few}, k1, kinds, before, after, len(tracks))


def _fitted(problem: _Problem, groups: list[NDArray[np.intp]], scale: float) -> NDArray[np.float64]:
    """The unknowns, of which those in `groups` are free."""
    values, free = np.zeros(problem.count), np.concatenate(groups)
    seen = problem.tracks.seen
    for _ in range(_ROUNDS):
        lengths = np.linalg.norm(reprojection(problem.tracks, *problem.cameras(values)), axis=-1)[seen]
        spread = max(float(np.median(np.nan_to_num(lengths))), 0.02 * scale)
        bound = _OUTLIER * spread
        prior = np.zeros(problem.count)
        for group in groups:
            # The larger a change is, the less a pixel of it costs: a sum of sizes.
            prior[group] = min(spread, _FINEST * scale) / np.sqrt(np.linalg.norm(values[group]) / scale + _SMALL)
        prior *= np.sqrt(_PRIOR * seen.sum() / len(groups))
        prior[-1] = 0.0  # a bend of all lenses leaves nothing open

        told = (problem, values, free, bound, prior[free] / scale)
        # With derivatives of its own, as releases of SciPy differ in whether evaluations for them count.
        values[free] = least_squares(
            _residual, values[free], _slopes, method="lm", x_scale=1.0, max_nfev=_STEPS, args=told
        ).x
    return values


def _residual(
    changed: NDArray[np.float64],
    problem: _Problem,
    values: NDArray[np.float64],
    free: NDArray[np.intp],
    bound: float,
    prior: NDArray[np.float64],
) -> NDArray[np.float64]:
    """What is left of points, by Cauchy's loss beyond `bound` pixels, and of the `prior` on what was `changed`."""
    values = values.copy()
    values[free] = changed
    errors = reprojection(problem.tracks, *problem.cameras(values))[problem.tracks.seen]
    # Rays that never meet, as those of two cameras in one place, say nothing.
    errors = np.nan_to_num(errors, nan=0.0, posinf=0.0, neginf=0.0)
    lengths = np.linalg.norm(errors, axis=-1, keepdims=True)
    # Each error scaled to the root of its loss.
    damped = errors * bound * np.sqrt(np.log1p((lengths / bound) ** 2)) / np.maximum(lengths, 1e-12)
    return np.concatenate([damped.ravel(), prior * changed])


def _slopes(changed: NDArray[np.float64], *told: Any) -> NDArray[np.float64]:
    """Derivatives of `_residual`, by forward differences."""
    start = _residual(changed, *told)
    slopes = np.empty((len(start), len(changed)))
    for number in range(len(changed)):
        beside = changed.copy()
        beside[number] += _STEP
        slopes[:, number] = (_residual(beside, *told) - start) / _STEP
    return slopes


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

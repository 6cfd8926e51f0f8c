"""A container that nobody scanned, from its masks alone: the upright vessel that fills them.

Most bowls, cups and jugs are surfaces of revolution, most tanks are boxes. Both have one outline at all heights, in
another size at each. For a given axis and outline the widest such body within all masks is unique: at each height the
largest ring whose projections lie within them. Axis and outline are those for which its silhouettes cover the masks
best. Circles are tried first; then superellipses, from ellipses to boxes with rounded corners. Above the rim and below
the foot the body is a phantom that hides in the masks of the opening and of the sides; it is cut off where the
silhouettes stay as they are without it.

The surface is the container's outside, open at the rim and without thickness. It needs no texture, and is refused where
it does not cover the masks: a vessel with a handle, masks of something else.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from splashbench.arrays import Floats
from splashbench.container.mask_kernels import least_within, overlap
from splashbench.container.vessel_body import Vessel, VesselBody, frame_about, superellipse
from splashbench.observe.container import depth_image, nearest_drawn
from splashbench.scene import Camera
from splashbench.scene.container import ContainerMesh

#: Silhouettes of a body that is trusted cover this much of the masks, in the mean and in the worst view.
LEAST_COVER, LEAST_COVER_OF_A_VIEW = 0.965, 0.93
# Longer side of a mask in pixels, for the search and for the last fit.
_SEARCH_PIXELS, _FINE_PIXELS = 100.0, 400.0
# Rings and points of a ring, in the search and in the last fit; each radius is halved in on.
_RINGS, _FINE_RINGS = (20, 24), (120, 64)
_BISECTIONS = 10
# A ring may lie so many pixels beyond a mask: masks are as coarse as their pixels.
_TOLERANCE = 0.5
# Share of the masks that the silhouettes may lose where phantoms are cut off, at either end.
_PHANTOM_LOSS = 0.002
# What a start is moved by: shifts in the sizes of the container, tilts in radians; aspect, exponent and turn.
_STEPS = np.array([0.1, 0.1, 0.12, 0.12, 0.15, 2.0, 0.2])
_CIRCLE, _BOX_EXPONENT = (0.0, 2.0, 0.0), 8.0
_ASPECTS, _TURNS = (0.0, 0.25, 0.5), 6
_EVALUATIONS = (120, 300)
# The last search is finer, and starts with steps so many times smaller.
_REFINED_PIXELS, _REFINED_RINGS, _REFINED_STEPS, _REFINED_EVALUATIONS = 240.0, (40, 32), 0.15, 100
# Fewer masks, or cameras within fewer degrees, are filled by bodies of any tilt.
_LEAST_VIEWS, _LEAST_DEGREES = 3, 15.0
# Cameras that stand so far above or below the container, on the mean and as a share of their distance, look down.
_ABOVE = 0.1


@dataclass(frozen=True, eq=False)
class MaskedVessel(Vessel):
    """A vessel that fills masks. cover: overlap (intersection over union) of its silhouettes and these, per camera."""

    cover: dict[str, float]

    @property
    def trusted(self) -> bool:
        """Whether the masks are those of such a body."""
        covers = np.array(list(self.cover.values()))
        return bool(covers.mean() >= LEAST_COVER and covers.min() >= LEAST_COVER_OF_A_VIEW)


@dataclass(frozen=True, eq=False)
class _MaskView:
    """A mask at a working resolution. distance: float32 [H, W], pixels within the mask, negative beyond it."""

    camera: Camera
    mask: NDArray[np.bool_]
    distance: NDArray[np.float32]

    @classmethod
    def of(cls, camera: Camera, mask: NDArray[np.bool_], longest: float) -> _MaskView:
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        longer = max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1
        small = camera.scaled(min(1.0, longest / longer))
        shrunk = cv2.resize(mask.astype(np.float32), (small.width, small.height), interpolation=cv2.INTER_AREA) > 0.5
        # What an image cuts off may go on beyond it.
        padded = np.pad(shrunk, 1, mode="edge").astype(np.uint8)
        inner = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        outer = cv2.distanceTransform(1 - padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        distance = np.where(padded > 0, inner - 0.5, 0.5 - outer).astype(np.float32)[1:-1, 1:-1]
        return cls(small, shrunk, np.ascontiguousarray(distance))

    @cached_property
    def projection(self) -> Floats:
        """Scene to pixels, [3, 4]."""
        return np.ascontiguousarray(self.camera.projection)

    def covered(self, mesh: ContainerMesh) -> float:
        """Intersection over union of the mesh's silhouette and the mask."""
        vertices = np.ascontiguousarray(mesh.vertices, np.float64)
        near = nearest_drawn(vertices @ self.camera.w2c[2, :3] + self.camera.w2c[2, 3])
        both, either = overlap(vertices, mesh.faces, self.projection, self.mask, near) if near > 0 else (-1, -1)
        if either < 0:
            drawn = np.isfinite(depth_image(mesh, self.camera))
            both, either = int((drawn & self.mask).sum()), int((drawn | self.mask).sum())
        return both / max(either, 1)


def _within(views: Sequence[_MaskView], points: Floats) -> Floats:
    """Pixels by which points [..., 3] lie within all masks; those beyond an image's border as the border."""
    flat = np.ascontiguousarray(points.reshape(-1, 3), np.float64)
    least = np.full(len(flat), np.inf)
    for view in views:
        least_within(view.distance, view.projection, flat, least)
    return least.reshape(points.shape[:-1])


def vessel_from_masks(
    cameras: Sequence[Camera], masks: Mapping[str, NDArray[np.bool_]], ups: Sequence[Floats] = ()
) -> MaskedVessel | None:
    """The upright vessel that fills `masks` (bool [H, W] by camera name) best.

    ups: directions [3] that may be the axis, as the normal of a table; that which the cameras were held by is tried
    anyway. None where the masks have no common hull, or where fewer than three
    say anything, or their cameras stand so close together that a body of any tilt would fill them.
    """
    used = [camera for camera in cameras if camera.name in masks and 0 < masks[camera.name].mean() < 1]
    views = [_MaskView.of(camera, masks[camera.name], _SEARCH_PIXELS) for camera in used]
    used = [camera for camera, view in zip(used, views) if view.mask.any()]
    views = [view for view in views if view.mask.any()]
    if len(used) < _LEAST_VIEWS:
        return None
    start = _meeting_point(views)
    reach = min(float(np.linalg.norm(camera.center - start)) for camera in used)
    if reach == 0 or _widest_angle(used, start) < _LEAST_DEGREES:
        return None
    best = None
    for up in (_held_up(used, start), *ups):
        search = _Search(start, frame_about(up), reach, views)
        cover, at = search.best(np.array([0, 0, 0, 0, *_CIRCLE]), 4, _EVALUATIONS[0])
        if best is None or cover > best[0]:
            best = cover, at, search
    assert best is not None
    cover, at, search = best
    if cover < LEAST_COVER:
        boxes = [
            np.concatenate([axis, [aspect, _BOX_EXPONENT, turn]])
            for axis in (np.zeros(4), at[:4])
            for aspect in _ASPECTS
            for turn in np.arange(_TURNS) * (np.pi / (_TURNS if aspect else 2 * _TURNS))
        ]
        box = search.best(max(boxes, key=search.cover), len(_STEPS), _EVALUATIONS[1])
        cover, at = max((cover, at), box, key=lambda found: found[0])

    def sharper(pixels: float) -> _Search:
        return _Search(
            start, search.frame, reach, [_MaskView.of(camera, masks[camera.name], pixels) for camera in used]
        )

    free = 4 if at[5] == _CIRCLE[1] else len(_STEPS)
    _, at = sharper(_REFINED_PIXELS).best(at, free, _REFINED_EVALUATIONS, _REFINED_RINGS, _REFINED_STEPS)
    fine = sharper(_FINE_PIXELS)
    body = fine.body(at, *_FINE_RINGS)
    if body is None:
        return None
    vessel = MaskedVessel(_without_phantoms(body, fine.views), {})
    vessel.cover.update((view.camera.name, view.covered(vessel.mesh)) for view in fine.views)
    return vessel


def _widest_angle(cameras: Sequence[Camera], start: Floats) -> float:
    """Degrees between the two directions from `start` that differ most."""
    away = np.stack([camera.center - start for camera in cameras])
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return float(np.rad2deg(np.arccos(np.clip((away @ away.T).min(), -1, 1))))


def _held_up(cameras: Sequence[Camera], start: Floats) -> Floats:
    """The direction [3] that is up, as cameras are held level: across all their horizontal axes.

    Cameras look down into a vessel. Where they do, that tells up from down, as one may hang upside down.
    """
    across = np.stack([camera.w2c[0, :3] for camera in cameras])
    in_images = -np.stack([camera.w2c[1, :3] for camera in cameras]).mean(axis=0)
    _, spread, axes = np.linalg.svd(across, full_matrices=True)
    up = axes[-1] if spread[1] > 0.1 * spread[0] else in_images
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    away = np.stack([camera.center - start for camera in cameras])
    height = float((away @ up / np.linalg.norm(away, axis=1)).mean())
    sense = height if abs(height) > _ABOVE else float(up @ in_images)
    return np.asarray(-up if sense < 0 else up)


def _meeting_point(views: Sequence[_MaskView]) -> Floats:
    """The point [3] nearest to the rays through the middles of the masks."""
    total, right = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        rows, columns = np.nonzero(view.mask)
        ray = np.linalg.solve(view.camera.K, [columns.mean() + 0.5, rows.mean() + 0.5, 1.0]) @ view.camera.w2c[:3, :3]
        across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
        total += across
        right += across @ view.camera.center
    return np.asarray(np.linalg.lstsq(total, right, rcond=None)[0])


@dataclass(frozen=True, eq=False)
class _Search:
    """Bodies by seven numbers: two shifts and two tilts of the axis, and the outline's aspect, exponent and turn.

    start: a point within the container. frame: see `VesselBody`. reach: of the cameras.
    """

    start: Floats
    frame: Floats
    reach: float
    views: Sequence[_MaskView]

    def best(
        self, first: Floats, free: int, evaluations: int, rings: tuple[int, int] = _RINGS, steps: float = 1.0
    ) -> tuple[float, Floats]:
        """Cover and numbers of the best body about `first`, of whose numbers the leading `free` may change."""
        fixed = first[free:]
        simplex = np.vstack([np.zeros(free), np.diag(steps * _STEPS[:free])]) + first[:free]
        found = minimize(
            lambda numbers: -self.cover(np.concatenate([numbers, fixed]), rings),
            first[:free],
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "maxfev": evaluations, "xatol": 1e-3, "fatol": 2e-4},
        )
        return -float(found.fun), np.concatenate([found.x, fixed])

    def cover(self, numbers: Floats, rings: tuple[int, int] = _RINGS) -> float:
        """Mean overlap of the body's silhouettes and the masks. rings: how many, and points of each."""
        body = self.body(numbers, *rings)
        if body is None:
            return 0.0
        mesh = body.mesh()
        return float(np.mean([view.covered(mesh) for view in self.views]))

    def body(self, numbers: Floats, rings: int, points: int) -> VesselBody | None:
        """The widest body within the masks; None where its axis misses them."""
        shift, tilt = 0.25 * self.reach * numbers[:2], numbers[2:4]
        turned = frame_about(self.frame[2] + tilt @ self.frame[:2])
        middle = self.start + shift @ self.frame[:2]
        along = np.linspace(-0.6 * self.reach, 0.6 * self.reach, 301)
        line = middle + along[:, None] * turned[2]
        inside = _within(self.views, line) > -_TOLERANCE
        # The piece about the middle: another may lie where masks meet by chance.
        breaks = np.flatnonzero(~inside)
        nearest = int(np.argmin(np.where(inside, np.abs(along), np.inf)))
        low = int(breaks[breaks < nearest].max(initial=-1)) + 1
        high = int(breaks[breaks > nearest].min(initial=len(along))) - 1
        if not inside.any() or high - low < 3:
            return None
        outline = superellipse(float(numbers[4]), float(np.clip(numbers[5], 2, 30)), float(numbers[6]), points)
        heights = np.linspace(along[low], along[high], rings)
        body = VesselBody(middle, turned, outline, heights, np.zeros(rings))
        lowest, highest = np.zeros(rings), np.full(rings, 0.6 * self.reach)
        for _ in range(_BISECTIONS):
            tried = 0.5 * (lowest + highest)
            ring_points = body.rings(tried)
            fits = _within(self.views, ring_points).min(axis=1) > -_TOLERANCE
            lowest, highest = np.where(fits, tried, lowest), np.where(fits, highest, tried)
        return VesselBody(middle, turned, outline, heights, np.maximum(lowest, 1e-6 * self.reach))


def _without_phantoms(body: VesselBody, views: Sequence[_MaskView]) -> VesselBody:
    """The fewest rings whose silhouettes are those of the whole body: from the top down to the rim, then from below."""

    def cover(part: VesselBody) -> float:
        mesh = part.mesh()
        return float(np.mean([view.covered(mesh) for view in views]))

    def fewest(part: Callable[[int], VesselBody], count: int) -> int:
        least, low, high = cover(part(count)) - _PHANTOM_LOSS, 2, count
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if cover(part(middle)) >= least else (middle, high)
        return high

    body = body.part(0, fewest(lambda rings: body.part(0, rings), len(body.heights)))
    count = len(body.heights)
    return body.part(count - fewest(lambda rings: body.part(count - rings, count), count), count)

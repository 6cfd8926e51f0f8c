"""A container that is seen through: the upright vessel about liquid that rests in it.

Glass shows no depth of its own, but liquid that has come to rest in it shows where it is. The upright body that fills
what is wet most of the time is found as one that depths show (footage_vessel.py). It is made as high as walls are, and
moved to edges of the plates, with the liquid within.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.arrays import Floats
from splashbench.background.clean_plate import CleanPlate
from splashbench.background.depth import pixels_at
from splashbench.container.body_search import ALL_RADII, CIRCULAR, HEIGHT, MESH_RINGS, BodySearch, beside, body, rings
from splashbench.container.found_vessel import FoundVessel
from splashbench.container.outline_search import BLURS, OutlineSearch
from splashbench.container.outline_views import silhouette_of
from splashbench.container.standing import ContainerView, Place
from splashbench.container.vessel_body import VesselBody
from splashbench.scene.camera import Camera
from splashbench.scene.frames import spread_frames
from splashbench.scene.scene import TrainingScene

# Frames that say where liquid rests, the later half of the recording; the fewest that do, and in so many of them it is
# there.
_FRAMES, _FEWEST, _MOSTLY = 16, 4, 0.5
# A disc with a radius of this share of its size does not fit into a stream.
_THIN = 0.12
# Cells along a side of the room about the liquid, which reaches so far to either side, and up, as a share of the
# cameras' distance. One view may be wrong about a cell, where there are more than three.
_CELLS, _ROOM, _WRONG = 56, 0.35, 1
# Of the image, what a view shows at the least of liquid that rests, and pixels between it and the image's border.
_LEAST_CELLS, _LEAST_SHARE, _MARGIN = 60, 0.004, 2
# The body holds this much of the liquid at least. It held .94 to .99 of it in glass; in opaque bowls .91 at most, as
# less of it is seen.
_LEAST_FILLED = 0.93
# The vessel holds this much of it: glass held all.
_LEAST_WITHIN = 0.95
# Heights and radii that are tried, by those of the liquid; of them so many are searched about.
_HEIGHTS, _WIDTHS, _STARTS = np.arange(0.5, 4.01, 0.25), (1.0, 1.05, 1.1, 1.2), 4
# What is so many times as wide as the liquid, or as high, is no wall about it; directions in which widths are compared.
# Nor is what ends below so many times the liquid's level.
_WIDEST, _HIGHEST, _DIRECTIONS, _LOWEST = 1.35, 4.5, 16, 1.15
# What bends of the profile cost: walls are nearly straight. Inner edges and what shines would bend them. What liquid
# is worth that lies within.
_BENDS, _WITHIN = 0.5, 1.0
# In the end height, all radii, and the aspect of an outline that is no circle are pushed by so much of the size.
_PUSHES = (0.08, 0.04, -0.04)


def vessel_about_pool(scene: TrainingScene, place: Place, plates: Mapping[str, CleanPlate]) -> FoundVessel | None:
    """The vessel on `place` about liquid that rests there; None where none does."""
    views = pool_views(scene, place, plates)
    if not views:
        return None
    search = BodySearch(place, views)
    pool, free = search.found()
    filled = search.held(pool)

    def refused(why: str, within: float = 0.0) -> FoundVessel:
        return FoundVessel(body(place, pool), (filled, within), 0.0, beside(pool), seen_through=True, refused=why)

    if filled < _LEAST_FILLED:
        return refused(f"an upright body holds {filled:.2f} of the liquid that rests")
    if beside(pool) > 1:
        return refused(f"the liquid that rests is {beside(pool):.1f} radii beside the middle of all")
    starts = [_straight(pool, height, width) for height in _HEIGHTS for width in _WIDTHS]
    # What speaks against the liquid may be glass.
    speaking = [replace(view, says=np.maximum(view.says, 0)) for view in views]
    highest = rings(place, _straight(pool, float(_HEIGHTS[-1]), 1.0))
    shown = [(silhouette_of(highest, view.camera) > 0) | (view.says > 0) for view in views]
    outline = OutlineSearch(place, speaking, search.size[:free], _BENDS, _WITHIN, shown)
    (blur, step), *finer = BLURS
    outline.blur(blur)
    found = min((outline.settled(at, step) for at in sorted(starts, key=outline.cost)[:_STARTS]), key=outline.cost)
    for blur, step in finer:
        outline.blur(blur)
        found = outline.settled(found, step)
    for which in (HEIGHT, ALL_RADII, *range(CIRCULAR, min(free, CIRCULAR + 1))):
        for push in _PUSHES:
            found = outline.pushed(found, which, push)
    vessel = body(place, found, MESH_RINGS)
    within = outline.strength_and_held(found)[1]
    wider = _wider(vessel, body(place, pool))
    if wider > _WIDEST or found[HEIGHT] > _HIGHEST * pool[HEIGHT]:
        higher = found[HEIGHT] / pool[HEIGHT]
        return refused(
            f"edges {wider:.1f} times as wide and {higher:.1f} times as high as liquid are none about it", within
        )
    if found[HEIGHT] < _LOWEST * _level(views[0].points[:, 2]):
        return refused("edges about the liquid end where it does, as those of what it wets or shades", within)
    if within < _LEAST_WITHIN:
        return refused(f"edges about the liquid hold {within:.2f} of it", within)
    if sum(_shows(view.camera, vessel) for view in views) < max(2, len(views) / 2):
        return refused("the rim about the liquid is within too few images", within)
    return FoundVessel(vessel, (filled, within), outline.contrast(found), beside(found), seen_through=True)


def _level(heights: Floats) -> float:
    """How high liquid stands whose cells are at `heights` [N]: drops above it fill less of a layer."""
    layers, cells = np.unique(heights, return_counts=True)
    return float(layers[cells >= 0.5 * cells.max()][-1])


def _wider(vessel: VesselBody, pool: VesselBody) -> float:
    """How many times as wide as `pool` the vessel is, in the direction in which it is the most."""
    angles = np.linspace(0, np.pi, _DIRECTIONS, endpoint=False)
    across = np.stack([np.cos(angles), np.sin(angles)])
    vessels, pools = (each.radii.max() * np.ptp(each.outline @ across, axis=0) for each in (vessel, pool))
    return float((vessels / pools).max())


def _shows(camera: Camera, vessel: VesselBody) -> bool:
    """Whether the image holds all of the rim."""
    pixels, depth = camera.project(vessel.rings(vessel.radii)[-1])
    inside = (pixels > 0).all() and (pixels < [camera.width, camera.height]).all()
    return bool(inside and (depth > 0).all())


def _straight(pool: Floats, height: float, width: float) -> Floats:
    """The numbers of a vessel with upright walls, so many times as high and as wide as `pool`."""
    # The foot of the liquid is above a floor of glass, and drops stand above it.
    straight = pool.copy()
    straight[HEIGHT] *= height
    straight[ALL_RADII] = width * pool[ALL_RADII].max()
    return straight


def pool_views(scene: TrainingScene, place: Place, plates: Mapping[str, CleanPlate]) -> list[ContainerView]:
    """What the training views show of liquid that rests on `place`; none where fewer than two show any.

    Where it rests a view speaks for the container's inside, and where no liquid is in any frame against it.
    """
    found = {name: _resting(scene, name) for name in scene.train}
    # Of liquid that the image's border cuts off nobody knows the end.
    resting = {
        name: rests
        for name, (rests, _) in found.items()
        if rests.mean() >= _LEAST_SHARE and not _at_border(rests, _MARGIN)
    }
    if len(resting) < max(2, len(found) / 2):
        return []
    points = _cells_within([(scene.cameras[name], rests) for name, rests in resting.items()], place)
    if len(points) < _LEAST_CELLS or np.ptp(points[:, 2]) == 0:
        return []
    return [
        ContainerView(
            scene.cameras[name], rests.astype(np.int8) - (~found[name][1]).astype(np.int8), points, plates[name]
        )
        for name, rests in resting.items()
    ]


def _resting(scene: TrainingScene, name: str) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """bool [H, W] each: where a view mostly shows liquid that is no stream, and where it ever shows any."""
    frames = spread_frames(scene.n_frames, 2 * _FRAMES)
    masks = np.stack([scene.mask(name, int(t)) for t in frames])
    ever, later = np.asarray(masks.any(axis=0)), masks[len(masks) // 2 :]
    mostly = np.asarray(later.mean(axis=0) >= _MOSTLY)
    nowhere = np.zeros_like(ever)
    if len(later) < _FEWEST or not mostly.any():
        return nowhere, ever
    closed = cv2.morphologyEx(mostly.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    opened = _opened(closed > 0, _THIN * float(np.sqrt(mostly.sum())))
    number, labels, stats, _ = cv2.connectedComponentsWithStats(opened.astype(np.uint8))
    if number < 2:
        return nowhere, ever
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))), ever


def _opened(mask: NDArray[np.bool_], radius: float) -> NDArray[np.bool_]:
    """Without what a disc of so many pixels does not fit into. By distances: a large disc takes no longer."""
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    beside = cv2.distanceTransform((inside <= radius).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray((beside <= radius) & (inside > radius).any())


def _at_border(mask: NDArray[np.bool_], margin: int) -> bool:
    """Whether `mask` comes as near to the image's border."""
    inner = mask[margin:-margin, margin:-margin]
    return bool(mask.sum() > inner.sum())


def _cells_within(views: list[tuple[Camera, NDArray[np.bool_]]], place: Place) -> Floats:
    """The plan [N, 3] of the cells on `place` that rest in all of the views but for `_WRONG`."""
    along = np.linspace(-1, 1, _CELLS) * _ROOM * place.distance
    up = np.linspace(0, 1, _CELLS) * _ROOM * place.distance
    plan = np.stack(np.meshgrid(along, along, up, indexing="ij"), axis=-1).reshape(-1, 3)
    points = place.origin + plan @ place.frame
    seen = np.zeros(len(points), int)
    for camera, rests in views:
        pixels, depth = camera.project(points)
        row, column, inside = pixels_at(camera, np.where(depth[:, None] > 0, pixels, -1.0))
        seen += inside & rests[row, column]
    return plan[seen >= len(views) - (_WRONG if len(views) > 3 else 0)]

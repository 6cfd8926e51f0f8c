"""What the depths of clean plates show about the liquid: the surface that things stand on, and the container on it.

What rises from the surface nearest to the liquid is the container. In each view pixels that show it speak for it, and
pixels that show the surface, what lies below it or what is far away speak against it. The others say nothing: those
of which no two views agree on a depth, and what else rises nearby.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from splashbench.arrays import Floats
from splashbench.background.clean_plate import CleanPlate
from splashbench.background.depth import DepthMap, depth_maps, nearest_to_rays
from splashbench.background.support import Support, find_support
from splashbench.container.vessel_body import frame_about
from splashbench.scene.camera import Camera
from splashbench.scene.frames import spread_frames
from splashbench.scene.scene import TrainingScene

# Frames that say where liquid is.
_FRAMES = 16
# All shares are of the mean distance between cameras and liquid. Points about the liquid that the surface is found in;
# how far they may lie beside it; from which height on something rises from it, and up to which height.
_ABOUT, _FLAT, _RISES, _HIGHEST = 0.6, 0.004, 0.012, 0.6
# Below this share of the height at which things rise, a pixel shows the surface or what lies below it.
_SURELY_FLAT = 0.4
# Cameras are held level to within so many degrees; gravity that is stated is right to so many.
_HELD_LEVEL, _STATED = 60.0, 10.0
# Of the points about the liquid, what the surface that things stand on has at least.
_LEAST_SUPPORT = 0.15
# Seen from above, things are told apart by cells of this size; of them the nearest to the liquid within this distance.
_CELL, _NEAREST = 0.01, 0.3
# Cells along a side of what is seen from above.
_CELLS = round(2 * _ABOUT / _CELL)
# What errors of the depth make is of fewer pixels, of all views together. A container takes up more than the share of
# the image in two views and in half of them: errors took up .2 %, bowls 5 to 10.
_LEAST_PIXELS, _LEAST_SHARE = 60, 0.004
# What a pixel shows is doubtful where colours of views differ by so many times what they do in the middle on the
# surface. Beside a bowl in narrow upright images, where no other view shows the table, it was 1.6 to 3 times as much;
# on the bowl .4.
_ALIKE = 1.7


@dataclass(frozen=True, eq=False)
class Place:
    """The surface that things stand on. origin: [3], on it, below the liquid. distance: of the cameras, scene units."""

    support: Support
    origin: Floats
    distance: float

    @cached_property
    def frame(self) -> Floats:
        """Unit vectors [3, 3], the last upwards."""
        return frame_about(self.support.normal)

    def plan(self, points: Floats) -> Floats:
        """Of points [..., 3] the place on the surface about the origin, and the height above it, [..., 3]."""
        return np.asarray((points - self.origin) @ self.frame.T)

    def rises(self, plan: Floats) -> NDArray[np.bool_]:
        """Which points of a plan rise from the surface."""
        return np.asarray((plan[..., 2] > _RISES * self.distance) & (plan[..., 2] < _HIGHEST * self.distance))


@dataclass(frozen=True, eq=False)
class ContainerView:
    """What a view shows of the container.

    camera: of the depths. says: int8 [H, W], 1 where it shows the container, -1 where it shows what lies around it,
    0 elsewhere. points: [N, 3], the plan of what shows it. plate: of the same view, in its own size. doubtful: bool
    [H, W], where it seems to show the container and other views show another colour there; None for nowhere.
    """

    camera: Camera
    says: NDArray[np.int8]
    points: Floats
    plate: CleanPlate
    doubtful: NDArray[np.bool_] | None = None

    def without_doubtful(self) -> ContainerView:
        """The same, where doubtful pixels say nothing."""
        if self.doubtful is None:
            return self
        says = np.where(self.doubtful, np.int8(0), self.says)
        return replace(self, says=says, points=self.points[says[self.says > 0] > 0], doubtful=None)


def place_about_liquid(
    scene: TrainingScene, plates: Mapping[str, CleanPlate]
) -> tuple[Place | None, list[ContainerView]]:
    """The surface below the liquid, as clean plates show it, and the views of the container on it.

    None, and no views, where fewer than two views show liquid or no surface is found. No views where nothing rises from
    it that two views and half of them see.
    """
    liquid = _liquid(scene)
    maps = depth_maps(scene.initial_points(), [plates[name] for name in scene.train])
    if liquid is None or not maps:
        return None, []
    cameras = [depth.camera for depth in maps]
    centers = np.stack([camera.center for camera in cameras])
    distance = float(np.linalg.norm(centers - liquid, axis=1).mean())
    clouds = [depth.lifted() for depth in maps]
    about = np.concatenate([cloud[depth.trusted] for cloud, depth in zip(clouds, maps)])
    about = about[np.linalg.norm(about - liquid, axis=1) < _ABOUT * distance]
    if scene.gravity is None:
        up, degrees = -np.stack([camera.w2c[1, :3] for camera in cameras]).mean(axis=0), _HELD_LEVEL
    else:
        up, degrees = -scene.gravity, _STATED
    support = find_support(about, centers, up, degrees, _FLAT * distance)
    if support is None or support.share < _LEAST_SUPPORT:
        return None, []
    place = Place(support, liquid - float(support.heights(liquid)) * support.normal, distance)
    plans = [place.plan(cloud) for cloud in clouds]
    rising = [depth.trusted & place.rises(plan) for depth, plan in zip(maps, plans)]
    cells = [np.floor((plan[..., :2] / distance + _ABOUT) / _CELL).astype(np.int64) for plan in plans]
    thing = _nearest_thing(np.concatenate([at[rises] for at, rises in zip(cells, rising)]))
    views = [
        ContainerView(depth.camera, says, plan[says > 0], plates[name], _doubtful(depth, says))
        for name, depth, plan, rises, at in zip(scene.train, maps, plans, rising, cells)
        if shows_enough(says := _speaks(place, depth, plan, rises & _taken(thing, at)))
    ]
    return place, views if len(views) >= max(2, len(maps) / 2) else []


def shows_enough(says: NDArray[np.int8]) -> bool:
    """Whether what a view says of the container (`ContainerView.says`) is more than errors of the depth."""
    return bool((says > 0).mean() >= _LEAST_SHARE)


def _doubtful(depth: DepthMap, says: NDArray[np.int8]) -> NDArray[np.bool_]:
    """`ContainerView.doubtful`, by what the colours differ where the view speaks against the container."""
    beside = depth.cost[says < 0]
    return np.asarray((says > 0) & (depth.cost > _ALIKE * np.median(beside))) if len(beside) else says > 1


def _liquid(scene: TrainingScene) -> Floats | None:
    """The point [3] where liquid is, scene units; None where fewer than two cameras see any.

    In each view the middle over the frames, of the middle of each mask: masks that failed are outvoted.
    """
    cameras, middles = [], []
    for name in scene.train:
        shown = (np.argwhere(scene.mask(name, int(t))) for t in spread_frames(scene.n_frames, _FRAMES))
        of_frames = [at.mean(axis=0)[::-1] + 0.5 for at in shown if len(at)]
        if of_frames:
            cameras.append(scene.cameras[name])
            middles.append(np.median(of_frames, axis=0))
    return nearest_to_rays(cameras, np.stack(middles)) if len(cameras) > 1 else None


def _taken(thing: NDArray[np.bool_], cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether `cells` [..., 2] are of `thing` [C, C]."""
    inside = ((cells >= 0) & (cells < _CELLS)).all(axis=-1)
    at = np.clip(cells, 0, _CELLS - 1)
    return np.asarray(thing[at[..., 0], at[..., 1]] & inside)


def _nearest_thing(cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Of `cells` [N, 2] in which something rises, those of what is nearest to the middle, bool [C, C]; none where
    nothing is near."""
    cells = cells[((cells >= 0) & (cells < _CELLS)).all(axis=1)]
    count = np.zeros((_CELLS, _CELLS), int)
    np.add.at(count, (cells[:, 0], cells[:, 1]), 1)
    # Padded, as a closing takes from what touches the border.
    things, number = ndimage.label(
        ndimage.binary_closing(np.pad(count > 1, 2), np.ones((3, 3)))[2:-2, 2:-2], np.ones((3, 3))
    )
    if not number:
        return np.zeros_like(count, bool)
    along = (np.arange(_CELLS) + 0.5) * _CELL - _ABOUT
    numbers = np.arange(1, number + 1)
    nearest = ndimage.minimum(np.hypot(along[:, None], along), things, numbers)
    sizes = ndimage.sum_labels(count, things, numbers)
    # Specks are errors of the depth.
    usable = (sizes >= max(_LEAST_PIXELS, 0.05 * sizes.max())) & (nearest < _NEAREST)
    chosen = numbers[np.argmin(np.where(usable, nearest, np.inf))]
    return np.asarray((things == chosen) & usable.any())


def _speaks(place: Place, depth: DepthMap, plan: Floats, shows: NDArray[np.bool_]) -> NDArray[np.int8]:
    """`ContainerView.says`. shows: bool [H, W], where the view shows the container."""
    flat = plan[..., 2] < _SURELY_FLAT * _RISES * place.distance
    far = np.linalg.norm(plan[..., :2], axis=-1) >= _ABOUT * place.distance
    against = depth.trusted & ~shows & (flat | far)
    return np.asarray(shows, np.int8) - np.asarray(against, np.int8)

"""A container that nobody scanned or masked: the upright vessel that stands where the liquid is.

1. Depths of the clean plates tell the surface that things stand on, and what rises from it there (standing.py).
2. The upright body whose silhouettes hold the most of that and the least else is found: circular rings first, then
   superellipses, from ellipses to boxes with rounded corners.
3. Its outline is moved to edges of the plates, since depths are those of windows of pixels and reach beyond it.

The first two, by small plates, take a second or two, and do for whoever cannot wait (`standing_roughly`).

It takes an opaque container with a little texture or shading, and one that is seen through where liquid has come to
rest in it (pool_vessel.py). One that is no such body is refused. The surface is the container's outside, open at the
rim and without thickness.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from splashbench.arrays import Floats
from splashbench.background.clean_plate import CleanPlate, shrunk
from splashbench.background.support import Support
from splashbench.container.body_search import BEND, CIRCULAR, HEIGHT, MESH_RINGS, BodySearch, beside, body, narrowed
from splashbench.container.found_vessel import LEAST_HELD, FoundVessel
from splashbench.container.outline_search import BLURS, OutlineSearch
from splashbench.container.pool_vessel import vessel_about_pool
from splashbench.container.standing import ContainerView, Place, place_about_liquid, shows_enough
from splashbench.scene.scene import TrainingScene

# What is held by depth counts so much beside edges: it keeps outlines off those that are painted on the container.
_BY_DEPTH = 0.3
# In the end height and radii are pushed by so much of the size one by one.
_PUSHES = (0.08, -0.08)
# Pixels along the longer side of plates that do for a rough look. What depths show of plain bowls is so many pixels
# wider than these are; of strongly textured ones it is not, and what is found of them is too narrow.
_ROUGH_SIDE, _WIDER = 160, 2.0
# What a rough vessel holds where depths are right: .96 to .97 of bowls in wide images. In upright ones, where what is
# doubtful makes it too wide, it held .90 to .96.
_ROUGHLY_HELD = 0.95


@dataclass(frozen=True, eq=False)
class Standing:
    """What the footage shows about the liquid: the surface that things stand on, and the vessel on it.

    support: None where there is none. vessel: None where nothing rises from it, and no liquid rests on it.
    """

    support: Support | None
    vessel: FoundVessel | None


def standing_about_liquid(scene: TrainingScene, plates: Mapping[str, CleanPlate]) -> Standing:
    """What stands where the liquid of `scene` is, as its clean plates show it; they are of the images' size."""
    place, views = place_about_liquid(scene, plates)
    if place is None:
        return Standing(None, None)
    vessel = _ByDepth(place, views).at_edges() if views else None
    if vessel is None or not vessel.trusted:
        clear = vessel_about_pool(scene, place, plates)
        vessel = clear if clear is not None and clear.trusted else vessel or clear
    if vessel is not None and not vessel.trusted and (sure := _without_doubtful(views)):
        again = _ByDepth(place, sure).at_edges()
        vessel = again if again.trusted else vessel
    return Standing(place.support, vessel)


def standing_roughly(scene: TrainingScene, plates: Mapping[str, CleanPlate]) -> Standing:
    """The same in a fifth of the time, by depths of small plates alone, and none of glass. Silhouettes overlap the true
    ones by .90 to .92 on five made-up bowls that this was chosen on, by .79 and .83 on two painted things."""
    place, views = place_about_liquid(scene, {name: shrunk(plate, _ROUGH_SIDE) for name, plate in plates.items()})
    if place is None:
        return Standing(None, None)
    if not views:
        return Standing(place.support, None)
    vessel = _ByDepth(place, views).roughly()
    if vessel.held[0] < _ROUGHLY_HELD and (sure := _without_doubtful(views)):
        vessel = max(vessel, _ByDepth(place, sure).roughly(), key=lambda found: found.held[0])
    return Standing(place.support, vessel)


def _without_doubtful(views: Sequence[ContainerView]) -> list[ContainerView]:
    """What `views` show for sure; nothing where one of them shows too little of it."""
    sure = [view.without_doubtful() for view in views]
    return sure if all(shows_enough(view.says) for view in sure) else []


class _ByDepth:
    """The body that fits depths best."""

    def __init__(self, place: Place, views: Sequence[ContainerView]) -> None:
        self._place, self._views, self._search = place, views, BodySearch(place, views)
        self._numbers, self._free = self._search.found()
        self._held = self._search.held(self._numbers)

    def roughly(self) -> FoundVessel:
        """As it is, but for what windows of pixels reach beyond it."""
        pixel = float(np.median([self._place.distance / view.camera.K[0, 0] for view in self._views]))
        return self._vessel(narrowed(self._numbers, _WIDER * pixel), self._held, math.inf)

    def at_edges(self) -> FoundVessel:
        """With its outline moved to edges, where depths say that it is a vessel."""
        best = self._numbers
        if self._held < LEAST_HELD or beside(best) > 1:
            return FoundVessel(body(self._place, best), (self._held, self._held), 0.0, beside(best))
        outline = OutlineSearch(self._place, self._views, self._search.size[: self._free], BEND, _BY_DEPTH)
        for blur, step in BLURS:
            outline.blur(blur)
            best = outline.settled(best, step)
        for number in range(HEIGHT, CIRCULAR):
            for push in _PUSHES:
                best = outline.pushed(best, number, push)
        return self._vessel(best, self._search.held(best), outline.contrast(best))

    def _vessel(self, numbers: Floats, held: float, contrast: float) -> FoundVessel:
        shape = body(self._place, numbers, MESH_RINGS)
        return FoundVessel(shape, (self._held, held), contrast, beside(numbers))

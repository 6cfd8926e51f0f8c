"""A container that nobody scanned or masked: the upright vessel that stands where the liquid is.

1. Depths of the clean plates tell the surface that things stand on, and what rises from it there (standing.py).
2. The upright body whose silhouettes hold the most of that and the least else is found: circular rings first, then
   superellipses, from ellipses to boxes with rounded corners.
3. Its outline is moved to edges of the plates, since depths are those of windows of pixels and reach beyond it.

The first two are there in half of the time, and do for whoever cannot wait.

It takes an opaque container with a little texture or shading, and one that is seen through where liquid has come to
rest in it (pool_vessel.py). One that is no such body is refused. The surface is the container's outside, open at the
rim and without thickness.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from splashbench.arrays import Floats
from splashbench.background.clean_plate import CleanPlate
from splashbench.background.support import Support
from splashbench.container.body_search import BEND, CIRCULAR, HEIGHT, MESH_RINGS, BodySearch, beside, body
from splashbench.container.found_vessel import LEAST_HELD, FoundVessel
from splashbench.container.outline_search import BLURS, OutlineSearch
from splashbench.container.pool_vessel import vessel_about_pool
from splashbench.container.standing import ContainerView, Place, place_about_liquid
from splashbench.scene.scene import TrainingScene

# What is held by depth counts so much beside edges: it keeps outlines off those that are painted on the container.
_BY_DEPTH = 0.3
# In the end height and radii are pushed by so much of the size one by one.
_PUSHES = (0.08, -0.08)


@dataclass(frozen=True, eq=False)
class Standing:
    """What the footage shows about the liquid: the surface that things stand on, and the vessel on it.

    support: None where there is none. vessel: None where nothing rises from it, and no liquid rests on it.
    """

    support: Support | None
    vessel: FoundVessel | None


def standing_about_liquid(scene: TrainingScene, plates: Mapping[str, CleanPlate]) -> Standing:
    """What stands where the liquid of `scene` is, as its clean plates show it; they are of the images' size."""
    return StandingSearch(scene, plates).found()


class StandingSearch:
    """Looks for what `standing_about_liquid` gives: roughly, found, or one after the other, which takes no longer."""

    def __init__(self, scene: TrainingScene, plates: Mapping[str, CleanPlate]) -> None:
        self._scene, self._plates = scene, plates
        self._place, self._views = place_about_liquid(scene, plates)

    def roughly(self) -> Standing:
        """By depths alone: an opaque vessel, up to a tenth too wide, and none of glass."""
        if self._place is None:
            return Standing(None, None)
        return Standing(self._place.support, None if self._by_depth is None else self._by_depth.vessel())

    def found(self) -> Standing:
        """With the outline on edges, and glass about liquid that rests."""
        if self._place is None:
            return Standing(None, None)
        vessel = None if self._by_depth is None else self._by_depth.at_edges()
        if vessel is None or not vessel.trusted:
            clear = vessel_about_pool(self._scene, self._place, self._plates)
            vessel = clear if clear is not None and clear.trusted else vessel or clear
        return Standing(self._place.support, vessel)

    @cached_property
    def _by_depth(self) -> _ByDepth | None:
        return _ByDepth(self._place, self._views) if self._place is not None and self._views else None


class _ByDepth:
    """The body that fits depths best."""

    def __init__(self, place: Place, views: Sequence[ContainerView]) -> None:
        self._place, self._views, self._search = place, views, BodySearch(place, views)
        self._numbers, self._free = self._search.found()
        self._held = self._search.held(self._numbers)

    def vessel(self) -> FoundVessel:
        """As it is."""
        return self._vessel(self._numbers, self._held, math.inf)

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

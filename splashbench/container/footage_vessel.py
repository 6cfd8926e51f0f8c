"""A container that nobody scanned or masked: the upright vessel that stands where the liquid is.

1. Depths of the clean plates tell the surface that things stand on, and what rises from it there (standing.py).
2. The upright body whose silhouettes hold the most of that and the least else is found: circular rings first, then
   superellipses, from ellipses to boxes with rounded corners.
3. Its outline is moved to edges of the plates, since depths are those of windows of pixels and reach beyond it.

It takes an opaque container with a little texture or shading, and one that is seen through where liquid has come to
rest in it (pool_vessel.py). One that is no such body is refused. The surface is the container's outside, open at the
rim and without thickness.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

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
    place, views = place_about_liquid(scene, plates)
    if place is None:
        return Standing(None, None)
    vessel = _fitted(place, views) if views else None
    if vessel is None or not vessel.trusted:
        clear = vessel_about_pool(scene, place, plates)
        vessel = clear if clear is not None and clear.trusted else vessel or clear
    return Standing(place.support, vessel)


def _fitted(place: Place, views: Sequence[ContainerView]) -> FoundVessel:
    """The body that fits best."""
    search = BodySearch(place, views)
    best, free = search.found()
    by_depth = search.held(best)
    if by_depth < LEAST_HELD or beside(best) > 1:
        return FoundVessel(body(place, best), (by_depth, by_depth), 0.0, beside(best))
    outline = OutlineSearch(place, views, search.size[:free], BEND, _BY_DEPTH)
    for blur, step in BLURS:
        outline.blur(blur)
        best = outline.settled(best, step)
    for number in range(HEIGHT, CIRCULAR):
        for push in _PUSHES:
            best = outline.pushed(best, number, push)
    found = body(place, best, MESH_RINGS)
    return FoundVessel(found, (by_depth, search.held(best)), outline.contrast(best), beside(best))

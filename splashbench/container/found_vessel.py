"""A vessel that the footage shows, with what speaks for it, and whether that is enough."""

from __future__ import annotations

from dataclasses import dataclass

from splashbench.container.vessel_body import Vessel

#: A trusted vessel holds this much of what speaks for it, less what speaks against it, before its outline is moved to
#: edges and after, when it lies within what depths reach to. Along its outline edges are so many times as strong as
#: along outlines a little smaller and larger. And the liquid is above it in the middle.
LEAST_HELD, LEAST_HELD_THEN, LEAST_CONTRAST = 0.9, 0.82, 1.25


@dataclass(frozen=True, eq=False)
class FoundVessel(Vessel):
    """A vessel that the footage shows.

    Attributes:
        held: of the pixels that speak for it, the share within its silhouettes, less those that speak against it;
            before its outline was moved to edges, and after. Of one that is seen through: the share of the liquid that
            an upright body holds, and the vessel.
        contrast: how strong edges along its outline are, by those along outlines a little smaller and larger; 0 where
            it was refused before, infinite where no edge was looked at.
        beside: how far from its axis the liquid is in the middle, in radii of its widest ring.
        seen_through: whether liquid that rests in it spoke for it, not depths of its own.
        refused: why the search for it gave up, in words; empty where it did not.
    """

    held: tuple[float, float]
    contrast: float
    beside: float
    seen_through: bool = False
    refused: str = ""

    @property
    def doubt(self) -> str:
        """Why it is not trusted, in words; empty where it is."""
        if self.refused:
            return self.refused
        if self.held[0] < LEAST_HELD or self.held[1] < LEAST_HELD_THEN:
            return f"an upright vessel holds {min(self.held):.2f} of what stands below the liquid"
        if self.beside > 1:
            return f"what stands nearest to the liquid is {self.beside:.1f} radii beside it"
        if self.contrast < LEAST_CONTRAST:
            return f"edges are {self.contrast:.2f} times as strong along the outline as beside it"
        return ""

    @property
    def trusted(self) -> bool:
        """Whether what stands there is such a body."""
        return not self.doubt

"""hull_points: random points of the visual hull, the example of CONTRIBUTING.md; fits in seconds."""

from .hull_points import HullPoints

__all__ = ["HullPoints"]

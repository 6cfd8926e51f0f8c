"""hull_points: random points of the visual hull, the example of CONTRIBUTING.md; fits in seconds."""

from splashbench_methods.hull_points.hull_points import HullPoints

__all__ = ["HullPoints"]

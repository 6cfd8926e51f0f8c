"""What the training masks say about the liquid: visual hull and signed distance (paper, "Observation fields").

Needs no torch. The kernels are compiled at first use (a few seconds) and cached.
"""

from splashbench.observe.failures import distrust_failed_masks, trusted_bounds
from splashbench.observe.grid import Bounds, Grid
from splashbench.observe.hull import sequence_bounds
from splashbench.observe.initial_points import initial_points
from splashbench.observe.occlusion import ContainerOcclusion
from splashbench.observe.signed_distance import (
    SignedDistanceFields,
    signed_distance_fields,
    signed_distance_frames,
)
from splashbench.observe.silhouettes import Silhouettes

__all__ = [
    "Bounds",
    "ContainerOcclusion",
    "Grid",
    "SignedDistanceFields",
    "Silhouettes",
    "distrust_failed_masks",
    "initial_points",
    "sequence_bounds",
    "signed_distance_fields",
    "signed_distance_frames",
    "trusted_bounds",
]

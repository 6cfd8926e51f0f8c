"""Settings of the smaller fits that a fit by given settings makes first: the draft, and the one on coarse grids."""

from __future__ import annotations

from .settings import SplashSplatConfig

# Of the draft: what a few seconds allow, the first ones before its background; and how many more where Gaussians show
# what is behind them, as these learn for longer, and nothing else is shown for twenty seconds.
_DRAFT_ITERATIONS, _DRAFT_BEFORE_BACKGROUND, _TRANSMITTING_DRAFT = 400, 0.25, 1.5
# How far beyond the surface carriers of opaque liquid are born, in voxels.
_DRAFT_SHELL_OUTSIDE = 0.125
# And the edge of its hull voxels in pixels, and how few there are at least.
_DRAFT_PIXELS, _DRAFT_FEWEST = 1.6, 112
# Hull cells of the coarse grids, at most. Edge of their voxels at the least, in fine ones: in an opaque container, and
# in a transparent one.
_COARSE_CELLS, _COARSE_PIXELS, _COARSE_PIXELS_CLEAR = 160, 1.8, 1.5


def draft_of(config: SplashSplatConfig, opaque: bool = False) -> SplashSplatConfig:
    """Of the draft: coarse carriers of each frame alone, and few iterations. opaque: whether nothing is known to show
    through the liquid."""
    longer = _TRANSMITTING_DRAFT if config.transmission == "always" else 1.0
    return config.model_copy(
        update={
            # So coarse a surface is off by a part of a voxel. Carriers beyond it make clear liquid too wide.
            "shell_outside": max(config.shell_outside, _DRAFT_SHELL_OUTSIDE if opaque else 0.0),
            "hull_cells": max(16, config.draft_cells),
            "transport_cells": max(16, config.draft_cells // 2),
            "voxel_pixels": _DRAFT_PIXELS,
            "clear_voxel_pixels": _DRAFT_PIXELS,
            "fewest_cells": _DRAFT_FEWEST,
            "control_cells": 4,
            "observable": False,
            "detect_failed_masks": False,
            "tight_bounds": False,
            "cut_at_rim": False,
            "pool": False,
            "ballistic": False,
            "variant": "per_frame",
            "interior_per_cell": 1,
            "shell_depth": 3.0,
            "still_cell": 0.0,
            "iterations": round(longer * _DRAFT_ITERATIONS),
            "coarse_grids_share": 0.0,
            "validation_share": 0.0,
            "idle_share": 0.0,
            "glass": 0,
            "plates_share": _DRAFT_BEFORE_BACKGROUND / longer,
            # What it takes to measure what may be stored how coarsely is worth it for a fit that is kept.
            "storage_tolerance": 0.0,
        }
    )


def coarse_of(config: SplashSplatConfig) -> SplashSplatConfig:
    """Of the fit on coarse grids that the fit begins with."""
    return config.model_copy(
        update={
            "hull_cells": _coarser(config.hull_cells, _COARSE_CELLS, 16),
            "transport_cells": _coarser(config.transport_cells, _COARSE_CELLS // 2, 8),
            "control_cells": _coarser(config.control_cells, _COARSE_CELLS // 8, 4),
            "fewest_cells": _coarser(config.fewest_cells, _COARSE_CELLS, 16),
            "voxel_pixels": _COARSE_PIXELS * config.voxel_pixels,
            "clear_voxel_pixels": _COARSE_PIXELS_CLEAR * config.clear_voxel_pixels,
            "observable_share": _COARSE_PIXELS_CLEAR * config.observable_share,
            "cell_capacity": 6,
            "min_per_cell": 3,
            "max_per_cell": 4,
            "shell_outside": 0.125,
            "iterations": config.coarse_iterations,
            "coarse_grids_share": 0.0,
            "coarse_share": 1.0,
            "coarsest_share": 1.0 if config.coarsest_share > 0 else 0.0,
            "plates_share": 0.0,  # nothing else comes behind the liquid
            "storage_tolerance": 0.0,
        }
    )


def _coarser(cells: int, most: int, fewest: int) -> int:
    return max(fewest, min(most, round(cells / _COARSE_PIXELS)))

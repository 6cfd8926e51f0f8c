"""Settings of SpacetimeGaussians: "paper" has the recommended ones, "quick" fits on two cores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field

from splashbench.gaussians.settings import SplattingSettings


class SpacetimeSettings(SplattingSettings):
    """How Gaussians with a time of their own are fitted; besides what all baselines share:

    Attributes:
        new_times: times of Gaussians made from others: "anywhere" in the recording, as published, or "kept".
        hull_log_width: logarithm of how long points of the hull last at the start, in recordings.
        guided_from, guided_until: shares between which Gaussians are placed where the worst view errs (guided.py),
            every `guided_every` steps; equal for never. guided_patches: patches of pixels each time.
    """

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "quick": {
            "iterations": 6000, "views_per_step": 1, "hull_points": 40_000, "max_gaussians": 60_000, "rate_factor": 1.5,
            "color_factor": 2.0, "new_times": "kept", "start_opacity": 0.1,
        },
        "paper": {
            "iterations": 30_000, "views_per_step": 2, "static": "points", "static_points": 100_000,
            "hull_points": 200_000, "start_opacity": 0.1, "max_gaussians": 1_000_000, "grow_from": 0.02,
            "grow_until": 0.06, "prune_until": 0.2333, "reset_every": 3000, "reset_until": 0.3, "rates": "published",
            "longest_side": 16384, "guided_from": 0.0533, "guided_until": 0.1, "hull_log_width": -2.0,
        },
    }  # fmt: skip
    #: the third rung has the size and the steps of "quick"
    capacity: ClassVar[Mapping[str, Sequence[Any]]] = {
        "iterations": (1500, 3000, 6000, 12_000, 24_000),
        "static_points": (1500, 3000, 6000, 12_000, 24_000),
        "hull_points": (10_000, 20_000, 40_000, 80_000, 160_000),
        "max_gaussians": (15_000, 30_000, 60_000, 120_000, 240_000),
    }

    new_times: Literal["anywhere", "kept"] = "anywhere"
    hull_log_width: float = Field(default=-3.0, ge=-10, le=3)
    guided_from: float = Field(default=0.0, ge=0, le=1)
    guided_until: float = Field(default=0.0, ge=0, le=1)
    guided_every: int = Field(default=200, ge=1)
    guided_patches: int = Field(default=32, ge=1, le=100_000)

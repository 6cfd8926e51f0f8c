"""Settings of 4D-Scaffold-GS: "paper" has the recommended ones, "quick" fits on two cores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field

from splashbench.gaussians.settings import DynamicFitSettings


class Scaffold4DSettings(DynamicFitSettings):
    """How anchors in space-time are fitted; besides what all baselines share:

    Attributes:
        children: Gaussians per anchor, K.
        max_anchors: anchors at most, grown ones included.
        duration: how long Gaussians of the hull show at the start, in frames.
        beta: exponent of the fading in time.
        fastest: speed that no Gaussian exceeds along an axis, extents of the cameras per second.
        base_color: a base colour per anchor, which the colour head corrects; 4D-Scaffold-GS has none.
        voxel: finest cell in which anchors grow, times the median spacing of the points at the start.
        prune_opacity: anchors whose children's mean opacities add up to less are dropped.
        count_from: share of the steps after which the pulls and opacities are counted that growth goes by; at the
            latest after `grow_from`.
        spread_start: features start at random and children spread over their anchor's cell, else both at zero.
        volume_unit: the unit of length in which volumes are penalised, the points' median "spacing" or the "scene"'s.
    """

    renamed: ClassVar[Mapping[str, str]] = {"most": "max_anchors"}
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "quick": {
            "iterations": 3600, "views_per_step": 1, "static_points": 8000, "hull_points": 30_000, "children": 2,
            "max_anchors": 50_000, "rate_factor": 1.5, "voxel": 0.1, "grow_from": 0.05, "grow_until": 0.35,
            "grow_every": 70,
        },
        "paper": {
            "iterations": 120_000, "views_per_step": 1, "static": "points", "static_points": 100_000,
            "hull_points": 100_000, "children": 10, "max_anchors": 500_000, "fastest": 1.0, "base_color": False,
            # Published in steps: counted from 500, rounds after 1 500 and before 60 000.
            "count_from": 1 / 240, "grow_from": 0.0125, "grow_until": 0.49999, "rates": "published",
            "longest_side": 16384,
        },
    }  # fmt: skip
    #: the third rung has the anchors and the steps of "quick"
    capacity: ClassVar[Mapping[str, Sequence[Any]]] = {
        "iterations": (900, 1800, 3600, 7200, 14_400),
        "static_points": (2000, 4000, 8000, 16_000, 32_000),
        "hull_points": (7500, 15_000, 30_000, 60_000, 120_000),
        "max_anchors": (12_500, 25_000, 50_000, 100_000, 200_000),
    }

    children: int = Field(default=3, ge=1, le=32)
    max_anchors: int = Field(default=20_000, ge=10, le=5_000_000)
    duration: float = Field(default=1.5, gt=0, le=10_000)
    beta: float = Field(default=4.0, ge=1, le=16)
    fastest: float = Field(default=5.0, gt=0, le=10_000)
    base_color: bool = True
    voxel: float = Field(default=1.0, gt=0, le=100)
    prune_opacity: float = Field(default=0.005, ge=0, lt=1)
    count_from: float = Field(default=1.0, ge=0, le=1)
    spread_start: bool = False
    volume_unit: Literal["spacing", "scene"] = "scene"
    # Without growth by default, unlike other baselines.
    hull_points: int = Field(default=10_000, ge=0, le=5_000_000)
    grow_from: float = Field(default=0.0, ge=0, le=1)
    grow_until: float = Field(default=0.0, ge=0, le=1)
    grow_every: int = Field(default=100, ge=1, le=100_000)

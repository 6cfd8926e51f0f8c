"""Settings of 4D-Scaffold-GS: "paper" has the recommended ones, "quick" fits on two cores."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from pydantic import Field

from splashbench.harness.contract import MethodConfig


class Scaffold4DSettings(MethodConfig):
    """How anchors in space-time are fitted. Shares are of the iterations.

    Attributes:
        iterations: steps; views_per_step: training views of one timestep in each.
        static: where the anchors of the static scene come from, see gaussians/initialization.py; static_points, at
            most.
        hull_points: anchors of the liquid's hull, over all frames together.
        children: Gaussians per anchor, K.
        max_anchors: anchors at most, grown ones included.
        start_opacity: of every Gaussian.
        duration: how long Gaussians of the hull show at the start, in frames.
        beta: exponent of the fading in time.
        fastest: speed that no Gaussian exceeds along an axis, extents of the cameras per second.
        base_color: a base colour per anchor, which the colour head corrects; 4D-Scaffold-GS has none.
        voxel: finest cell in which anchors grow, times the median spacing of the points at the start.
        grow_from, grow_until: shares between which anchors grow and are pruned, every `grow_every` steps.
        grow_gradient: mean screen gradient (normalised device coordinates) above which they grow.
        prune_opacity: anchors whose children's mean opacities add up to less are dropped.
        rate_factor: times the learning rates of what every anchor has of its own.
        rates: learning rates as "published", or those of "short" fits, see gaussians/settings.py.
        longest_side: photographs are shrunk to this many pixels.
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
            "grow_from": 0.0125, "grow_until": 0.5, "rates": "published", "longest_side": 16384,
        },
    }  # fmt: skip

    iterations: int = Field(default=1000, ge=1, le=1_000_000)
    views_per_step: int = Field(default=5, ge=1, le=64)
    static: Literal["pixels", "points"] = "pixels"
    static_points: int = Field(default=6000, ge=10, le=5_000_000)
    hull_points: int = Field(default=10_000, ge=0, le=5_000_000)
    children: int = Field(default=3, ge=1, le=32)
    max_anchors: int = Field(default=20_000, ge=10, le=5_000_000)
    start_opacity: float = Field(default=0.6, gt=0, lt=1)
    duration: float = Field(default=1.5, gt=0, le=10_000)
    beta: float = Field(default=4.0, ge=1, le=16)
    fastest: float = Field(default=5.0, gt=0, le=10_000)
    base_color: bool = True
    voxel: float = Field(default=1.0, gt=0, le=100)
    grow_from: float = Field(default=0.0, ge=0, le=1)
    grow_until: float = Field(default=0.0, ge=0, le=1)
    grow_every: int = Field(default=100, ge=1, le=100_000)
    grow_gradient: float = Field(default=2e-4, gt=0)
    prune_opacity: float = Field(default=0.005, ge=0, lt=1)
    rate_factor: float = Field(default=1.0, gt=0, le=1000)
    rates: Literal["short", "published"] = "short"
    longest_side: int = Field(default=400, ge=16, le=16384)

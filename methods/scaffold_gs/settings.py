"""Settings of the static background and its presets.

"paper" is the background of SplashSplat (supplement, "Implementation Details") with the constants of Scaffold-GS;
the others see more of the recording and start from denser anchors, so that far fewer steps do.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from pydantic import Field

from splashbench.harness.contract import MethodConfig


class BackgroundSettings(MethodConfig):
    """How a static background is fitted.

    Attributes:
        frames: what a view's plate is made of: the median over "all" frames in which a pixel is free of liquid, or the
            "first" frame alone.
        start: where the anchors start: "pixels" lifts every training pixel to its depth (plane sweep), "points" takes
            the scene's sparse points, one anchor per voxel, or points of the liquid's hull where there are none.
        iterations: optimisation steps, one training view each.
        max_anchors: at most this many anchors, grown ones included.
        children: Gaussians per anchor, k of Scaffold-GS.
        longest_side: images are shrunk to this many pixels for fitting; rendering is at any size.
        coarse_side: the fit begins on images of at most this many pixels and doubles them until they are whole.
        ssim_every: the structural term is computed every so many steps and weighted up accordingly.
        view_dependent_shape: also give the view direction to the opacity and covariance heads, as Scaffold-GS does.
        base_color: a base colour per anchor, which the colour head corrects; Scaffold-GS has none.
        rates: learning rates as "published", or larger ones for "short" fits.
        rates_until: share of the iterations at which the learning rates have fallen to their last value; above 1 where
            the fit ends before.
        spread_start: features start at random and children spread over their anchor's cell, else both at zero.
        volume_unit: the unit of length in which volumes are penalised, the anchors' median "spacing" or the "scene"'s.
        grow_from, grow_until: share of the iterations after which anchors are first added and pruned, and no longer
            are; equal for never.
        count_from: share of the iterations after which the pulls and opacities are counted that growth goes by; at the
            latest after `grow_from`.
        grow_every: steps between two rounds of growth.
        grow_gradient: mean gradient of the 2-D means (normalised device coordinates) above which a voxel gets an
            anchor, tau_g of Scaffold-GS at its coarsest level.
        prune_opacity: anchors whose children's mean opacities add up to less are dropped.
    """

    renamed: ClassVar[Mapping[str, str]] = {"anchors": "max_anchors"}
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "best": {},
        "paper": {
            "frames": "first", "start": "points", "iterations": 20_000, "max_anchors": 100_000, "children": 10,
            "longest_side": 16384, "coarse_side": 16384, "ssim_every": 1, "view_dependent_shape": True,
            "base_color": False, "rates": "published", "rates_until": 1.5, "spread_start": False,
            "volume_unit": "scene",
            # Published in steps: counted from 500, rounds after 1 500 and before 15 000, rates until 30 000.
            "count_from": 0.025, "grow_from": 0.075, "grow_until": 0.74995,
        },
        "brief": {"iterations": 500},
        "quick": {"iterations": 400, "max_anchors": 5_000, "longest_side": 400},
    }  # fmt: skip

    frames: Literal["all", "first"] = "all"
    start: Literal["pixels", "points"] = "pixels"
    iterations: int = Field(default=1000, ge=1, le=1_000_000)
    max_anchors: int = Field(default=15_000, ge=10, le=5_000_000)
    children: int = Field(default=2, ge=1, le=32)
    longest_side: int = Field(default=800, ge=16, le=16384)
    coarse_side: int = Field(default=400, ge=16, le=16384)
    ssim_every: int = Field(default=2, ge=1, le=1000)
    view_dependent_shape: bool = False
    base_color: bool = True
    rates: Literal["short", "published"] = "short"
    rates_until: float = Field(default=1.0, gt=0, le=1000)
    spread_start: bool = True
    volume_unit: Literal["spacing", "scene"] = "spacing"
    count_from: float = Field(default=1.0, ge=0, le=1)
    grow_from: float = Field(default=0.0, ge=0, le=1)
    grow_until: float = Field(default=0.0, ge=0, le=1)
    grow_every: int = Field(default=100, ge=1, le=100_000)
    grow_gradient: float = Field(default=2e-4, gt=0)
    prune_opacity: float = Field(default=0.005, ge=0, lt=1)

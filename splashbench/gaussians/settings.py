"""Settings that the baselines share: length of the fit, where Gaussians start, and how they come and go."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field

from splashbench.gaussians.density_control import DensitySettings
from splashbench.harness.contract import MethodConfig

# A Gaussian larger than this share of the cameras' extent is split rather than cloned.
_LARGE = 0.01


class DynamicFitSettings(MethodConfig):
    """How a dynamic set of Gaussians, or of anchors that make Gaussians, is fitted. Shares are of the iterations.

    Attributes:
        iterations: steps; views_per_step: training views of one timestep in each.
        static: where the points of the static scene come from, see gaussians/initialization.py; static_points, at most.
        hull_points: points of the liquid's hull, over all frames together.
        start_opacity: of every Gaussian.
        grow_from, grow_until: shares between which there is growth, every `grow_every` steps.
        grow_gradient: mean screen gradient (normalised device coordinates) above which there is.
        rate_factor: times the published learning rates of where Gaussians are and how they move.
        rates: whether every learning rate stays for a good third of the fit and has fallen to a fortieth by its last
            quarter ("short"), or as published.
        longest_side: photographs are shrunk to this many pixels.
    """

    iterations: int = Field(default=1000, ge=1, le=1_000_000)
    views_per_step: int = Field(default=5, ge=1, le=64)
    static: Literal["pixels", "points"] = "pixels"
    static_points: int = Field(default=6000, ge=10, le=5_000_000)
    hull_points: int = Field(default=4000, ge=0, le=5_000_000)
    start_opacity: float = Field(default=0.6, gt=0, lt=1)
    grow_from: float = Field(default=0.1, ge=0, le=1)
    grow_until: float = Field(default=0.5, ge=0, le=1)
    grow_every: int = Field(default=100, ge=1)
    grow_gradient: float = Field(default=2e-4, gt=0)
    rate_factor: float = Field(default=1.0, gt=0, le=1000)
    rates: Literal["short", "published"] = "short"
    longest_side: int = Field(default=400, ge=16, le=16384)


class SplattingSettings(DynamicFitSettings):
    """How a dynamic set of Gaussians is fitted that are cloned, split and pruned; besides `DynamicFitSettings`:

    Attributes:
        max_gaussians: Gaussians at most.
        prune_until: share until which faint ones are dropped.
        reset_every: steps between opacity resets, 0 for never; reset_until: share after which there are none.
        color_factor: times the published learning rates of colours and features.
    """

    renamed: ClassVar[Mapping[str, str]] = {"most": "max_gaussians"}

    max_gaussians: int = Field(default=20_000, ge=10, le=10_000_000)
    prune_until: float = Field(default=0.5, ge=0, le=1)
    reset_every: int = Field(default=0, ge=0)
    reset_until: float = Field(default=0.6, ge=0, le=1)
    color_factor: float = Field(default=1.0, gt=0, le=1000)

    def density(self, extent: float) -> DensitySettings:
        """When and where Gaussians come and go; `extent` of the cameras, scene units."""
        return DensitySettings(
            start=round(self.grow_from * self.iterations),
            stop=round(self.grow_until * self.iterations),
            every=self.grow_every,
            gradient=self.grow_gradient,
            large=_LARGE * extent,
            max_gaussians=self.max_gaussians,
            prune_until=round(self.prune_until * self.iterations),
            reset_every=self.reset_every,
            reset_until=round(self.reset_until * self.iterations),
        )

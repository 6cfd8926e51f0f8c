"""Settings of Deformable-3DGS: "paper" has the recommended ones for real scenes, "quick" fits on two cores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field

from splashbench.gaussians.settings import SplattingSettings


class DeformableSettings(SplattingSettings):
    """How canonical Gaussians and their deformation are fitted; besides what all baselines share:

    Attributes:
        warm_up: share of the iterations in which the network does not take part yet.
        time_noise: standard deviation of the noise on a step's time at the start, in frames; it falls to 0 over
            the share `time_noise_until`.
        time_noise_unit: the frame that `time_noise` is in: the duration of a "timestep", or as in the official code
            that of the recording by the "photographs" that have not come yet in this round.
        depth, width: of the network.
        network_factor: times the published learning rate of the network. head_factor: times that, the rate of the heads
            for shifts and turns, growth_factor, of the head for growths; as published, 1.
        network_steps: whether the layers' matrices learn by "adam", as published, or by "muon", in fewer steps;
            then their biases learn at a tenth of the rate.
        sh_degree: of the colours; one degree more every `sh_every` steps.
    """

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "quick": {
            "iterations": 8000, "views_per_step": 1, "static_points": 2500, "hull_points": 2500, "max_gaussians": 6000,
            "color_factor": 4.0, "warm_up": 0.02, "depth": 4, "width": 64, "network_factor": 4.0, "head_factor": 0.03,
            "growth_factor": 0.003, "network_steps": "muon",
        },
        "paper": {
            "iterations": 20_000, "views_per_step": 1, "warm_up": 0.15, "time_noise_until": 1.0,
            "time_noise_unit": "photographs", "depth": 8, "width": 256, "sh_degree": 3, "sh_every": 1000,
            "static": "points", "static_points": 100_000, "hull_points": 100_000, "start_opacity": 0.1,
            "max_gaussians": 500_000, "grow_from": 0.025, "grow_until": 0.75, "prune_until": 0.75,
            "reset_every": 3000, "reset_until": 0.75, "rates": "published", "longest_side": 16384,
        },
    }  # fmt: skip
    #: the third rung has the Gaussians, the width and the steps of "quick"
    capacity: ClassVar[Mapping[str, Sequence[Any]]] = {
        "iterations": (2000, 4000, 8000, 16_000, 32_000),
        "static_points": (625, 1250, 2500, 5000, 10_000),
        "hull_points": (625, 1250, 2500, 5000, 10_000),
        "max_gaussians": (1500, 3000, 6000, 12_000, 24_000),
        "width": (32, 48, 64, 96, 128),
    }

    warm_up: float = Field(default=0.1, ge=0, le=1)
    time_noise: float = Field(default=0.1, ge=0, le=10)
    time_noise_unit: Literal["timestep", "photographs"] = "timestep"
    time_noise_until: float = Field(default=0.5, gt=0, le=1)
    depth: int = Field(default=8, ge=2, le=32)
    width: int = Field(default=96, ge=4, le=1024)
    network_factor: float = Field(default=1.0, gt=0, le=1000)
    head_factor: float = Field(default=1.0, gt=0, le=1000)
    growth_factor: float = Field(default=1.0, gt=0, le=1000)
    network_steps: Literal["adam", "muon"] = "adam"
    sh_degree: int = Field(default=1, ge=0, le=3)
    sh_every: int = Field(default=200, ge=1)

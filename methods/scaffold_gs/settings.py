"""Settings of the static background."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import Field

from splashbench.adapter.contract import MethodConfig


class BackgroundSettings(MethodConfig):
    """How a static background is fitted.

    Attributes:
        iterations: optimisation steps, one training view each (the paper: 20 000).
        anchors: at most this many anchors.
        children: Gaussians per anchor, K of Scaffold-GS.
        longest_side: images are shrunk to this many pixels for fitting; rendering is at any size.
        ssim_every: the structural term is computed every so many steps and weighted up accordingly.
        view_dependent_shape: also give the view direction to the opacity and covariance heads, as Scaffold-GS does.
    """

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "best": {},
        "paper": {
            "iterations": 20_000, "anchors": 60_000, "children": 10, "longest_side": 4096, "ssim_every": 1,
            "view_dependent_shape": True,
        },
        "quick": {"iterations": 400, "anchors": 5_000, "longest_side": 400},
    }  # fmt: skip

    iterations: int = Field(default=1500, ge=1, le=1_000_000)
    anchors: int = Field(default=15_000, ge=10, le=5_000_000)
    children: int = Field(default=2, ge=1, le=32)
    longest_side: int = Field(default=800, ge=16, le=16384)
    ssim_every: int = Field(default=2, ge=1, le=1000)
    view_dependent_shape: bool = False

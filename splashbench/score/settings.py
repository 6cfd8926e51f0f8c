"""Scoring protocol v1 as data: every choice the paper's wording leaves open, fixed, named and versioned.

Paper: "Metrics" and supplement "Evaluation Protocol"; docs/protocol.md gives the evidence for each value. A changed
setting changes the digest, and results of different digests never share a table.
"""

from __future__ import annotations

import hashlib
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class Protocol(BaseModel):
    """The settings of a scoring protocol; the defaults are protocol v1.

    Averages run over frames, then over views. Colours are sRGB in [0, 1], lengths of particle metrics are those of
    the released scenes (`reference_longest_side`).
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    version: Literal["v1"] = "v1"

    # Image metrics: only pixels of the mask count, on the scene's own images, which are never resampled.
    psnr_cap_db: float = Field(default=100.0, gt=0, le=1000, description="PSNR of two equal images")
    min_mask_pixels: int = Field(default=64, ge=1, description="frames with fewer mask pixels are skipped, and counted")
    outside_mask: Literal["black", "truth"] = Field(
        default="black", description="what SSIM and LPIPS see outside the mask, in both images"
    )
    ssim_sigma: float = Field(default=1.5, gt=0, le=100, description="pixels; the window reaches 3.5 sigma: 11 x 11")
    opacity_threshold: float = Field(default=0.5, gt=0, lt=1, description="foreground opacity counted as liquid (mIoU)")

    # Particle metrics.
    kernel_radius: float = Field(default=0.3, gt=0, description="Poly6 h, units of the released scenes")
    neighbours: int = Field(default=64, ge=1, le=100_000, description="nearest neighbours summed, self excluded")
    reference_longest_side: float = Field(
        default=3.0, gt=0, description="the hull's longest side after scaling; released scenes are not scaled"
    )
    particle_cap: int = Field(default=16_000, ge=1, le=10**7, description="larger sets are subsampled to this many")
    subsample_seeds: int = Field(default=5, ge=1, le=1000, description="subsamples averaged where the cap applies")
    shell_depth_voxels: float = Field(default=3.0, gt=0, description="uniform points: -depth <= phi <= 0")
    grid_cells: int = Field(default=96, ge=8, le=1024, description="cells of phi along the longest side")
    gravity_m_s2: float = Field(default=9.81, gt=0)

    @property
    def digest(self) -> str:
        """SHA-256 over all settings."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()

    @property
    def label(self) -> str:
        """`v1` for the protocol as published, `v1+<digest>` for a changed one."""
        return self.version if self == PROTOCOL_V1 else f"{self.version}+{self.digest[:8]}"


PROTOCOL_V1 = Protocol()

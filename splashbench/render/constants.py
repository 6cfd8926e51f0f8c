"""The numbers that fix what an image of Gaussians is: those of gsplat 1.5.3 in its classic mode.

A reconstruction made elsewhere with gsplat renders the same here. The Inria rasterizer differs in the near plane (0.2)
and the largest alpha (0.99). The CPU kernel has these numbers in kernel/constants.h.
"""

from __future__ import annotations

NEAR_PLANE = 0.01
"""Gaussians whose centre lies nearer than this along the optical axis are not drawn; scene units."""

BLUR_VARIANCE = 0.3
"""Added to the diagonal of every projected covariance, px^2: no Gaussian is thinner than about half a pixel."""

MIN_ALPHA = 1.0 / 255.0
"""Contributions below one grey level are skipped, which gives every Gaussian a finite footprint."""

MAX_ALPHA = 0.999
"""Alpha is clamped here; a clamped pixel passes no gradient to opacity, mean or covariance."""

MIN_TRANSMITTANCE = 1e-4
"""A Gaussian that would push a pixel's transmittance to this or below is left out, and so is everything behind it."""

JACOBIAN_MARGIN = 0.15
"""The projection is linearised at most this share of the image size beyond the image's edges."""

TILE_WIDTH = 64
TILE_HEIGHT = 32
"""Tiles are composited on their own; their size affects speed only, never the image."""

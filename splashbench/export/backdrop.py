"""The one colour behind all Gaussians, which a file of Gaussians cannot state.

Where a background's Gaussians let light through, a method shows a colour of its own. On a viewer's black they look
speckled: 17 dB instead of 37.6 to 42.7 (docs/exports.md). So the colour is told, as the viewer's background, or drawn
as a sphere (sphere.py).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splashbench.render import rasterize_arrays
from splashbench.replay import Reconstruction

# Longest side of the views that are compared, pixels: the colour is the same in small ones.
_SIDE = 240
# Where all Gaussians together let less than this through, as a mean over pixels, no colour shows.
_SHOWS = 1e-3


def backdrop_color(reconstruction: Reconstruction) -> NDArray[np.float64] | None:
    """The colour [3], sRGB in [0, 1], that shows through the background's Gaussians; None where none does.

    It is the least-squares fit to the method's views without liquid, over the training cameras.
    """
    total, weight, pixels = np.zeros(3), 0.0, 0
    for name in reconstruction.train:
        camera = reconstruction.cameras[name]
        camera = camera.scaled(min(1.0, _SIDE / max(camera.width, camera.height)))
        static, view = reconstruction.static_gaussians(camera.center), reconstruction.empty_view(camera)
        if static is None or view is None:
            return None
        drawn, opacity = rasterize_arrays(static.means, static.factors, static.opacities, static.colors, camera)
        through = 1.0 - opacity.astype(np.float64)
        total += ((view - drawn) * through[..., None]).sum(axis=(0, 1))
        weight += float((through**2).sum())
        pixels += through.size
    return np.clip(total / weight, 0, 1) if weight > _SHOWS**2 * pixels else None

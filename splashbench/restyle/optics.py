"""Light at a liquid's surface and within it (paper, supplement, "Style transfer").

Transmittance T_c = exp(-sigma_c l) per channel (Beer-Lambert; Max 1995), reflectance after Schlick 1994, and the place
where the bent ray meets what lies behind the liquid. All light is linear.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.replay.interface import Interface, rays
from splashbench.scene import Camera

#: Of water, and within 2 % of most dyed water and spirits.
REFRACTIVE_INDEX = 1.333

Image = NDArray[np.float32]

# Standard deviation, in pixels, over which normals are averaged, and the cosine from which they count.
_SMOOTHING, _LEAST_FACING = 1.5, 0.05


def transmittance(length: Image, absorption: NDArray) -> Image:
    """T [..., 3] after `length` [...] in a liquid of `absorption` [3], in inverse units of the length."""
    return np.exp(-length[..., None] * np.asarray(absorption, np.float32)).astype(np.float32)


def smoothed(interface: Interface, camera: Camera) -> Interface:
    """`interface` with normals that are means over some pixels, of those that face `camera`.

    Where rays graze the surface, single normals point away from the camera, and would mirror all light.
    """
    if not interface.seen.any():
        return interface
    known = (_cosines(interface, camera) > _LEAST_FACING) & interface.seen
    summed = cv2.GaussianBlur(interface.normal * known[..., None], (0, 0), _SMOOTHING)
    size = np.linalg.norm(summed, axis=-1, keepdims=True)
    use = interface.seen[..., None] & (size > 1e-3)
    normal = np.where(use, summed / np.maximum(size, 1e-3), interface.normal)
    return replace(interface, normal=normal.astype(np.float32))


def _cosines(interface: Interface, camera: Camera) -> Image:
    """Cosines [H, W] between the normals and the ways to the camera; below 0 where a normal points away."""
    directions = rays(camera)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return np.asarray(-(directions * interface.normal).sum(-1), np.float32)


def facing(interface: Interface, camera: Camera) -> Image:
    """Cosine [H, W] in [0, 1] between the surface's normal and the way to the camera; 1 where no surface is seen."""
    return np.where(interface.seen, np.clip(_cosines(interface, camera), 0, 1), 1.0).astype(np.float32)


def reflectance(cosine: Image, index: float = REFRACTIVE_INDEX) -> Image:
    """Share [...] of light that a surface mirrors, seen at `cosine` [...] to its normal (Schlick 1994)."""
    head_on = ((index - 1) / (index + 1)) ** 2
    return (head_on + (1 - head_on) * (1 - cosine) ** 5).astype(np.float32)


def seen_through(background: Image, interface: Interface, camera: Camera, index: float) -> Image:
    """What is seen of `background` [H, W, 3] through the liquid: each ray is bent where it enters (Snell).

    The ray is followed to where it leaves the liquid; the background is taken to lie there, as the floor of a container
    does. Bending on the way out is left out, as the surface there is known least. `index` 1 bends nothing.
    """
    if index == 1 or not interface.seen.any():
        return background
    seen = interface.seen
    directions = rays(camera)[seen]
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    normal = interface.normal[seen].astype(np.float64)
    cosine = np.clip(-(unit * normal).sum(-1, keepdims=True), 0, 1)
    ratio = 1 / index
    bent = ratio * unit + (ratio * cosine - np.sqrt(np.maximum(1 - ratio**2 * (1 - cosine**2), 0))) * normal
    entered = camera.center + interface.depth[seen][:, None] * directions
    left, depth = camera.project(entered + interface.length[seen][:, None] * bent)
    ok = depth > 0
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32))
    u[seen] = np.where(ok, left[:, 0] - 0.5, u[seen])
    v[seen] = np.where(ok, left[:, 1] - 0.5, v[seen])
    return np.asarray(cv2.remap(background, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)

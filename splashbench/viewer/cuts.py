"""Cuts through the liquid's signed distance, as pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.scene import SignedDistance
from splashbench.scene.geometry import MAX_STEPS, STEPS_PER_VOXEL

AXES = ("x", "y", "z")
# Colours of a cut: liquid, the outline, and what is far outside. Opacities of 255.
_LIQUID, _OUTLINE, _OUTSIDE = np.array([45, 110, 220]), np.array([15, 25, 60]), np.array([225, 230, 238])
_INSIDE_OPACITY, _OUTSIDE_OPACITY = 230, 110
# Pixels of a cut per node, at the most, and pixels along its longer side that are enough.
_FINEST, _ENOUGH = 4, 400


@dataclass(frozen=True)
class Cut:
    """A picture of the signed distance on a plane across one of the scene's axes.

    Attributes:
        image: uint8 [h, w, 4], sRGB and opacity: liquid blue, its outline dark, outside pale.
        center: of the picture [3], scene units. right, down: unit vectors [3], the picture's axes in the scene.
        width, height: of the picture, scene units.
    """

    image: NDArray[np.uint8]
    center: NDArray[np.float64]
    right: NDArray[np.float64]
    down: NDArray[np.float64]
    width: float
    height: float


def cut(distance: SignedDistance, axis: int, share: float) -> Cut:
    """The first instant of `distance` across `axis` (0 to 2), at `share` in [0, 1] of the grid's extent along it."""
    phi = distance.phi[0]
    depth = float(np.clip(share, 0, 1)) * (phi.shape[axis] - 1)
    below = min(int(depth), phi.shape[axis] - 2)
    first, second = (np.take(phi, below + side, axis=axis).astype(np.float32) for side in (0, 1))
    plane = first + (depth - below) * (second - first)  # [nodes along u, nodes along v]
    u, v = (other for other in range(3) if other != axis)
    finer = int(np.clip(_ENOUGH // max(plane.shape), 1, _FINEST))
    image = _picture(_refined(plane, finer) / STEPS_PER_VOXEL, 1 / finer)
    center = distance.origin + 0.5 * (np.array(phi.shape) - 1) * distance.voxel
    center[axis] = distance.origin[axis] + depth * distance.voxel
    units = np.eye(3)
    # A pixel is as wide as the way between samples, so that the picture reaches half of one beyond the last node.
    sides = [distance.voxel * (plane.shape[k] - 1 + 1 / finer) for k in (0, 1)]
    return Cut(image, center, units[u], units[v], *sides)


def _refined(plane: NDArray[np.float32], finer: int) -> NDArray[np.float32]:
    """`plane` at `finer` times as many places, between the same ends, interpolated."""
    from scipy.ndimage import map_coordinates

    places = [np.linspace(0, n - 1, (n - 1) * finer + 1) for n in plane.shape]
    return np.asarray(map_coordinates(plane, np.meshgrid(*places, indexing="ij"), order=1), dtype=np.float32)


def _picture(voxels: NDArray[np.floating], pixel: float) -> NDArray[np.uint8]:
    """Distances [nu, nv] in voxels as a picture [nv, nu, 4] of pixels `pixel` voxels wide."""
    farthest = MAX_STEPS / STEPS_PER_VOXEL
    # Deep liquid is a little darker, far outside is paler.
    inside = _LIQUID * (1 - 0.35 * np.clip(-voxels[..., None] / farthest, 0, 1))
    outside = _OUTSIDE * (1 - 0.25 * (1 - np.clip(voxels[..., None] / farthest, 0, 1)))
    rgb = np.where(voxels[..., None] < 0, inside, outside)
    rgb[np.abs(voxels) < max(0.3, 0.75 * pixel)] = _OUTLINE
    alpha = np.where(voxels < 0, _INSIDE_OPACITY, _OUTSIDE_OPACITY)
    return np.concatenate([rgb, alpha[..., None]], axis=-1).astype(np.uint8).transpose(1, 0, 2)

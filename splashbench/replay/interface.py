"""The liquid's surface as a camera sees it: where rays enter the liquid, how it is turned there, how long they stay.

Rays step through the signed distance: as far as it allows while they are outside, and by half a voxel within reach of
the liquid, where a thin sheet must not be stepped over. Light is not bent on its way; who bends it starts from the
normals. The paper's supplement ("Style transfer") reads the same two quantities from the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from splashbench.observe.kernels import trilinear
from splashbench.parallel import over_range
from splashbench.scene import Camera, SignedDistance
from splashbench.scene.geometry import STEPS_PER_VOXEL

# Of a voxel: the step along a ray where the liquid is near.
_STEP = 0.5
# Of a voxel: how far phi is sampled to either side for the normal. The distance is stored in sixteenths.
_NORMAL_REACH = 1.5
# A surface is found to within this part of a step by halving it.
_HALVINGS = 6


@dataclass
class Interface:
    """The liquid's surface as a camera's pixels see it, at one instant.

    Attributes:
        depth: float32 [H, W], along the optical axis to where the ray enters the liquid, scene units; inf where it
            does not.
        normal: float32 [H, W, 3], unit vector out of the liquid where the ray enters it; 0 where it does not.
        length: float32 [H, W], how much of the ray lies in the liquid, scene units.
    """

    depth: NDArray[np.float32]
    normal: NDArray[np.float32]
    length: NDArray[np.float32]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """bool [H, W]: where a ray meets liquid."""
        return np.isfinite(self.depth)


def cast(surface: SignedDistance, camera: Camera) -> Interface:
    """The liquid of `surface`, which has one instant, as `camera` sees it. Raises ValueError for more."""
    if surface.n_frames != 1:
        raise ValueError(f"the surface has {surface.n_frames} instants, not one")
    size = (camera.height, camera.width)
    depth = np.full(size, np.inf, np.float32)
    normal, length = np.zeros((*size, 3), np.float32), np.zeros(size, np.float32)
    phi = np.ascontiguousarray(surface.phi[0])
    if (phi < 0).any():
        directions = rays(camera)
        eye = (camera.center - surface.origin) / surface.voxel
        low, high = liquid_box(phi)
        over_range(_cast, camera.height, phi, eye, directions, low, high, depth, normal, length)
    # Directions have a depth of 1, so that their parameter is the depth; their own length is a path's.
    depth *= np.float32(surface.voxel)
    length *= np.float32(surface.voxel)
    return Interface(depth, normal, length)


def rays(camera: Camera) -> NDArray[np.float64]:
    """Directions [H, W, 3] through the pixels' centres in the scene's axes, as long as makes their depth 1."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    return np.asarray(pixels @ np.linalg.inv(camera.K).T @ camera.w2c[:3, :3])


def liquid_box(phi: NDArray[np.int8]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners [3] of the box of nodes with liquid, a voxel wider on all sides."""
    inside = phi < 0
    spans = [np.flatnonzero(inside.any(axis=tuple(a for a in range(3) if a != axis))) for axis in range(3)]
    low = np.array([span[0] - 1.0 for span in spans])
    return low, np.array([span[-1] + 1.0 for span in spans])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _cast(
    phi: np.ndarray,
    eye: np.ndarray,
    directions: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    depth: np.ndarray,
    normal: np.ndarray,
    length: np.ndarray,
    start: int,
    stop: int,
) -> None:
    for row in range(start, stop):
        for column in range(directions.shape[1]):
            dx, dy, dz = directions[row, column, 0], directions[row, column, 1], directions[row, column, 2]
            # Where the ray is within the box.
            near, far = 1e-6, np.inf
            for axis in range(3):
                d = directions[row, column, axis]
                if abs(d) < 1e-12:
                    if eye[axis] < low[axis] or eye[axis] > high[axis]:
                        far = -1.0
                    continue
                one, other = (low[axis] - eye[axis]) / d, (high[axis] - eye[axis]) / d
                near, far = max(near, min(one, other)), min(far, max(one, other))
            if near >= far:
                continue
            speed = (dx * dx + dy * dy + dz * dz) ** 0.5
            s, before = near, 1.0
            inside, entered = False, 0.0
            while True:
                value = trilinear(phi, eye[0] + s * dx, eye[1] + s * dy, eye[2] + s * dz) / STEPS_PER_VOXEL
                if s > near and (value < 0) != inside:
                    # The crossing lies between the last place and here.
                    a, b = before, s
                    for _ in range(_HALVINGS):
                        m = 0.5 * (a + b)
                        if (trilinear(phi, eye[0] + m * dx, eye[1] + m * dy, eye[2] + m * dz) < 0) == inside:
                            a = m
                        else:
                            b = m
                    crossing = 0.5 * (a + b)
                elif s == near and value < 0:
                    crossing = s
                else:
                    crossing = -1.0
                if crossing >= 0:
                    if not inside:
                        entered = crossing
                        if not depth[row, column] < np.inf:
                            depth[row, column] = crossing
                            x, y, z = eye[0] + crossing * dx, eye[1] + crossing * dy, eye[2] + crossing * dz
                            r = _NORMAL_REACH
                            gx = trilinear(phi, x + r, y, z) - trilinear(phi, x - r, y, z)
                            gy = trilinear(phi, x, y + r, z) - trilinear(phi, x, y - r, z)
                            gz = trilinear(phi, x, y, z + r) - trilinear(phi, x, y, z - r)
                            size = (gx * gx + gy * gy + gz * gz) ** 0.5
                            if size > 0:
                                normal[row, column, 0] = gx / size
                                normal[row, column, 1] = gy / size
                                normal[row, column, 2] = gz / size
                    else:
                        length[row, column] += (crossing - entered) * speed
                    inside = not inside
                if s >= far:
                    break
                before = s
                # |phi| is no more than the distance to the surface, so nothing lies within it; a little less, as it is
                # interpolated.
                s = min(far, s + max(0.8 * abs(value) - 0.5, _STEP) / speed)
            if inside:
                length[row, column] += (far - entered) * speed

"""A camera with a real lens: pinhole plus the Brown-Conrady distortion that a calibration estimates.

Pixel centres lie at +0.5, as everywhere in splashbench (OpenCV's matrices have a principal point half a pixel less).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Rows of rays that are made at once: in double precision, those of a large image would take gigabytes.
_STRIP = 64


@dataclass(frozen=True, eq=False)
class LensCamera:
    """`K` [3, 3] pixels; `distortion` [5] = k1, k2, p1, p2, k3; `w2c` [4, 4] world-to-camera, OpenCV axes, metres."""

    width: int
    height: int
    K: Array
    distortion: Array
    w2c: Array

    @property
    def center(self) -> Array:
        """The camera's place in the world [3]."""
        return -self.w2c[:3, :3].T @ self.w2c[:3, 3]

    def moved(self, w2c: Array) -> LensCamera:
        """The same camera elsewhere."""
        return replace(self, w2c=w2c)

    def project(self, points: Array) -> tuple[Array, Array]:
        """World points [N, 3] to distorted pixels [N, 2] and depths [N]."""
        local = points @ self.w2c[:3, :3].T + self.w2c[:3, 3]
        uv = distort(local[:, :2] / local[:, 2:], self.distortion)
        return uv @ self.K[:2, :2].T + self.K[:2, 2], local[:, 2]

    def local_rays(self, samples: int, rows: range | None = None) -> Array:
        """Undistorted normalised coordinates [H * samples, W * samples, 2] of a grid of points in every pixel; or of
        the grid's `rows` alone."""
        x = (np.arange(self.width * samples) + 0.5) / samples
        y = (np.asarray(range(self.height * samples) if rows is None else rows) + 0.5) / samples
        u, v = np.meshgrid((x - self.K[0, 2]) / self.K[0, 0], (y - self.K[1, 2]) / self.K[1, 1])
        return undistort(np.stack([u, v], axis=-1), self.distortion)

    def rays(self, samples: int, local: Array | None = None) -> NDArray[np.float32]:
        """Unit view directions in the world [H * samples, W * samples, 3].

        local: the `local_rays` of so many samples, where they are known from the same lens in another place.
        """
        height, width = self.height * samples, self.width * samples
        rays = np.empty((height, width, 3), np.float32)
        for start in range(0, height, _STRIP):
            rows = range(start, min(start + _STRIP, height))
            strip = self.local_rays(samples, rows) if local is None else local[rows.start : rows.stop]
            directions = np.concatenate([strip, np.ones_like(strip[..., :1])], axis=-1) @ self.w2c[:3, :3]
            directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
            rays[rows.start : rows.stop] = directions
        return rays


def distort(normalised: Array, coefficients: Array) -> Array:
    """Pinhole coordinates [..., 2] to distorted ones (Brown 1971)."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = normalised[..., 0], normalised[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def undistort(distorted: Array, coefficients: Array, iterations: int = 12) -> Array:
    """Inverse of `distort` by fixed-point iteration, which converges fast for the mild lenses here."""
    guess = distorted
    if not np.any(coefficients):
        return guess
    for _ in range(iterations):
        guess = guess + (distorted - distort(guess, coefficients))
    return guess

"""A camera's lens: pinhole matrix and Brown-Conrady distortion, in the project's pixel convention.

Raw frames are distorted; scenes hold undistorted pinhole images (paper Sec. 3, "Capture and calibration"). Every step
of `prepare` that needs a lens uses this class, so that the half-pixel between conventions is handled in one place:
here pixel centres lie at +0.5 (as in COLMAP and in `splashbench.scene.camera`), whereas OpenCV puts them at whole
numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splashbench.arrays import Floats

Array = Floats
OPENCV_PIXEL_SHIFT = 0.5  # our pixel coordinate minus OpenCV's, for the same point of the image


@dataclass(frozen=True, eq=False)
class Lens:
    """Intrinsics of one camera.

    `K`: [3, 3], pixels, pixel centres at +0.5. `distortion`: [5] = k1, k2, p1, p2, k3 (OpenCV's order), acting on
    normalised coordinates.
    """

    width: int
    height: int
    K: Array
    distortion: Array

    @classmethod
    def from_opencv(cls, width: int, height: int, K: Array, distortion: Array) -> Lens:
        """From a calibration of OpenCV, whose pixel centres are whole numbers."""
        shifted = np.asarray(K, np.float64).copy()
        shifted[:2, 2] += OPENCV_PIXEL_SHIFT
        coefficients = np.zeros(5)
        known_coefficients = np.asarray(distortion, np.float64).ravel()[:5]
        coefficients[: len(known_coefficients)] = known_coefficients
        return cls(width, height, shifted, coefficients)

    @property
    def focal(self) -> float:
        """Mean focal length in pixels."""
        return float((self.K[0, 0] + self.K[1, 1]) / 2)

    def opencv_K(self) -> Array:
        """The matrix as OpenCV's functions want it: [3, 3]."""
        K = self.K.copy()
        K[:2, 2] -= OPENCV_PIXEL_SHIFT
        return K

    def distort(self, normalised: Array) -> Array:
        """Normalised pinhole coordinates [N, 2] to normalised distorted coordinates [N, 2]."""
        return _brown_conrady(normalised, self.distortion)[0]

    def undistort(self, normalised: Array, iterations: int = 20) -> Array:
        """Inverse of `distort` by Newton's method: [N, 2] to [N, 2]. Converges wherever the lens model is
        invertible."""
        target = np.asarray(normalised, np.float64)
        guess = target.copy()
        for _ in range(iterations):
            value, jacobian = _brown_conrady(guess, self.distortion)
            step = np.linalg.solve(jacobian, (value - target)[..., None])[..., 0]
            guess = guess - step
            if np.abs(step).max(initial=0.0) < 1e-12:
                break
        return guess

    def project(self, points: Array) -> Array:
        """Points in camera coordinates [N, 3] (z > 0) to pixels of the raw frame [N, 2]."""
        distorted = self.distort(points[:, :2] / points[:, 2:])
        return distorted @ self.K[:2, :2].T + self.K[:2, 2]

    def normalise(self, pixels: Array) -> Array:
        """Pixels of the raw frame [N, 2] to pinhole coordinates [N, 2] (a ray is (x, y, 1))."""
        return self.undistort((pixels - self.K[:2, 2]) @ np.linalg.inv(self.K[:2, :2]).T)


def _brown_conrady(points: Array, coefficients: Array) -> tuple[Array, Array]:
    """Brown-Conrady distortion and its Jacobian: [N, 2] to ([N, 2], [N, 2, 2])."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = points[:, 0], points[:, 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    d_radial = k1 + r2 * (2 * k2 + 3 * k3 * r2)  # derivative with respect to r2
    value = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=1,
    )
    off_diagonal = 2 * x * y * d_radial + 2 * p1 * x + 2 * p2 * y
    jacobian = np.stack(
        [
            np.stack([radial + 2 * x * x * d_radial + 2 * p1 * y + 6 * p2 * x, off_diagonal], axis=1),
            np.stack([off_diagonal, radial + 2 * y * y * d_radial + 6 * p1 * y + 2 * p2 * x], axis=1),
        ],
        axis=1,
    )
    return value, jacobian

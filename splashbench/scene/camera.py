"""A pinhole camera in the OpenCV convention: x right, y down, z forward; world-to-camera 4x4; no distortion.

Pixel centres lie at +0.5: pixel (row i, column j) covers [j, j+1] x [i, i+1], and a point at camera coordinates
(x, y, z) falls on u = fx x / z + cx, v = fy y / z + cy in that frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Of entries that are 0 or 1 in every pinhole camera.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Camera:
    """One calibrated view.

    Attributes:
        name: the camera's folder name, such as "3".
        width, height: image size in pixels.
        K: intrinsics [3, 3], pixels.
        w2c: world-to-camera [4, 4], rigid, scene units.
    """

    name: str
    width: int
    height: int
    K: NDArray[np.float64] = field(repr=False)
    w2c: NDArray[np.float64] = field(repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", np.array(self.K, dtype=np.float64))
        object.__setattr__(self, "w2c", np.array(self.w2c, dtype=np.float64))
        if self.K.shape != (3, 3) or self.w2c.shape != (4, 4):
            raise ValueError(f"camera {self.name}: K is {self.K.shape} and w2c {self.w2c.shape}, not 3x3 and 4x4")
        if not (np.isfinite(self.K).all() and np.isfinite(self.w2c).all()):
            raise ValueError(f"camera {self.name}: K or w2c has entries that are not finite")
        if self.width < 1 or self.height < 1 or self.K[0, 0] <= 0 or self.K[1, 1] <= 0:
            raise ValueError(f"camera {self.name}: image size and focal lengths must be positive")
        if np.abs([self.K[1, 0], self.K[2, 0], self.K[2, 1], self.K[2, 2] - 1]).max() > _ROUNDING:
            raise ValueError(f"camera {self.name}: K is not that of a pinhole (fx s cx, 0 fy cy, 0 0 1)")
        if np.abs(self.w2c[3] - [0, 0, 0, 1]).max() > _ROUNDING:
            raise ValueError(f"camera {self.name}: w2c does not end in 0 0 0 1; it may be transposed")
        rotation = self.w2c[:3, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
            raise ValueError(f"camera {self.name}: w2c does not hold a rotation")
        # What is rounding is taken out: renderers and files ask for a pinhole to the last bit.
        self.K[1:, 0], self.K[2] = 0, (0, 0, 1)
        if abs(self.K[0, 1]) <= _ROUNDING * self.K[0, 0]:
            self.K[0, 1] = 0
        self.w2c[3] = 0, 0, 0, 1
        self.K.setflags(write=False)
        self.w2c.setflags(write=False)

    @property
    def center(self) -> NDArray[np.float64]:
        """The camera's position in the world [3], scene units."""
        return -self.w2c[:3, :3].T @ self.w2c[:3, 3]

    @property
    def projection(self) -> NDArray[np.float64]:
        """K @ w2c[:3], [3, 4]: homogeneous world points to homogeneous pixels."""
        return self.K @ self.w2c[:3]

    def project(self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixels [N, 2] and depths [N] of world points [N, 3]; a depth <= 0 means the pixel is meaningless."""
        world = np.asarray(points, dtype=np.float64)
        local = world @ self.w2c[:3, :3].T + self.w2c[:3, 3]
        depth = local[:, 2]
        safe = np.where(np.abs(depth) < 1e-12, 1e-12, depth)
        homogeneous = local @ self.K.T
        return homogeneous[:, :2] / safe[:, None], depth

    def cropped(self, x0: int, y0: int, width: int, height: int) -> Camera:
        """The camera of the window whose top-left pixel is (x0, y0): only the principal point moves."""
        K = self.K.copy()
        K[0, 2] -= x0
        K[1, 2] -= y0
        return replace(self, width=width, height=height, K=K)

    def binned(self, factor: int) -> Camera:
        """The camera whose pixels are squares of `factor` by `factor` of these; at the edges what there is of a square
        counts as a whole one."""
        K = np.diag([1 / factor, 1 / factor, 1.0]) @ self.K
        return replace(self, width=-(-self.width // factor), height=-(-self.height // factor), K=K)

    def scaled(self, factor: float) -> Camera:
        """The camera of the image resized by `factor`; sizes are rounded, K scaled by the true ratios per axis."""
        width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        K = np.diag([width / self.width, height / self.height, 1.0]) @ self.K
        return replace(self, width=width, height=height, K=K)


def look_at(
    eye: ArrayLike, target: ArrayLike = (0.0, 0.0, 0.0), up: ArrayLike = (0.0, 1.0, 0.0)
) -> NDArray[np.float64]:
    """World-to-camera matrix [4, 4] of a camera at `eye` that looks at `target`, both [3] in scene units.

    up: direction [3] that is upwards in the image. Raises ValueError where it is parallel to the view.
    """
    forward = np.asarray(target, dtype=np.float64) - np.asarray(eye, dtype=np.float64)
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if not np.linalg.norm(right) > 0:
        raise ValueError("the camera looks along the direction that should be up; give another up")
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    w2c = np.eye(4)
    w2c[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    w2c[:3, 3] = -w2c[:3, :3] @ np.asarray(eye, dtype=np.float64)
    return w2c

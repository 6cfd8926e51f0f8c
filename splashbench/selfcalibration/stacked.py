"""Cameras of all views as arrays, many guesses of them at once: where their rays meet, and how they see points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.scene import Camera

from .features import Tracks


@dataclass(frozen=True)
class StackedCameras:
    """Cameras of all views, or several guesses of them at once (...). K, R: [..., V, 3, 3], intrinsics and rotations
    from the world. centers: [..., V, 3]. k1: [...], distortion of all views."""

    K: NDArray[np.float64]
    R: NDArray[np.float64]
    centers: NDArray[np.float64]
    k1: NDArray[np.float64]

    @classmethod
    def of(cls, cameras: Mapping[str, Camera], views: Sequence[str], k1: float = 0.0) -> StackedCameras:
        """Those named `views`, in this order."""
        chosen = [cameras[name] for name in views]
        return cls(
            np.stack([camera.K for camera in chosen]),
            np.stack([camera.w2c[:3, :3] for camera in chosen]),
            np.stack([camera.center for camera in chosen]),
            np.asarray(k1, dtype=np.float64),
        )

    def placed(self, tracks: Tracks) -> NDArray[np.float64]:
        """Where the rays of each of `tracks` meet best, [..., N, 3]."""
        seen = tracks.seen.T[..., None]
        pixels = np.where(seen, tracks.pixels.transpose(1, 0, 2), 0.0)
        whole = np.concatenate([pixels, np.ones((*pixels.shape[:-1], 1))], axis=-1)
        rays = self._straight(whole @ np.linalg.inv(self.K).swapaxes(-1, -2)) @ self.R
        rays *= seen / np.linalg.norm(rays, axis=-1, keepdims=True)
        across = tracks.seen.sum(axis=1)[:, None, None] * np.eye(3) - np.einsum("...vni,...vnj->...nij", rays, rays)
        along = np.einsum("...vni,...vi->...vn", rays, self.centers)
        right = np.einsum("nv,...vi->...ni", tracks.seen, self.centers) - np.einsum("...vni,...vn->...ni", rays, along)
        return np.asarray(np.linalg.solve(across + 1e-12 * np.eye(3), right[..., None])[..., 0])

    def _straight(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """`rays` [..., V, N, 3] in the cameras' frames, without the distortion."""
        if not self.k1.any():
            return rays
        k1, bent = self.k1[..., None, None, None], rays[..., :2]
        straight = bent
        for _ in range(8):
            straight = bent / (1 + k1 * (straight**2).sum(axis=-1, keepdims=True))
        return np.concatenate([straight, rays[..., 2:]], axis=-1)

    def errors(self, tracks: Tracks, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far off in pixels `points` [..., N, 3] are seen from where `tracks` are, [..., N, V, 2]."""
        local = (points[..., None, :, :] - self.centers[..., :, None, :]) @ self.R.swapaxes(-1, -2)
        flat = local[..., :2] / np.where(np.abs(local[..., 2:]) < 1e-9, 1e-9, local[..., 2:])
        flat = flat * (1 + self.k1[..., None, None, None] * (flat**2).sum(axis=-1, keepdims=True))
        seen_at = flat @ self.K[..., :2, :2].swapaxes(-1, -2) + self.K[..., None, :2, 2]
        return np.asarray(seen_at.swapaxes(-2, -3) - tracks.pixels)

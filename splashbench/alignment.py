"""Points from several views, and the similarity that aligns two sets of points (Umeyama, IEEE TPAMI 13(4), 1991)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splashbench.arrays import Floats


@dataclass(frozen=True, eq=False)
class Similarity:
    """x -> scale * rotation @ x + translation."""

    scale: float
    rotation: Floats  # [3, 3]
    translation: Floats  # [3]

    def apply(self, points: Floats) -> Floats:
        """Map points [..., 3]."""
        return self.scale * points @ self.rotation.T + self.translation

    def apply_w2c(self, w2c: Floats) -> Floats:
        """World-to-camera [4, 4] of the same camera in the mapped world; depths grow by `scale`."""
        mapped = np.eye(4)
        mapped[:3, :3] = w2c[:3, :3] @ self.rotation.T
        mapped[:3, 3] = self.scale * w2c[:3, 3] - mapped[:3, :3] @ self.translation
        return mapped

    def invert(self, points: Floats) -> Floats:
        """Map points [..., 3] back."""
        return (points - self.translation) @ self.rotation / self.scale

    def invert_vectors(self, vectors: Floats) -> Floats:
        """Map vectors [..., 3], such as velocities, back: they turn and shrink, but do not shift."""
        return vectors @ self.rotation / self.scale


def umeyama(source: Floats, target: Floats) -> Similarity:
    """The similarity that maps source [N, 3] onto target [N, 3] with the least squared error; never a reflection."""
    mean_source, mean_target = source.mean(0), target.mean(0)
    a, b = source - mean_source, target - mean_target
    u, singular, vt = np.linalg.svd(b.T @ a / len(a))
    # For points in a plane the smallest singular value is zero, and the sign alone decides against the mirror image.
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ np.diag(signs) @ vt
    scale = float((singular * signs).sum() / (a**2).sum(1).mean())
    return Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)


def triangulate(rays: Floats, w2c: Floats) -> Floats:
    """The point [3] seen along normalised coordinates [V, 2] by cameras [V, 4, 4], V >= 2.

    Linear triangulation, repeated with each row divided by the point's depth, so that it minimises the image error.
    """
    weights = np.ones(len(rays))
    point = np.zeros(3)
    for _ in range(4):
        rows = np.concatenate(
            [
                (rays[:, :1] * w2c[:, 2] - w2c[:, 0]) * weights[:, None],
                (rays[:, 1:] * w2c[:, 2] - w2c[:, 1]) * weights[:, None],
            ]
        )
        point = np.linalg.lstsq(rows[:, :3], -rows[:, 3], rcond=None)[0]
        weights = 1.0 / np.maximum(np.abs(w2c[:, 2, :3] @ point + w2c[:, 2, 3]), 1e-9)
    return point

"""Metres and gravity from the ChArUco board lying flat on the table in the static scene.

Structure from motion knows neither scale nor up. The board's corners, triangulated from the posed cameras, are
aligned with their known places on the board by the closed form of Umeyama (IEEE TPAMI 13(4), 1991). The scene frame
follows from the board: origin at its centre, metres, +y up (the board's normal, so gravity is (0, -1, 0)), +x along
the board's long printed edge, right-handed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.prepare.board import BoardDetector, BoardView
from splashbench.prepare.lens import Array, Lens
from splashbench.prepare.poses import Poses

GRAVITY = (0.0, -1.0, 0.0)
MIN_TRIANGULATED = 6
# A corner further off than this many times the typical residual was misread in some view.
OUTLIER_FACTOR = 4.0


@dataclass(frozen=True, eq=False)
class Similarity:
    """x -> scale * rotation @ x + translation."""

    scale: float
    rotation: Array  # [3, 3]
    translation: Array  # [3]

    def apply(self, points: Array) -> Array:
        """Map points [N, 3]."""
        return self.scale * points @ self.rotation.T + self.translation

    def apply_w2c(self, w2c: Array) -> Array:
        """World-to-camera [4, 4] of the same camera in the mapped world; depths grow by `scale`."""
        mapped = np.eye(4)
        mapped[:3, :3] = w2c[:3, :3] @ self.rotation.T
        mapped[:3, 3] = self.scale * w2c[:3, 3] - mapped[:3, :3] @ self.translation
        return mapped


@dataclass(frozen=True)
class MetricFrame:
    """The alignment found and its evidence. `rms_m`: RMS distance of triangulated corners to the printed ones,
    metres."""

    scene_from_sfm: Similarity
    rms_m: float
    n_corners: int
    n_views: int
    board_diagonal_m: float
    corners: Array  # [n_corners, 3] triangulated corners in the scene frame, metres


def umeyama(source: Array, target: Array) -> Similarity:
    """The similarity that maps source [N, 3] onto target [N, 3] with the least squared error; never a reflection."""
    mean_source, mean_target = source.mean(0), target.mean(0)
    a, b = source - mean_source, target - mean_target
    u, singular, vt = np.linalg.svd(b.T @ a / len(a))
    # For points in a plane the smallest singular value is zero, and the sign alone decides against the mirror image.
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ np.diag(signs) @ vt
    scale = float((singular * signs).sum() / (a**2).sum(1).mean())
    return Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)


def triangulate(rays: Array, w2c: Array) -> Array:
    """The point [3] seen along normalised coordinates [V, 2] by cameras [V, 4, 4], V >= 2.

    Linear triangulation, repeated with each row divided by the point's depth so that it minimises the image error.
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


def scene_points(board_points: Array, detector: BoardDetector) -> Array:
    """Board points [N, 2] (x right, y down, from the top-left corner of the print) in the scene frame, [N, 3] metres.

    The board's y runs down the print; with the print facing up, (x, up, y) is a right-handed frame.
    """
    layout = detector.layout
    centre = np.array([layout.squares_x, layout.squares_y]) * layout.square_metres / 2
    offset = board_points - centre
    return np.column_stack([offset[:, 0], np.zeros(len(offset)), offset[:, 1]])


@dataclass(frozen=True)
class Sighting:
    """The board as one posed image shows it; `w2c` in the frame of structure from motion."""

    view: BoardView
    lens: Lens
    w2c: Array


def align(sightings: Sequence[Sighting], detector: BoardDetector) -> MetricFrame:
    """The scene frame from sightings of the board, which must lie flat and face up.

    Raises SplashbenchError where too few corners are seen twice, or where the cameras end up below the table.
    """
    seen: dict[int, list[tuple[Array, Array]]] = {}
    for sighting in sightings:
        rays = sighting.lens.normalise(sighting.view.pixels)
        for number, ray in zip(sighting.view.ids.tolist(), rays):
            seen.setdefault(number, []).append((ray, sighting.w2c))
    numbers = sorted(number for number, rays in seen.items() if len(rays) >= 2)
    if len(numbers) < MIN_TRIANGULATED:
        raise SplashbenchError(
            f"static clips and sweep: {len(numbers)} corners of the board are seen twice, {MIN_TRIANGULATED} are needed"
            " for metres and gravity; lay the board flat where several cameras see it"
        )
    sfm = np.array(
        [triangulate(np.array([ray for ray, _ in seen[n]]), np.array([pose for _, pose in seen[n]])) for n in numbers]
    )
    printed = scene_points(detector.corners[numbers], detector)
    kept = np.ones(len(numbers), bool)
    for _ in range(3):
        similarity = umeyama(sfm[kept], printed[kept])
        residual = np.linalg.norm(similarity.apply(sfm) - printed, axis=1)
        inliers = residual <= OUTLIER_FACTOR * max(float(np.median(residual)), 1e-9)
        if inliers.sum() < MIN_TRIANGULATED or np.array_equal(inliers, kept):
            break
        kept = inliers
    above = [similarity.apply_w2c(sighting.w2c) for sighting in sightings]
    heights = [float(-(pose[:3, :3].T @ pose[:3, 3])[1]) for pose in above]
    if np.median(heights) <= 0:
        raise SplashbenchError(
            "static clips: the cameras come out below the board; lay it face up, and check legacy and inverted under"
            " [board] in session.toml"
        )
    layout = detector.layout
    return MetricFrame(
        scene_from_sfm=similarity,
        rms_m=float(np.sqrt(np.mean(residual[kept] ** 2))),
        n_corners=int(kept.sum()),
        n_views=len(sightings),
        board_diagonal_m=float(np.hypot(layout.squares_x, layout.squares_y) * layout.square_metres),
        corners=similarity.apply(sfm[kept]),
    )


def transformed(poses: Poses, similarity: Similarity) -> Poses:
    """The same reconstruction in the mapped frame."""
    return replace(
        poses,
        w2c={camera: similarity.apply_w2c(matrix) for camera, matrix in poses.w2c.items()},
        sweep_w2c=np.array([similarity.apply_w2c(matrix) for matrix in poses.sweep_w2c]).reshape(-1, 4, 4),
        points=similarity.apply(poses.points),
    )


def initial_points(poses: Poses) -> NDArray[np.float32]:
    """The reconstruction's sparse points for init_pt_cld.npz: [N, 7] x, y, z, r, g, b, seg (0: background)."""
    segment = np.zeros((len(poses.points), 1))
    return np.concatenate([poses.points, poses.colours, segment], axis=1).astype(np.float32)

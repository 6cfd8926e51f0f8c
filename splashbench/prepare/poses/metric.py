"""Metres and gravity from a print lying flat on the table in the static scene: the ChArUco board, or a marker.

Structure from motion knows neither scale nor up. The print's corners are triangulated from the posed cameras, and
aligned with their known places on it (`umeyama`). The scene frame follows from the print: origin at its centre, metres,
+y up (the print's normal, so gravity is (0, -1, 0)), +x along its upper edge as printed, right-handed. `scale` decides
which print gives what, and what else may.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splashbench.alignment import Similarity, triangulate, umeyama
from splashbench.errors import SplashbenchError
from splashbench.prepare.calibration.board import BoardView, Detector, collinear
from splashbench.prepare.calibration.lens import Array, Lens
from splashbench.prepare.calibration.marker import MarkerDetector
from splashbench.prepare.poses.structure_from_motion import Poses

GRAVITY = (0.0, -1.0, 0.0)
MIN_TRIANGULATED = 6
# A corner further off than this many times the typical residual was misread in some view.
OUTLIER_FACTOR = 4.0
MAX_DISAGREEMENT_PX = 5.0  # of true sightings, in frames of any size; a false one is off by tens of pixels


@dataclass(frozen=True)
class MetricFrame:
    """The alignment found and its evidence, of the board or of another print.

    `rms_m`: RMS distance of triangulated corners to the printed ones, metres. `scale_sigma`: standard deviation of the
    scale as a share of it, as far as the corners' scatter tells; what the print itself is off by comes on top.
    """

    scene_from_sfm: Similarity
    rms_m: float
    n_corners: int
    n_views: int
    board_diagonal_m: float
    corners: Array  # [n_corners, 3] triangulated corners in the scene frame, metres
    scale_sigma: float = 0.0


@dataclass(frozen=True, eq=False)
class Print:
    """A flat print of known size: the ChArUco board, or one marker. `corners`: [N, 2] metres, x right and y down from
    the print's top left; `size`: its width and height; `needed`: corners that must be seen twice."""

    name: str
    corners: Array
    size: tuple[float, float]
    needed: int
    remedy: str

    @classmethod
    def of_board(cls, detector: Detector) -> Print:
        """The ChArUco board."""
        layout = detector.layout
        size = (layout.squares_x * layout.square_metres, layout.squares_y * layout.square_metres)
        return cls("board", detector.corners, size, MIN_TRIANGULATED, "check legacy and inverted under [board]")

    @classmethod
    def of_marker(cls, detector: MarkerDetector) -> Print:
        """The ArUco marker."""
        side = detector.layout.metres
        return cls("marker", detector.corners, (side, side), len(detector.corners), "check [marker]")

    @property
    def diagonal(self) -> float:
        """Metres."""
        return float(np.hypot(*self.size))

    def is_enough(self, numbers: Sequence[int]) -> bool:
        """Whether these corners tell how the print lies: enough of them, and not all on one line."""
        return len(numbers) >= self.needed and not collinear(self.corners[list(numbers)])

    def scene_points(self, numbers: Sequence[int]) -> Array:
        """Corners in the scene frame, [len(numbers), 3] metres.

        The print's y runs down; with the print facing up, (x, up, y) is a right-handed frame.
        """
        offset = self.corners[list(numbers)] - np.array(self.size) / 2
        return np.column_stack([offset[:, 0], np.zeros(len(offset)), offset[:, 1]])


@dataclass(frozen=True)
class Sighting:
    """The board as one posed image shows it; `w2c` in the frame of structure from motion."""

    view: BoardView
    lens: Lens
    w2c: Array


def is_seen_twice(sightings: Sequence[Sighting], flat: Print) -> bool:
    """Whether two images or more show as many of a print's corners as it takes to know how it lies."""
    ids, counts = np.unique(np.concatenate([[], *(s.view.ids for s in sightings)]), return_counts=True)
    return flat.is_enough(ids[counts >= 2].astype(int).tolist())


def align(sightings: Sequence[Sighting], detector: Detector) -> MetricFrame:
    """The scene frame from sightings of the board, which must lie flat and face up; see `align_print`."""
    return align_print(sightings, Print.of_board(detector))


def align_print(sightings: Sequence[Sighting], flat: Print, upright: bool = True) -> MetricFrame:
    """The scene frame from sightings of a print that lies flat and face up.

    upright: whether it does; where only its size is of interest, it may stand or hang anywhere.
    Raises SplashbenchError where too few corners are seen twice, or where the cameras end up below the table.
    """
    rays_of: dict[int, list[tuple[Array, Array]]] = {}
    for sighting in sightings:
        rays = sighting.lens.normalise(sighting.view.pixels)
        for number, ray in zip(sighting.view.ids.tolist(), rays):
            rays_of.setdefault(number, []).append((ray, sighting.w2c))
    numbers = sorted(number for number, rays in rays_of.items() if len(rays) >= 2)
    if not flat.is_enough(numbers):
        in_a_line = ", all on one line" if len(numbers) >= flat.needed else ""
        raise SplashbenchError(
            f"static scene: {len(numbers)} corners of the {flat.name} are seen twice{in_a_line}, {flat.needed} are"
            f" needed for metres and gravity; lay the {flat.name} flat where several cameras see it"
        )
    sfm = np.array(
        [
            triangulate(np.array([ray for ray, _ in rays_of[n]]), np.array([pose for _, pose in rays_of[n]]))
            for n in numbers
        ]
    )
    printed = flat.scene_points(numbers)
    inliers = np.ones(len(numbers), bool)
    for _ in range(3):
        similarity = umeyama(sfm[inliers], printed[inliers])
        residual = np.linalg.norm(similarity.apply(sfm) - printed, axis=1)
        within = residual <= OUTLIER_FACTOR * max(float(np.median(residual)), 1e-9)
        if not flat.is_enough(np.array(numbers)[within].tolist()) or np.array_equal(within, inliers):
            break
        inliers = within
    above = [similarity.apply_w2c(sighting.w2c) for sighting in sightings]
    heights = [float(-(pose[:3, :3].T @ pose[:3, 3])[1]) for pose in above]
    if upright and np.median(heights) <= 0:
        raise SplashbenchError(
            f"static scene: the cameras come out below the {flat.name}; lay it face up, and {flat.remedy} in"
            " session.toml"
        )
    rms = float(np.sqrt(np.mean(residual[inliers] ** 2)))
    spread = float(np.sqrt(((printed[inliers] - printed[inliers].mean(0)) ** 2).sum()))
    return MetricFrame(
        scene_from_sfm=similarity,
        rms_m=rms,
        n_corners=int(inliers.sum()),
        n_views=len(sightings),
        board_diagonal_m=flat.diagonal,
        corners=similarity.apply(sfm[inliers]),
        # Of a line through the corners' triangulated against their printed places, each axis with the same error.
        scale_sigma=rms / np.sqrt(3) / spread,
    )


def agreeing(sightings: Sequence[Sighting]) -> list[Sighting]:
    """The sightings of a print that agree on where it lies.

    A small marker's pattern is sometimes detected where there is none. While the sightings disagree, the one is dropped
    without which the others agree best.
    """
    agreed = list(sightings)
    while len(agreed) > 2 and _disagreement(agreed) > MAX_DISAGREEMENT_PX:
        disagreements = [_disagreement(agreed[:index] + agreed[index + 1 :]) for index in range(len(agreed))]
        del agreed[int(np.argmin(disagreements))]
    return agreed


def _disagreement(sightings: Sequence[Sighting]) -> float:
    """The largest RMS distance in pixels of a sighting's corners to those that all sightings triangulate together."""
    rays = [dict(zip(s.view.ids.tolist(), s.lens.normalise(s.view.pixels))) for s in sightings]
    squares: list[list[float]] = [[] for _ in sightings]
    for number in sorted({number for corners in rays for number in corners}):
        viewers = [index for index, corners in enumerate(rays) if number in corners]
        if len(viewers) < 2:
            continue
        point = triangulate(np.array([rays[k][number] for k in viewers]), np.array([sightings[k].w2c for k in viewers]))
        for index in viewers:
            sighting = sightings[index]
            local = sighting.w2c[:3, :3] @ point + sighting.w2c[:3, 3]
            if local[2] <= 0:
                return float("inf")
            pixel = sighting.view.pixels[sighting.view.ids == number][0]
            squares[index].append(float(((sighting.lens.project(local[None])[0] - pixel) ** 2).sum()))
    return max((float(np.sqrt(np.mean(errors))) for errors in squares if errors), default=0.0)


def transformed(poses: Poses, similarity: Similarity) -> Poses:
    """The same reconstruction in the mapped frame."""
    return replace(
        poses,
        w2c={camera: similarity.apply_w2c(matrix) for camera, matrix in poses.w2c.items()},
        sweep_w2c=np.array([similarity.apply_w2c(matrix) for matrix in poses.sweep_w2c]).reshape(-1, 4, 4),
        points=similarity.apply(poses.points),
        centre_sigma={camera: similarity.scale * sigma for camera, sigma in poses.centre_sigma.items()},
        feature_centre_sigma={camera: similarity.scale * s for camera, s in poses.feature_centre_sigma.items()},
    )


def initial_points(poses: Poses) -> NDArray[np.float32]:
    """The reconstruction's sparse points for init_pt_cld.npz: [N, 7] x, y, z, r, g, b, seg (0: background)."""
    segment = np.zeros((len(poses.points), 1))
    return np.concatenate([poses.points, poses.colours, segment], axis=1).astype(np.float32)

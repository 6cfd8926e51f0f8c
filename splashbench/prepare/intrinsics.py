"""Intrinsics of one camera from a clip of the ChArUco board moved in front of it (paper Sec. 3, "Capture and
calibration").

A small residual does not prove a right focal length, so the result carries what does: the focal length's standard
deviation, how much of the image the board visited, and the error on views that the fit never saw. Detections that no
plane explains are dropped before calibrating: one of them can move the focal length tenfold.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.prepare.board import MAX_HOMOGRAPHY_RESIDUAL, BoardDetector, BoardView
from splashbench.prepare.lens import OPENCV_PIXEL_SHIFT, Array, Lens

MAX_FRAMES_SEARCHED = 150  # evenly spread over the clip; more adds time and near-copies
MAX_VIEWS = 50
MIN_VIEWS = 8
HELD_OUT_EVERY = 5
OUTLIER_FACTOR = 3.0  # a view this many times worse than the median one is blurred or misread
SIGNIFICANT = 5.0  # standard deviations, which count corners as independent: those of one view are not quite
COVERAGE_CELLS = (8, 6)  # columns, rows


@dataclass(frozen=True)
class Calibration:
    """The lens of one camera, and the evidence for it. Errors are RMS over corners, in pixels of the clip."""

    lens: Lens
    rms_px: float
    held_out_rms_px: float
    focal_sigma_px: float
    coverage: float  # share of the image's cells that saw a corner
    n_searched: int
    n_detected: int
    n_false: int  # detections rejected because no homography explains them
    n_outliers: int  # views rejected after a first fit
    n_views: int
    view_points: Array  # [N, 2] pixels of all corners used, for the report


def frames_to_search(n_frames: int) -> list[int]:
    """Indices spread evenly over a clip of `n_frames` frames."""
    return np.unique(np.linspace(0, n_frames - 1, min(n_frames, MAX_FRAMES_SEARCHED)).astype(int)).tolist()


def calibrate(images: Iterable[NDArray[np.uint8]], detector: BoardDetector, source: str) -> Calibration:
    """Calibrate from images [H, W, 3] of the board; `source` names the clip in errors.

    Raises SplashbenchError where the board is seen in fewer than eight usable views.
    """
    views: list[BoardView] = []
    size = (0, 0)
    n_searched = n_detected = 0
    for image in images:
        n_searched += 1
        size = (image.shape[1], image.shape[0])
        view = detector.detect(image)
        if view is not None:
            n_detected += 1
            views.append(view)
    return calibrate_views(views, detector, size, source, n_searched)


def calibrate_views(
    detections: list[BoardView], detector: BoardDetector, size: tuple[int, int], source: str, n_searched: int
) -> Calibration:
    """As `calibrate`, from detections already made in images of `size` (width, height)."""
    true_views = reject_false(detections)
    _require(len(true_views), detector, source, n_searched)
    chosen = spread_out(true_views, detector, size, MAX_VIEWS)
    errors = _fit(chosen, size).view_errors
    kept = [view for view, error in zip(chosen, errors) if error <= OUTLIER_FACTOR * np.median(errors)]
    _require(len(kept), detector, source, n_searched)

    # The choice above starts with the most different views, so every fifth is a fair sample of all of them.
    held_out = kept[HELD_OUT_EVERY - 1 :: HELD_OUT_EVERY]
    fitted = [view for index, view in enumerate(kept) if index % HELD_OUT_EVERY != HELD_OUT_EVERY - 1]
    held_out_rms = _rms_on(held_out, _fit(fitted, size).lens)
    final = _fit(kept, size)
    pixels = np.concatenate([view.pixels for view in kept])
    return Calibration(
        lens=final.lens,
        rms_px=final.rms,
        held_out_rms_px=held_out_rms,
        focal_sigma_px=final.focal_sigma,
        coverage=coverage(pixels, size),
        n_searched=n_searched,
        n_detected=len(detections),
        n_false=len(detections) - len(true_views),
        n_outliers=len(chosen) - len(kept),
        n_views=len(kept),
        view_points=pixels,
    )


def focal_guess(images: Iterable[NDArray[np.uint8]], detector: BoardDetector) -> float | None:
    """A first guess of the focal length in pixels where the board is in view by chance; None below eight views.

    A board that lies still is seen from too few directions for more: the principal point is taken as the middle and the
    lens as free of distortion.
    """
    views, size = [], (0, 0)
    for image in images:
        size = (image.shape[1], image.shape[0])
        view = detector.detect_true(image)
        views += [view] if view is not None else []
    if len(views) < MIN_VIEWS:
        return None
    held = cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_ASPECT_RATIO
    return _fit(views, size, held | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3).lens.focal


def reject_false(detections: list[BoardView]) -> list[BoardView]:
    """The detections that a plane in perspective explains, up to lens distortion."""
    return [view for view in detections if view.homography_residual() <= MAX_HOMOGRAPHY_RESIDUAL]


def spread_out(views: list[BoardView], detector: BoardDetector, size: tuple[int, int], count: int) -> list[BoardView]:
    """Up to `count` views, each as different as possible from those before it (farthest-point sampling).

    The difference is in where the board's four outer corners fall, which position, size, tilt and turn all change.
    """
    low, high = detector.corners.min(0), detector.corners.max(0)
    outer = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    signatures = np.array([_map_board(view, outer).ravel() / size[0] for view in views])
    first = int(np.argmax([len(view.ids) for view in views]))
    order = [first]
    distance = np.linalg.norm(signatures - signatures[first], axis=1)
    while len(order) < min(count, len(views)):
        farthest = int(np.argmax(distance))
        if distance[farthest] <= 0.0:
            break  # only copies are left
        order.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(signatures - signatures[farthest], axis=1))
    return [views[index] for index in order]


def coverage(pixels: Array, size: tuple[int, int]) -> float:
    """Share of the image's 8 x 6 cells that hold at least one of the corners [N, 2]."""
    columns, rows = COVERAGE_CELLS
    x = np.floor(pixels[:, 0] / size[0] * columns).astype(int)
    y = np.floor(pixels[:, 1] / size[1] * rows).astype(int)
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    return len(set(zip(x[inside].tolist(), y[inside].tolist()))) / (columns * rows)


@dataclass(frozen=True)
class _Fit:
    lens: Lens
    rms: float
    focal_sigma: float
    view_errors: Array


def _fit(views: list[BoardView], size: tuple[int, int], fixed: int = 0) -> _Fit:
    """Fit k1, k2, p1, p2, k3, and again without k3 where it is not significant.

    In a narrow field of view k2 and k3 offset each other almost exactly; both then come out large and of opposite
    signs, and bend the corners of the image that no board reached.
    """
    objects = [_object_points(view) for view in views]
    images = [(view.pixels - OPENCV_PIXEL_SHIFT).astype(np.float32) for view in views]
    rms, K, distortion, _, _, sigmas, _, errors = cv2.calibrateCameraExtended(
        objects, images, size, None, None, flags=fixed
    )
    deviations = np.asarray(sigmas, np.float64).ravel()
    if not fixed and abs(np.ravel(distortion)[4]) < SIGNIFICANT * deviations[8]:
        return _fit(views, size, cv2.CALIB_FIX_K3)
    lens = Lens.from_opencv(size[0], size[1], K, distortion)
    focal_sigma = float(np.sqrt(np.mean(deviations[:2] ** 2)))
    return _Fit(lens, float(rms), focal_sigma, np.asarray(errors, np.float64).ravel())


def _rms_on(views: list[BoardView], lens: Lens) -> float:
    """RMS reprojection error of views whose pose alone is fitted, the lens held."""
    squares: list[Array] = []
    for view in views:
        pixels = (view.pixels - OPENCV_PIXEL_SHIFT).astype(np.float32)
        found, rotation, translation = cv2.solvePnP(
            _object_points(view), pixels, lens.opencv_K(), lens.distortion, flags=cv2.SOLVEPNP_ITERATIVE
        )
        if found:
            points = _object_points(view) @ cv2.Rodrigues(rotation)[0].T + translation.ravel()
            squares.append(((lens.project(points) - view.pixels) ** 2).sum(1))
    return float(np.sqrt(np.concatenate(squares).mean())) if squares else float("inf")


def _object_points(view: BoardView) -> NDArray[np.float32]:
    return np.column_stack([view.points, np.zeros(len(view.points))]).astype(np.float32)


def _map_board(view: BoardView, points: Array) -> Array:
    homography, _ = cv2.findHomography(view.points, view.pixels, 0)
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return mapped[:, :2] / mapped[:, 2:]


def _require(n_views: int, detector: BoardDetector, source: str, n_searched: int) -> None:
    if n_views < MIN_VIEWS:
        layout = detector.layout
        raise SplashbenchError(
            f"{source}: the {layout.squares_x}x{layout.squares_y} ChArUco board is usable in {n_views} of {n_searched}"
            f" frames, {MIN_VIEWS} are needed; check [board] in session.toml, or film the board again"
        )

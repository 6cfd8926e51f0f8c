"""Intrinsics of one camera from a clip or photographs of the board moved in front of it (paper Sec. 3, "Capture and
calibration").

A small residual does not prove a right focal length. So the result carries better evidence: the focal length's standard
deviation, how much of the image the board visited, and the error on views that the fit never saw. Detections that no
plane explains are dropped before calibrating: one of them can move the focal length tenfold.

Corners of one view err together: the board bends in the hand, the image blurs one way, light spreads. Counted as
independent, they make the focal length look two to four times surer than it is (measured on photographs). So the
deviation comes from leaving out whole views in turn (jackknife; Efron and Stein, Annals of Statistics 9(3), 1981).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.prepare.calibration.board import MIN_CORNERS, BoardView, Detector, collinear, image_size
from splashbench.prepare.calibration.determinism import one_opencv_thread
from splashbench.prepare.calibration.lens import OPENCV_PIXEL_SHIFT, Array, Lens

MAX_FRAMES_SEARCHED = 150  # evenly spread over the clip; more adds time and near-copies
MAX_VIEWS = 50
# Enough to leave some out and compare. Whether they determine the focal length is for its deviation to say: a few good
# photographs do, any number of frames of a board at rest does not.
MIN_VIEWS = 5
MIN_VIEWS_BY_CHANCE = 8  # for a guess from views that nobody chose
HELD_OUT_FOLDS = 5
OUTLIER_FACTOR = 3.0  # a view this many times worse than the median one is blurred or misread
CORNER_OUTLIER_FACTOR = 4.0  # of normal errors one in 60 000 lies further off than four times the median
MAX_TRIMS = 5
SIGNIFICANT = 3.0  # standard deviations
COVERAGE_CELLS = (8, 6)  # columns, rows
BLANK_EVERY, MAX_BLANK = 3, 8  # of the frames without a board, those that are looked at in a mirror


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
    n_outlier_corners: int = 0  # single corners of the views used that were left out: hidden by glare or a finger
    # [9, 9] of fx, fy, cx, cy, k1, k2, p1, p2, k3: zero where held fixed, infinite where undetermined
    lens_covariance: Array = field(default_factory=lambda: np.zeros((9, 9)))


def frames_to_search(n_frames: int) -> list[int]:
    """Indices spread evenly over a clip of `n_frames` frames."""
    return np.unique(np.linspace(0, n_frames - 1, min(n_frames, MAX_FRAMES_SEARCHED)).astype(int)).tolist()


def calibrate(images: Iterable[NDArray[np.uint8]], detector: Detector, source: str) -> Calibration:
    """Calibrate from images [H, W, 3] of the board; `source` names the clip in errors.

    Raises SplashbenchError where the board is seen in fewer than five usable views.
    """
    views: list[BoardView] = []
    blank: list[NDArray[np.uint8]] = []
    size = (0, 0)
    n_searched = n_replaced = 0
    for image in images:
        n_searched += 1
        size = image_size(image)
        view = detector.detect(image)
        if view is None:
            if n_searched % BLANK_EVERY == 1 and len(blank) < MAX_BLANK:
                blank.append(image)
            continue
        if not view.lies_on_a_plane(size) and (true_view := detector.detect_true(image)) is not None:
            n_replaced += 1
            view = true_view
        views.append(view)
    if len(views) < MIN_VIEWS and _is_mirrored(blank, detector):
        raise SplashbenchError(
            f"{source}: the board is seen mirrored, and its markers cannot be read; the video is flipped, or the board"
            " was printed mirrored: switch flipping off in the camera, or print the board again, and film it again"
        )
    calibration = calibrate_views(views, detector, size, source, n_searched)
    return replace(calibration, n_false=calibration.n_false + n_replaced)


def _is_mirrored(images: list[NDArray[np.uint8]], detector: Detector) -> bool:
    """Whether images in which no board was found show one in a mirror."""
    return sum(detector.detect_true(np.ascontiguousarray(image[:, ::-1])) is not None for image in images) >= 2


def calibrate_views(
    detections: list[BoardView], detector: Detector, size: tuple[int, int], source: str, n_searched: int
) -> Calibration:
    """As `calibrate`, from detections already made in images of `size` (width, height)."""
    true_views = reject_false(detections, size)
    _require(len(true_views), detector, source, n_searched)
    chosen = spread_out(true_views, detector, size, MAX_VIEWS)
    _require(len(chosen), detector, source, n_searched)
    trimmed = _without_outlier_corners(chosen, size)
    errors = _fit(trimmed, size).view_errors
    inliers = [index for index, error in enumerate(errors) if error <= OUTLIER_FACTOR * np.median(errors)]
    used = [trimmed[index] for index in inliers]
    _require(len(used), detector, source, n_searched)
    fit = _fit(used, size)
    pixels = np.concatenate([view.pixels for view in used])
    return Calibration(
        lens=fit.lens,
        rms_px=fit.rms,
        held_out_rms_px=_held_out_rms(used, size),
        focal_sigma_px=fit.focal_sigma,
        coverage=coverage(pixels, size),
        n_searched=n_searched,
        n_detected=len(detections),
        n_false=len(detections) - len(true_views),
        n_outliers=len(chosen) - len(used),
        n_views=len(used),
        view_points=pixels,
        n_outlier_corners=sum(len(chosen[index].ids) - len(trimmed[index].ids) for index in inliers),
        lens_covariance=fit.covariance,
    )


def focal_guess(images: Iterable[NDArray[np.uint8]], detector: Detector) -> float | None:
    """A first guess of the focal length in pixels where the board is in view by chance; None below eight views.

    A board that lies still is seen from too few directions for more: the principal point is taken as the middle and the
    lens as free of distortion.
    """
    views, size = [], (0, 0)
    for image in images:
        size = image_size(image)
        view = detector.detect_true(image)
        views += [view] if view is not None else []
    if len(views) < MIN_VIEWS_BY_CHANCE:
        return None
    fixed = cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_ASPECT_RATIO
    return _fit(views, size, fixed | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3).lens.focal


def reject_false(detections: list[BoardView], size: tuple[int, int]) -> list[BoardView]:
    """The detections that a plane in perspective explains, up to lens distortion; `size`: width, height."""
    return [view for view in detections if view.lies_on_a_plane(size)]


def spread_out(views: list[BoardView], detector: Detector, size: tuple[int, int], count: int) -> list[BoardView]:
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
    covariance: Array  # [9, 9]
    view_errors: Array  # [V] RMS, pixels
    corner_errors: list[Array]  # [N] per view, pixels


def _fit(views: list[BoardView], size: tuple[int, int], fixed: int = 0) -> _Fit:
    """Fit k1, k2, p1, p2, k3, and again without k3 where it is not significant.

    In a narrow field of view k2 and k3 offset each other almost exactly; both then come out large and of opposite
    signs, and bend the corners of the image that no board reached.
    """
    objects = [_object_points(view) for view in views]
    images = [(view.pixels - OPENCV_PIXEL_SHIFT).astype(np.float32) for view in views]
    with one_opencv_thread():
        rms, K, distortion, rotations, translations = cv2.calibrateCamera(
            objects, images, size, None, None, flags=fixed
        )
    errors, per_view = [], []
    for object_points, pixels, rotation, translation in zip(objects, images, rotations, translations):
        projected, jacobian = cv2.projectPoints(object_points, rotation, translation, K, distortion)
        error = pixels - projected.reshape(-1, 2)
        errors.append(np.linalg.norm(error, axis=1).astype(np.float64))
        per_view.append((error.astype(np.float64).ravel(), np.asarray(jacobian, np.float64)[:, :15]))
    covariance = _covariance(per_view, _free_columns(fixed))
    deviations = np.sqrt(np.diag(covariance))
    if not fixed and abs(np.ravel(distortion)[4]) < SIGNIFICANT * deviations[8]:
        return _fit(views, size, cv2.CALIB_FIX_K3)
    lens = Lens.from_opencv(size[0], size[1], K, distortion)
    focal_sigma = float(np.sqrt(np.mean(deviations[:2] ** 2)))
    return _Fit(lens, float(rms), focal_sigma, covariance, np.array([np.sqrt(np.mean(e**2)) for e in errors]), errors)


def _free_columns(fixed: int) -> list[int]:
    """Which of fx, fy, cx, cy, k1, k2, p1, p2, k3 a fit with the flags `fixed` determines."""
    columns_of_flag = {
        cv2.CALIB_FIX_PRINCIPAL_POINT: (2, 3),
        cv2.CALIB_FIX_K1: (4,),
        cv2.CALIB_FIX_K2: (5,),
        cv2.CALIB_ZERO_TANGENT_DIST: (6, 7),
        cv2.CALIB_FIX_K3: (8,),
    }
    fixed_columns = {column for flag, columns in columns_of_flag.items() if fixed & flag for column in columns}
    return [column for column in range(9) if column not in fixed_columns]


def _covariance(per_view: list[tuple[Array, Array]], free: list[int]) -> Array:
    """Covariance [9, 9] of fx, fy, cx, cy, k1, k2, p1, p2, k3: zero where fixed, infinite where undetermined.

    `per_view`: errors [2N] and their derivatives [2N, 15] by the view's pose (6) and by the lens (9). A variance is the
    larger of two estimates: with errors independent from corner to corner, and the jackknife over views, linearised at
    the optimum. Correlations are the first estimate's: views are too few to estimate 36 of them.
    """
    normals, gradients = [], []
    squares, freedom = 0.0, -len(free)
    for error, jacobian in per_view:
        # What the view's pose cannot account for.
        basis, _ = np.linalg.qr(jacobian[:, :6])
        lens = jacobian[:, 6:][:, free]
        lens = lens - basis @ (basis.T @ lens)
        residual = error - basis @ (basis.T @ error)
        normals.append(lens.T @ lens)
        gradients.append(lens.T @ residual)
        squares += float(residual @ residual)
        freedom += len(error) - 6
    result = np.zeros((9, 9))
    count, information = len(per_view), np.sum(normals, axis=0)
    try:
        full = np.linalg.inv(information)
        inverse = np.diag(full)
        shifts = np.array(
            [np.linalg.solve(information - part, -gradient) for part, gradient in zip(normals, gradients)]
        )
    except np.linalg.LinAlgError:
        result[free, free] = np.inf
        return result
    independent = np.where(inverse > 0, inverse, np.inf) * (squares / max(freedom, 1))
    jackknife = (count - 1) / count * ((shifts - shifts.mean(0)) ** 2).sum(0)
    deviations = np.sqrt(np.maximum(independent, jackknife))
    if not np.isfinite(deviations).all():
        result[free, free] = deviations**2
        return result
    scale = deviations / np.sqrt(inverse)
    result[np.ix_(free, free)] = full * scale[:, None] * scale
    return result


def _without_outlier_corners(views: list[BoardView], size: tuple[int, int]) -> list[BoardView]:
    """The views without single corners that lie far off in comparison with their own view and with all.

    One corner under a highlight would otherwise condemn its whole view, or bend the lens.
    """
    for _ in range(MAX_TRIMS):
        fit = _fit(views, size)
        typical = float(np.median(np.concatenate(fit.corner_errors)))
        trimmed = []
        for view, error in zip(views, fit.corner_errors):
            inliers = error <= CORNER_OUTLIER_FACTOR * max(typical, float(np.median(error)))
            enough = inliers.sum() >= MIN_CORNERS and not collinear(view.points[inliers])
            trimmed.append(BoardView(view.ids[inliers], view.points[inliers], view.pixels[inliers]) if enough else view)
        if sum(len(view.ids) for view in trimmed) == sum(len(view.ids) for view in views):
            break
        views = trimmed
    return views


def _held_out_rms(views: list[BoardView], size: tuple[int, int]) -> float:
    """RMS error of all views, each under a lens fitted without it and its share of the others (cross-validation)."""
    squares, count = 0.0, 0
    folds = min(HELD_OUT_FOLDS, len(views))
    for fold in range(folds):
        fitted = [view for index, view in enumerate(views) if index % folds != fold]
        held_out = views[fold::folds]
        corners = sum(len(view.ids) for view in held_out)
        squares += _rms_on(held_out, _fit(fitted, size).lens) ** 2 * corners
        count += corners
    return float(np.sqrt(squares / count))


def _rms_on(views: list[BoardView], lens: Lens) -> float:
    """RMS reprojection error of views under a fixed lens; only their poses are fitted."""
    squares: list[Array] = []
    for view in views:
        pixels = (view.pixels - OPENCV_PIXEL_SHIFT).astype(np.float32)
        solved, rotation, translation = cv2.solvePnP(
            _object_points(view), pixels, lens.opencv_K(), lens.distortion, flags=cv2.SOLVEPNP_ITERATIVE
        )
        if solved:
            points = _object_points(view) @ cv2.Rodrigues(rotation)[0].T + translation.ravel()
            squares.append(((lens.project(points) - view.pixels) ** 2).sum(1))
    return float(np.sqrt(np.concatenate(squares).mean())) if squares else float("inf")


def _object_points(view: BoardView) -> NDArray[np.float32]:
    return np.column_stack([view.points, np.zeros(len(view.points))]).astype(np.float32)


def _map_board(view: BoardView, points: Array) -> Array:
    homography, _ = cv2.findHomography(view.points, view.pixels, 0)
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return mapped[:, :2] / mapped[:, 2:]


def _require(n_views: int, detector: Detector, source: str, n_searched: int) -> None:
    if n_views < MIN_VIEWS:
        layout = detector.layout
        kind = "checkerboard" if layout.kind == "checkerboard" else "ChArUco board"
        searched, again = ("photographs", "take photographs of") if Path(source).is_dir() else ("frames", "film")
        raise SplashbenchError(
            f"{source}: the {layout.squares_x}x{layout.squares_y} {kind} is usable in {n_views} of {n_searched}"
            f" {searched}, {MIN_VIEWS} are needed; check [board] in session.toml, or {again} the board again"
        )

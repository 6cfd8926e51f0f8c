"""Whether each camera still stands, during the pour, where its static clip was filmed.

Cameras are placed by the static clip and then lend their poses to the pour (paper Sec. 3, "Capture and calibration").
A camera that was bumped in between gives a scene that looks right and is wrong. So features of the static picture are
looked for in the pour, camera by camera, at the start, the middle and the end of the motion.

Features (SIFT) are matched both ways. What agrees on one homography is one group: the background, a print that was
carried away, a container. The group that is spread furthest over the picture is the background, since a thing that
somebody moved is compact. Liquid and hands change between neighbouring frames; features there are left out. The shift
is the RMS displacement of the background's features under the similarity that fits them best, so the noise of single
features averages out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.prepare.audio.sync import ClockFit
from splashbench.prepare.calibration.lens import Array
from splashbench.prepare.video.recording import Recording
from splashbench.prepare.video.strips import median_frame
from splashbench.progress import track

Image = NDArray[np.uint8]
Instant = Literal["start", "middle", "end"]
INSTANTS: tuple[Instant, ...] = get_args(Instant)

FRAMES = 5  # in a row, whose median is compared: fewer drops in flight, less noise
MAX_WIDTH = 1600  # larger pictures are compared at this width; the shift is in pixels of the original
MAX_FEATURES = 4000
CONTRAST = 0.02  # half of OpenCV's threshold: a plain wall has weak features
RATIO = 0.8  # a match must be this much better than the second best (Lowe 2004, Sec. 7.1)
GROUP_PX = 3.0  # features within this of one homography move together
MAX_GROUPS = 4
# Unrelated pictures agree on a homography by chance in up to 9 features (measured on photographs of other places).
MIN_AGREEING = 15
CELLS = (8, 6)  # columns, rows of the picture by which the spread of features is counted
AS_WIDE = 0.6  # of the widest group's cells: groups about as wide, of which the stiller one is the background
MOVING_GREY = 12.0  # grey levels of 255 between neighbouring frames, that noise does not reach after a blur
MOVING_MARGIN = 0.01  # of the width, around what moves


@dataclass(frozen=True)
class Shift:
    """How far the background moved in one picture against the static one.

    Attributes:
        px: RMS displacement in pixels of the raw frame; None where too few features agree on any.
        agreeing: features of the background that both pictures show.
        matched: features that look alike in both, whether or not they agree.
    """

    px: float | None
    agreeing: int
    matched: int


Stillness = dict[Instant, Shift]


def background_shift(static: Image, frames: Sequence[Image]) -> Shift:
    """How far the background of neighbouring `frames` is from that of the `static` picture; all [H, W, 3], one size."""
    width = static.shape[1]
    zoom = min(1.0, MAX_WIDTH / width)
    before = _small(static, zoom)
    stack = [_small(frame, zoom) for frame in frames]
    now = median_frame(stack)
    old, new = _matches(before, now, _at_rest(stack))
    background = _background(old, new, (before.shape[1], before.shape[0]))
    if background is None:
        return Shift(None, 0, len(old))
    px = _displacement(old[background], new[background])
    agreeing = int(background.sum())
    return Shift(px / zoom if agreeing >= MIN_AGREEING else None, agreeing, len(old))


def find_stillness(
    static: Callable[[str], Image],
    pour: Mapping[str, Recording],
    clocks: Mapping[str, ClockFit],
    interval: tuple[float, float],
) -> dict[str, Stillness]:
    """Every camera's shift at the start, middle and end of `interval` (seconds on the reference clock).

    `static`: a camera's picture of the static scene, [H, W, 3], of the same size as its pour.
    """
    times = dict(zip(INSTANTS, np.linspace(*interval, len(INSTANTS))))
    found: dict[str, Stillness] = {}
    for camera, recording in track(pour.items(), "have the cameras moved?"):
        picture = static(camera)
        found[camera] = {}
        for instant, time in times.items():
            frames = [frame for _, frame in recording.frames(_around(recording, clocks[camera], float(time)))]
            found[camera][instant] = background_shift(picture, frames)
    return found


def _around(recording: Recording, clock: ClockFit, time: float) -> list[int]:
    """Indices of the frames nearest to an instant of the reference clock."""
    local = recording.frame_times
    middle = int(np.argmin(np.abs(local - clock.to_local(time))))
    first = max(0, min(middle - FRAMES // 2, len(local) - FRAMES))
    return list(range(first, min(first + FRAMES, len(local))))


def _small(image: Image, zoom: float) -> Image:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return grey if zoom == 1 else np.asarray(cv2.resize(grey, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA))


def _at_rest(stack: Sequence[Image]) -> Image:
    """Mask [H, W], 255 where nothing moves between the frames."""
    smooth = np.stack([cv2.GaussianBlur(image, (0, 0), 1.5).astype(np.float32) for image in stack])
    smooth -= np.median(smooth, axis=(1, 2), keepdims=True)  # lamps flicker
    moving = (np.ptp(smooth, axis=0) > MOVING_GREY).astype(np.uint8)
    margin = 2 * max(1, round(MOVING_MARGIN * moving.shape[1])) + 1
    return np.asarray(255 * (1 - cv2.dilate(moving, np.ones((margin, margin), np.uint8))), np.uint8)


def _matches(before: Image, now: Image, at_rest: Image) -> tuple[Array, Array]:
    """Places [N, 2] of the same features in both grey pictures, pixels."""
    sift = cv2.SIFT.create(nfeatures=MAX_FEATURES, contrastThreshold=CONTRAST)
    old_points, old = sift.detectAndCompute(before, None)
    new_points, new = sift.detectAndCompute(now, at_rest)
    if old is None or new is None or min(len(old_points), len(new_points)) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {pair.queryIdx: pair.trainIdx for (pair, *_) in matcher.knnMatch(new, old, k=1)}
    chosen = [
        (first.queryIdx, first.trainIdx)
        for first, second in matcher.knnMatch(old, new, k=2)
        if first.distance < RATIO * second.distance and back[first.trainIdx] == first.queryIdx
    ]
    pairs = [(old_points[i].pt, new_points[j].pt) for i, j in chosen]
    # A feature with two directions comes twice, at one place: it counts once.
    unique = np.unique(np.asarray(pairs, np.float64).reshape(-1, 4).round(3), axis=0)
    return unique[:, :2], unique[:, 2:]


def _background(old: Array, new: Array, size: tuple[int, int]) -> NDArray[np.bool_] | None:
    """Which of the matches [N] belong to the background; None where no four agree on a homography."""
    groups: list[tuple[int, float, NDArray[np.bool_]]] = []
    left = np.ones(len(old), bool)
    for _ in range(MAX_GROUPS):
        index = np.flatnonzero(left)
        if len(index) < 4:
            break
        cv2.setRNGSeed(0)
        homography, inliers = cv2.findHomography(old[index], new[index], cv2.RANSAC, GROUP_PX, maxIters=5000)
        if homography is None or not inliers.any():
            break
        members = np.zeros(len(old), bool)
        members[index[inliers.ravel() > 0]] = True
        left &= ~members
        if members.sum() < (MIN_AGREEING if groups else 4):
            break
        groups.append((_cells(old[members], size), _displacement(old[members], new[members]), members))
    if not groups:
        return None
    widest = max(cells for cells, _, _ in groups)
    return min((group for group in groups if group[0] >= AS_WIDE * widest), key=lambda group: group[1])[2]


def _cells(points: Array, size: tuple[int, int]) -> int:
    """In how many cells of a picture of `size` (width, height) the points [N, 2] lie."""
    cells = np.clip(np.floor(points / size * CELLS), 0, np.array(CELLS) - 1).astype(int)
    return len(np.unique(cells, axis=0))


def _displacement(old: Array, new: Array) -> float:
    """RMS displacement of the features [N, 2], pixels, under the similarity that fits them best.

    Features twice as far from it as is typical weigh nothing: those that changed or were mistaken.
    """
    centre = old.mean(0)
    x, y = (old - centre).T
    one, zero = np.ones(len(old)), np.zeros(len(old))
    design = np.stack([np.stack([one, zero, x, -y], 1), np.stack([zero, one, y, x], 1)], 1)  # [N, 2, 4]
    moved = new - old
    used = np.ones(len(old), bool)
    for _ in range(4):
        fit = np.linalg.lstsq(design[used].reshape(-1, 4), moved[used].ravel(), rcond=None)[0]
        error = np.linalg.norm(design @ fit - moved, axis=1)
        used = error <= max(2.0 * float(np.median(error)), 1e-9)
    return float(np.sqrt(((design @ fit) ** 2).sum(1).mean()))

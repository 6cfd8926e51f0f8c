"""Calibration clips: a ChArUco board moved in front of one camera until it has covered the image (paper Sec. 4)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from splashbench.synth.imaging.lens import LensCamera
from splashbench.synth.imaging.texture import BOARD_PIXELS_PER_SQUARE, board_albedo, mottled, to_srgb

Array = NDArray[np.float64]

POSES = 40
TILT_DEGREES = (18.0, 45.0)  # a board seen straight on says nothing about the focal length
_SAMPLES = 3
_MARGIN_SQUARES = 0.35


def board_poses(camera: LensCamera, board: dict[str, Any], rng: np.random.Generator, count: int = POSES) -> list[Array]:
    """Board-to-camera [4, 4] poses whose centres walk over a grid of the image, tilted this way and that."""
    size = np.array([board["squares_x"], board["squares_y"]]) * board["square_metres"]
    places = [(u, v) for v in (0.25, 0.5, 0.75) for u in (0.22, 0.41, 0.59, 0.78)]
    focal = camera.K[0, 0]
    poses = []
    for k in range(count):
        u, v = np.array(places[k % len(places)]) + rng.uniform(-0.05, 0.05, 2)
        # Between two fifths and four fifths of the image's width: near enough to read, far enough to move about.
        depth = focal * size[0] / (rng.uniform(0.42, 0.8) * camera.width)
        tilt = np.radians(rng.uniform(*TILT_DEGREES))
        about = rng.uniform(0, 2 * np.pi)
        rotation = Rotation.from_rotvec(tilt * np.array([np.cos(about), np.sin(about), 0]))
        rotation *= Rotation.from_euler("z", rng.uniform(-25, 25), degrees=True)
        pose = np.eye(4)
        pose[:3, :3] = rotation.as_matrix()
        pixel = np.array([u * camera.width, v * camera.height])
        middle = depth * np.append((pixel - camera.K[:2, 2]) / focal, 1.0)
        pose[:3, 3] = middle - pose[:3, :3] @ np.append(size / 2, 0.0)
        poses.append(pose)
    return poses


def board_images(
    camera: LensCamera, board: dict[str, Any], poses: list[Array], rng: np.random.Generator
) -> Iterator[NDArray[np.float32]]:
    """Each pose through the camera's lens: float32 [H, W, 3] sRGB in [0, 1], in front of a plain, mottled wall."""
    import cv2

    sheet = board_albedo(board, _MARGIN_SQUARES)[..., 0]
    # Prefiltered for about the resolution at which it is sampled below, against aliasing.
    levels = [sheet, *(cv2.resize(sheet, None, fx=f, fy=f, interpolation=cv2.INTER_AREA) for f in (0.5, 0.25))]
    wall: NDArray[np.float32] = to_srgb(mottled(rng, (camera.height, camera.width), (0.3, 0.31, 0.3), 0.15))
    local = camera.local_rays(_SAMPLES)
    rays = np.concatenate([local, np.ones_like(local[..., :1])], axis=-1).astype(np.float32)
    size = board["square_metres"]
    extent = (np.array([board["squares_x"], board["squares_y"]]) + 2 * _MARGIN_SQUARES) * size
    for pose in poses:
        # A plane's points pose @ (x, y, 0, 1) project by a homography: its inverse takes rays back to the plane.
        onto_board = rays @ np.linalg.inv(pose[:3, [0, 1, 3]]).T.astype(np.float32)
        ahead = onto_board[..., 2] > 0
        depth = np.where(ahead, onto_board[..., 2], 1)  # a board on edge has rays along its plane
        x, y = (onto_board[..., k] / depth + np.float32(_MARGIN_SQUARES * size) for k in (0, 1))
        inside = (x > 0) & (x < extent[0]) & (y > 0) & (y < extent[1]) & ahead
        pixel_size = pose[2, 3] / camera.K[0, 0] / _SAMPLES
        texel = size / BOARD_PIXELS_PER_SQUARE
        level = levels[int(np.clip(np.floor(np.log2(max(1.0, pixel_size / texel))), 0, 2))]
        scale = (np.array(level.shape[::-1]) / extent).astype(np.float32)
        half = np.float32(0.5)
        light = np.float32(0.85 + 0.15 * pose[2, 2])
        board_light = light * cv2.remap(level, x * scale[0] - half, y * scale[1] - half, cv2.INTER_LINEAR)
        cover = _pixel_means(inside.astype(np.float32), camera)[..., None]
        shown = _pixel_means(board_light * inside, camera)[..., None] / np.maximum(cover, 1e-6)
        blended: NDArray[Any] = wall * (1 - cover) + to_srgb(shown.astype(np.float32)) * cover
        yield blended.astype(np.float32)


def _pixel_means(values: NDArray[np.float32], camera: LensCamera) -> NDArray[np.float32]:
    import cv2

    return np.asarray(cv2.resize(values, (camera.width, camera.height), interpolation=cv2.INTER_AREA))

"""Camera poses by structure from motion on the textured static scene (paper Sec. 3, "Capture and calibration").

The seven fixed cameras see too little in common, so a handheld sweep bridges them. COLMAP (through pycolmap, see
`mapping`) gets the fixed cameras' calibrated lenses, which it must not change, and one free lens shared by all frames
of the sweep. Where the fixed cameras share enough, no sweep is needed; a camera whose lens is not known gets a free one
of its own. The result is up to a similarity; `metric` turns it into metres.

Repeatability: COLMAP's threads make its outcome differ between runs, already because they number the images in the
order of their arrival. One thread and fixed seeds give the same bits each time; for 7 + 25 images of 480 x 270 that
takes about as long as two threads do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.colmap import pycolmap
from splashbench.prepare.calibration.lens import Array, Lens
from splashbench.prepare.poses.covariance import PoseSigmas, pose_sigmas
from splashbench.prepare.poses.mapping import SWEEP_FOLDER, map_images, match, quiet_colmap, refine, require_posed
from splashbench.progress import Bar

SWEEP_FRAMES = 25


@dataclass(frozen=True)
class Poses:
    """Structure from motion's outcome, in its own units and frame until `transformed`.

    `w2c`: camera -> [4, 4]. `sweep_w2c`: [M, 4, 4], the registered frames of the sweep, which are
    number `sweep_indices` of those given. `points`: [N, 3];
    `colours`: [N, 3] in [0, 1]. `mean_error_px`: mean distance over all observations of all images between an observed
    feature and its point's projection, in pixels of the raw frames; `rms_error_px` the root mean square of the same.
    `centre_sigma`, `rotation_sigma_deg`: fixed camera -> root mean square error to expect of its centre and of its
    rotation, relative to the other fixed cameras (see `covariance`); empty where they could not be had.
    `feature_centre_sigma`, `feature_rotation_sigma_deg`: the part of them that the noise of the features explains, the
    rest being the lenses' own. `attempts`: how each attempt at mapping ended. `found_lenses`: of cameras whose lens was
    not given. `metres_per_unit`: where the poses have a scale of their own, as those of `board_rig` have.
    """

    w2c: dict[str, Array]
    sweep_w2c: Array
    sweep_indices: tuple[int, ...]
    sweep_lens: Lens
    n_sweep: int
    points: Array
    colours: Array
    mean_error_px: float
    rms_error_px: float
    n_observations: int
    centre_sigma: dict[str, float] = field(default_factory=dict)
    rotation_sigma_deg: dict[str, float] = field(default_factory=dict)
    attempts: tuple[str, ...] = ()
    found_lenses: dict[str, Lens] = field(default_factory=dict)
    feature_centre_sigma: dict[str, float] = field(default_factory=dict)
    feature_rotation_sigma_deg: dict[str, float] = field(default_factory=dict)
    metres_per_unit: float | None = None

    @property
    def mean_track_length(self) -> float:
        """Mean number of images that see a point."""
        return self.n_observations / max(len(self.points), 1)


def sharpest_per_bin(sharpness: Sequence[float], count: int) -> list[int]:
    """Indices of the sharpest frame in each of `count` equal bins of the sweep; all frames where there are no more."""
    n = len(sharpness)
    edges = np.linspace(0, n, min(count, n) + 1).round().astype(int)
    return [int(low + np.argmax(sharpness[low:high])) for low, high in pairwise(edges)]


def sharpness_of(image: NDArray[np.uint8]) -> float:
    """Of a grey image [H, W]: variance of the Laplacian: motion blur lowers it. Comparable within one clip only."""
    return float(cv2.Laplacian(image, cv2.CV_32F).var())


def estimate_poses(
    static: Mapping[str, NDArray[np.uint8]],
    lenses: Mapping[str, Lens],
    sweep: Sequence[NDArray[np.uint8]],
    work: Path,
    sweep_focal: float | None = None,
    threads: int = 1,
    lens_covariance: Mapping[str, Array] | None = None,
) -> Poses:
    """Poses of the fixed cameras from one raw image each, bridged by frames of the sweep, of which there may be none.

    `lenses`: of the calibrated cameras, held as they are. A camera that is left out has its focal length and one radial
    coefficient estimated with its pose, so with no lenses and no sweep this is structure from motion of any set of
    photographs. `work` is an empty folder for COLMAP's images and database. `sweep_focal`: the sweep camera's focal
    length in pixels to start from; without it, 1.2 image widths. Its lens is refined, its principal point last
    of all. `threads`: 1 gives the same result each time. `lens_covariance`: of the calibrated lenses, see
    `Calibration`; it enters the deviations, not the poses. Raises SplashbenchError naming the cameras that could not be
    posed.
    """
    bar = Bar("structure from motion")
    try:
        with quiet_colmap():
            bar.update(0.0, f"features of {len(static) + len(sweep)} images")
            workplace = match(static, lenses, sweep, work, sweep_focal, threads)
            bar.update(0.6, "mapping")
            mapped = require_posed(workplace, map_images(workplace))
            bar.update(0.8, "refining")
            principal = refine(mapped.reconstruction, workplace)
            bar.update(0.9, "deviations")
            names = list(workplace.names.values())
            by_name = {image.name: image.camera_id for image in mapped.reconstruction.images.values()}
            lenses_known = {
                by_name[workplace.names[camera]]: covariance for camera, covariance in (lens_covariance or {}).items()
            }
            sigmas = pose_sigmas(mapped.reconstruction, names, workplace.fixed_lenses, principal, lenses_known)
            bar.update(1.0)
    finally:
        bar.close()
    free = [camera for camera in static if camera not in lenses]
    return _collect(mapped.reconstruction, workplace.names, free, len(sweep), sigmas, mapped.attempts)


def _collect(
    reconstruction: pycolmap.Reconstruction,
    names: Mapping[str, str],
    free: Sequence[str],
    n_sweep: int,
    sigmas: PoseSigmas | None,
    attempts: tuple[str, ...],
) -> Poses:
    def by_camera(by_name: Mapping[str, float] | None) -> dict[str, float]:
        return {} if by_name is None else {camera: by_name[name] for camera, name in names.items()}

    images = {image.name: image for image in reconstruction.images.values() if image.has_pose}
    swept = sorted(name for name in images if name.startswith(f"{SWEEP_FOLDER}/"))
    errors = []
    for image in images.values():
        camera = reconstruction.cameras[image.camera_id]
        observed = [point for point in image.points2D if point.has_point3D()]
        if not observed:
            continue
        world = np.array([reconstruction.points3D[point.point3D_id].xyz for point in observed])
        local = world @ _matrix(image)[:3, :3].T + _matrix(image)[:3, 3]
        pixels = np.asarray(camera.img_from_cam(local))
        errors.append(np.linalg.norm(pixels - np.array([point.xy for point in observed]), axis=1))
    distances = np.concatenate(errors)
    points = list(reconstruction.points3D.values())
    if swept:
        lens = _sweep_lens(reconstruction.cameras[images[swept[0]].camera_id])
    else:
        lens = Lens(1, 1, np.eye(3), np.zeros(5))
    return Poses(
        w2c={camera: _matrix(images[name]) for camera, name in names.items()},
        sweep_w2c=np.array([_matrix(images[name]) for name in swept]).reshape(-1, 4, 4),
        sweep_indices=tuple(int(Path(name).stem) for name in swept),
        sweep_lens=lens,
        n_sweep=n_sweep,
        points=np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
        colours=np.array([point.color for point in points], np.float64).reshape(-1, 3) / 255.0,
        mean_error_px=float(distances.mean()),
        rms_error_px=float(np.sqrt(np.mean(distances**2))),
        n_observations=len(distances),
        centre_sigma=by_camera(None if sigmas is None else sigmas.centre),
        rotation_sigma_deg=by_camera(None if sigmas is None else sigmas.rotation_deg),
        feature_centre_sigma=by_camera(None if sigmas is None else sigmas.feature_centre),
        feature_rotation_sigma_deg=by_camera(None if sigmas is None else sigmas.feature_rotation_deg),
        attempts=attempts,
        found_lenses={camera: _simple_lens(reconstruction.cameras[images[names[camera]].camera_id]) for camera in free},
    )


def _matrix(image: pycolmap.Image) -> Array:
    pose = image.cam_from_world
    matrix = np.eye(4)
    matrix[:3] = (pose() if callable(pose) else pose).matrix()
    return matrix


def _sweep_lens(camera: pycolmap.Camera) -> Lens:
    fx, fy, cx, cy, k1, k2, p1, p2 = camera.params
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Lens(camera.width, camera.height, K, np.array([k1, k2, p1, p2, 0.0]))


def _simple_lens(camera: pycolmap.Camera) -> Lens:
    focal, cx, cy, k1 = camera.params
    K = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    return Lens(camera.width, camera.height, K, np.array([k1, 0.0, 0.0, 0.0, 0.0]))

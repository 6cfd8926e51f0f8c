"""Camera poses by structure from motion on the textured static scene (paper Sec. 3, "Capture and calibration").

The seven fixed cameras see too little in common, so a handheld sweep bridges them. COLMAP (through pycolmap) gets the
fixed cameras' calibrated lenses, which it must not change, and one free lens shared by all frames of the sweep. The
result is up to a similarity; `metric` turns it into metres.

Repeatability: COLMAP's threads make its outcome differ between runs, already because they number the images in the
order of their arrival. One thread and fixed seeds give the same bits each time; for 7 + 25 images of 480 x 270 that
takes about as long as two threads do.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import write_png
from splashbench.prepare.lens import Array, Lens

SEED = 0
SWEEP_FRAMES = 25
MAX_FEATURE_WIDTH = 2048  # features of larger images are sought at this size, and given in pixels of the original
SMALL_WIDTH = 1000
MAX_COEFFICIENT = 100.0
DEFAULT_FOCAL = 1.2  # of the longer side, where nothing is known: COLMAP's own choice
FIXED_FOLDER, SWEEP_FOLDER = "fixed", "sweep"
# Extra parameters of COLMAP's FULL_OPENCV: fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6.
FIXED_MODEL, SWEEP_MODEL = "FULL_OPENCV", "OPENCV"


@dataclass(frozen=True)
class Poses:
    """Structure from motion's outcome, in its own units and frame until `transformed`.

    `w2c`: camera -> [4, 4]. `sweep_w2c`: [M, 4, 4], the registered frames of the sweep, which are
    number `sweep_indices` of those given. `points`: [N, 3];
    `colours`: [N, 3] in [0, 1]. `mean_error_px`: mean distance over all observations of all images between an observed
    feature and its point's projection, in pixels of the raw frames; `rms_error_px` the root mean square of the same.
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

    @property
    def mean_track_length(self) -> float:
        """Mean number of images that see a point."""
        return self.n_observations / max(len(self.points), 1)


def static_image(frames: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Median over frames [H, W, 3] of a scene in which nothing moves: the same picture with less noise."""
    return np.median(np.stack(frames), axis=0).round().astype(np.uint8)


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
) -> Poses:
    """Poses of the fixed cameras from one raw image each, bridged by frames of the sweep.

    `work` is an empty folder for COLMAP's images and database. `sweep_focal`: the sweep camera's focal length in
    pixels to start from; without it, 1.2 image widths. Its lens is refined, its principal point held at the middle.
    `threads`: 1 gives the same result each time. Raises SplashbenchError naming the cameras that could not be posed.
    """
    names = _write_images(static, sweep, work)
    database = work / "database.db"
    pycolmap.set_random_seed(SEED)
    with _quiet_colmap():
        camera_ids = _extract(database, work, names, lenses, sweep, sweep_focal, threads)
        options = pycolmap.FeatureMatchingOptions()
        options.num_threads = threads
        geometry = pycolmap.TwoViewGeometryOptions()
        geometry.ransac.random_seed = SEED
        pycolmap.match_exhaustive(
            database, matching_options=options, verification_options=geometry, device=pycolmap.Device.cpu
        )
        reconstruction = _map(database, work, camera_ids, threads)
    missing = sorted(set(static) - set(_registered(reconstruction, names)))
    if missing:
        raise SplashbenchError(
            f"sweep and static clips: no pose for camera {', '.join(missing)}; give the static scene more texture,"
            " or sweep slowly past the neighbours of these cameras"
        )
    return _collect(reconstruction, names, len(sweep))


@contextmanager
def _quiet_colmap() -> Iterator[None]:
    """COLMAP logs hundreds of lines to standard error; only its errors are left to see."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def _write_images(
    static: Mapping[str, NDArray[np.uint8]], sweep: Sequence[NDArray[np.uint8]], work: Path
) -> dict[str, str]:
    """Write all images as COLMAP wants them; returns fixed camera -> image name."""
    names = {camera: f"{FIXED_FOLDER}/{camera}.png" for camera in static}
    for camera, image in static.items():
        write_png(work / "images" / names[camera], image)
    for index, image in enumerate(sweep):
        write_png(work / "images" / SWEEP_FOLDER / f"{index:04d}.png", image)
    return names


def _extract(
    database: Path,
    work: Path,
    names: Mapping[str, str],
    lenses: Mapping[str, Lens],
    sweep: Sequence[NDArray[np.uint8]],
    sweep_focal: float | None,
    threads: int,
) -> dict[str, int]:
    """Features of all images, and the lenses written into the database; returns fixed camera -> COLMAP camera id."""
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = threads
    # Doubling small images finds about twice the features; large ones have enough, and take minutes and gigabytes.
    width = max(lens.width for lens in lenses.values())
    extraction.max_image_size = MAX_FEATURE_WIDTH
    extraction.sift.first_octave = -1 if width < SMALL_WIDTH else 0
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = FIXED_MODEL
    pycolmap.extract_features(
        database,
        work / "images",
        image_names=list(names.values()),
        camera_mode=pycolmap.CameraMode.PER_IMAGE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    if sweep:
        height, width = sweep[0].shape[:2]
        focal = sweep_focal or DEFAULT_FOCAL * max(width, height)
        params = [focal, focal, width / 2, height / 2, 0.0, 0.0, 0.0, 0.0]
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = SWEEP_MODEL
        reader.camera_params = ",".join(str(value) for value in params)
        pycolmap.extract_features(
            database,
            work / "images",
            image_names=[f"{SWEEP_FOLDER}/{index:04d}.png" for index in range(len(sweep))],
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
    camera_ids = {}
    with pycolmap.Database.open(database) as opened:
        by_name = {image.name: image for image in opened.read_all_images()}
        for camera, name in names.items():
            record = opened.read_camera(by_name[name].camera_id)
            lens = lenses[camera]
            K, (k1, k2, p1, p2, k3) = lens.K, lens.distortion
            record.params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
            record.has_prior_focal_length = True
            opened.update_camera(record)
            camera_ids[camera] = record.camera_id
    return camera_ids


def _map(database: Path, work: Path, camera_ids: Mapping[str, int], threads: int) -> pycolmap.Reconstruction | None:
    """Incremental mapping with the fixed cameras' lenses held; the model with the most fixed cameras, or None."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = threads
    options.random_seed = SEED
    options.mapper.random_seed = SEED
    options.triangulation.random_seed = SEED
    options.constant_cameras = set(camera_ids.values())
    options.min_model_size = 3
    # COLMAP takes large distortion coefficients for a sign of a bad guess; these have been measured.
    for limited in (options, options.mapper, options.triangulation):
        limited.max_extra_param = MAX_COEFFICIENT
    # Registering an image may not bend its lens; the sweep's is refined by bundle adjustment instead.
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    output = work / "sparse"
    output.mkdir()
    models = pycolmap.incremental_mapping(database, work / "images", output, options)
    if not models:
        return None
    wanted = set(camera_ids.values())
    return max(
        models.values(),
        key=lambda model: (
            sum(image.has_pose and image.camera_id in wanted for image in model.images.values()),
            model.num_reg_images(),
        ),
    )


def _registered(reconstruction: pycolmap.Reconstruction | None, names: Mapping[str, str]) -> dict[str, Array]:
    """Fixed camera -> w2c [4, 4], of those with a pose."""
    if reconstruction is None:
        return {}
    found = {image.name: image for image in reconstruction.images.values() if image.has_pose}
    return {camera: _matrix(found[name]) for camera, name in names.items() if name in found}


def _collect(reconstruction: pycolmap.Reconstruction, names: Mapping[str, str], n_sweep: int) -> Poses:
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
        w2c=_registered(reconstruction, names),
        sweep_w2c=np.array([_matrix(images[name]) for name in swept]).reshape(-1, 4, 4),
        sweep_indices=tuple(int(Path(name).stem) for name in swept),
        sweep_lens=lens,
        n_sweep=n_sweep,
        points=np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
        colours=np.array([point.color for point in points], np.float64).reshape(-1, 3) / 255.0,
        mean_error_px=float(distances.mean()),
        rms_error_px=float(np.sqrt(np.mean(distances**2))),
        n_observations=len(distances),
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

"""COLMAP's part of the poses: features, matches, incremental mapping, and a second try where it fails.

COLMAP begins with the pair of images that it ranks first, and accepts an image that shows enough of what is mapped
already. Where a fixed camera is left out, the same matches are mapped again with lower thresholds, and then from other
pairs; the attempts are part of the result. Features are SIFT on the CPU: the learned ones abort the process where their
network's file is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.colmap import pycolmap
from splashbench.errors import SplashbenchError
from splashbench.files import write_png
from splashbench.prepare.calibration.lens import Lens

SEED = 0
MAX_FEATURE_WIDTH = 2048  # features of larger images are sought at this size, and given in pixels of the original
SMALL_WIDTH = 1200
MAX_COEFFICIENT = 100.0
DEFAULT_FOCAL = 1.2  # of the longer side, where nothing is known: COLMAP's own choice
FIXED_FOLDER, SWEEP_FOLDER = "fixed", "sweep"
# A known lens, the sweep's, and one of which nothing is known. Extra parameters of FULL_OPENCV: fx fy cx cy k1 k2 p1 p2
# k3 k4 k5 k6; of SIMPLE_RADIAL: f cx cy k1.
FIXED_MODEL, SWEEP_MODEL, UNKNOWN_MODEL = "FULL_OPENCV", "OPENCV", "SIMPLE_RADIAL"
MAX_PAIRS = 3  # other pairs to begin with, once lower thresholds have not helped
# COLMAP's, and the lower ones of a second try: inliers of the first pair and its angle in degrees, and inliers of an
# image that is added.
INLIERS, ANGLE, ADDED_INLIERS = (100, 50), (16.0, 8.0), (30, 15)

MIN_FOR_PRINCIPAL_POINT = 8  # images of one camera

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Workplace:
    """COLMAP's folder: its database, and the names by which it knows the images."""

    folder: Path
    names: Mapping[str, str]  # fixed camera -> image name
    fixed_lenses: frozenset[int]  # COLMAP's numbers of the cameras whose lens is known
    threads: int
    swept: bool = False  # whether a sweep bridges the fixed cameras

    @property
    def database(self) -> Path:
        return self.folder / "database.db"


@dataclass(frozen=True)
class Mapped:
    """A reconstruction, and how each attempt at one ended; it is the last attempt's, or else the best one's."""

    reconstruction: pycolmap.Reconstruction
    attempts: tuple[str, ...]


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """COLMAP logs hundreds of lines to standard error, its errors among them: what went wrong, this program says."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def match(
    fixed: Mapping[str, Image],
    lenses: Mapping[str, Lens],
    sweep: Sequence[Image],
    folder: Path,
    sweep_focal: float | None,
    threads: int,
) -> Workplace:
    """Features of all images and their matches, each image with each, in a database in the empty `folder`.

    A camera without an entry in `lenses` gets a free one of its own (focal length and one radial coefficient).
    """
    names = {camera: f"{FIXED_FOLDER}/{camera}.png" for camera in fixed}
    for camera, image in fixed.items():
        write_png(folder / "images" / names[camera], image)
    swept = [f"{SWEEP_FOLDER}/{index:04d}.png" for index in range(len(sweep))]
    for name, image in zip(swept, sweep):
        write_png(folder / "images" / name, image)
    pycolmap.set_random_seed(SEED)

    calibrated = [names[camera] for camera in fixed if camera in lenses]
    uncalibrated = [names[camera] for camera in fixed if camera not in lenses]
    width = max(image.shape[1] for image in [*fixed.values(), *sweep[:1]])
    extract = _extractor(folder, width, threads)
    if calibrated:
        extract(calibrated, pycolmap.CameraMode.PER_IMAGE, FIXED_MODEL, None)
    if uncalibrated:
        extract(uncalibrated, pycolmap.CameraMode.PER_IMAGE, UNKNOWN_MODEL, None)
    if sweep:
        height, width = sweep[0].shape[:2]
        focal = sweep_focal or DEFAULT_FOCAL * max(width, height)
        params = [focal, focal, width / 2, height / 2, 0.0, 0.0, 0.0, 0.0]
        extract(swept, pycolmap.CameraMode.SINGLE, SWEEP_MODEL, params)
    workplace = Workplace(folder, names, _write_lenses(folder / "database.db", names, lenses), threads, bool(sweep))

    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = threads
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = SEED
    pycolmap.match_exhaustive(
        workplace.database, matching_options=options, verification_options=geometry, device=pycolmap.Device.cpu
    )
    return workplace


def _extractor(
    folder: Path, width: int, threads: int
) -> Callable[[list[str], pycolmap.CameraMode, str, list[float] | None], None]:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = threads
    # Doubling small images finds about twice the features, and places them better (the error in ten photographs about
    # 1000 px wide is 0.33 px instead of 0.47 px); large images have enough of them, and take minutes and gigabytes.
    options.max_image_size = MAX_FEATURE_WIDTH
    options.sift.first_octave = -1 if width < SMALL_WIDTH else 0

    def extract(names: list[str], mode: pycolmap.CameraMode, model: str, params: list[float] | None) -> None:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = model
        if params is not None:
            reader.camera_params = ",".join(str(value) for value in params)
        pycolmap.extract_features(
            folder / "database.db",
            folder / "images",
            image_names=names,
            camera_mode=mode,
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )

    return extract


def _write_lenses(database: Path, names: Mapping[str, str], lenses: Mapping[str, Lens]) -> frozenset[int]:
    """Write the known lenses into the database; returns the numbers of their cameras there."""
    fixed = set()
    with pycolmap.Database.open(database) as opened:
        by_name = {image.name: image for image in opened.read_all_images()}
        for camera, name in names.items():
            if camera not in lenses:
                continue
            record = opened.read_camera(by_name[name].camera_id)
            K, (k1, k2, p1, p2, k3) = lenses[camera].K, lenses[camera].distortion
            record.params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
            record.has_prior_focal_length = True
            opened.update_camera(record)
            fixed.add(record.camera_id)
    return frozenset(fixed)


def map_images(workplace: Workplace) -> Mapped | None:
    """The reconstruction with the most fixed cameras of up to five attempts; None where no attempt gave any.

    The first with all fixed cameras that share enough matches with any other image ends the search.
    """
    pairs = _verified_pairs(workplace)
    matched = {name for _, *both in pairs for _, name in both}
    reachable = len(matched.intersection(workplace.names.values()))
    best: tuple[tuple[int, int], pycolmap.Reconstruction] | None = None
    attempts: list[str] = []
    for label, options in _attempts(workplace, pairs):
        output = workplace.folder / f"sparse{len(attempts)}"
        output.mkdir()
        models = pycolmap.incremental_mapping(workplace.database, workplace.folder / "images", output, options).values()
        ranked = [(_merit(model, workplace), model) for model in models]
        top = max(ranked, key=lambda pair: pair[0], default=((0, 0), None))
        attempts.append(f"{label}: {top[0][0]} of {len(workplace.names)} fixed cameras, {top[0][1]} images in all")
        if top[1] is not None and (best is None or top[0] > best[0]):
            best = top
        if best is not None and best[0][0] >= reachable:
            break
    return None if best is None else Mapped(best[1], tuple(attempts))


_Pair = tuple[int, tuple[int, str], tuple[int, str]]  # verified matches; number and name of either image


def _verified_pairs(workplace: Workplace) -> list[_Pair]:
    """The pairs of images that share enough for one to be added to the other, those with the most in common first."""
    with pycolmap.Database.open(workplace.database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        numbers, inliers = opened.read_two_view_geometry_num_inliers()
    pairs = []
    for number, count in zip(numbers, inliers):
        first, second = pycolmap.pair_id_to_image_pair(number)
        if count >= ADDED_INLIERS[1]:
            pairs.append((int(count), (int(first), names[first]), (int(second), names[second])))
    return sorted(pairs, key=lambda pair: (-pair[0], pair[1:]))


def _attempts(
    workplace: Workplace, pairs: Sequence[_Pair]
) -> Iterator[tuple[str, pycolmap.IncrementalPipelineOptions]]:
    yield "COLMAP's thresholds", _mapping_options(workplace, 0)
    yield "lower thresholds", _mapping_options(workplace, 1)
    fixed = set(workplace.names.values())
    with_fixed = [both for _, *both in pairs if both[0][1] in fixed or both[1][1] in fixed]
    for (first, first_name), (second, second_name) in with_fixed[:MAX_PAIRS]:
        options = _mapping_options(workplace, 1)
        options.init_image_id1, options.init_image_id2 = first, second
        yield f"lower thresholds, beginning with {first_name} and {second_name}", options


def _mapping_options(workplace: Workplace, level: int) -> pycolmap.IncrementalPipelineOptions:
    """Known lenses fixed, one seed everywhere; `level` 0 has COLMAP's thresholds, 1 lower ones."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = workplace.threads
    options.random_seed = SEED
    options.mapper.random_seed = SEED
    options.triangulation.random_seed = SEED
    options.constant_cameras = set(workplace.fixed_lenses)
    options.min_model_size = 3
    options.mapper.init_min_num_inliers = INLIERS[level]
    options.mapper.init_min_tri_angle = ANGLE[level]
    options.mapper.abs_pose_min_num_inliers = ADDED_INLIERS[level]
    # COLMAP takes large distortion coefficients for a sign of a bad guess; these have been measured.
    if workplace.fixed_lenses:
        for limited in (options, options.mapper, options.triangulation):
            limited.max_extra_param = MAX_COEFFICIENT
    # Registering an image may not bend its lens; the sweep's is refined by bundle adjustment instead.
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    return options


def _merit(model: pycolmap.Reconstruction, workplace: Workplace) -> tuple[int, int]:
    """How many fixed cameras have a pose, then how many images."""
    fixed = set(workplace.names.values())
    return sum(image.has_pose and image.name in fixed for image in model.images.values()), model.num_reg_images()


def refine(reconstruction: pycolmap.Reconstruction, workplace: Workplace) -> bool:
    """One last bundle adjustment over everything, in which the sweep's principal point is free; whether it was.

    Fixed at the middle, where it seldom is, it bends the scene: 13 px off at 1280 px doubled the errors of the fixed
    cameras. Many frames of one camera determine it; a single image of a camera does not.
    """
    config = pycolmap.BundleAdjustmentConfig()
    n_images: dict[int, int] = {}
    for image_id in sorted(reconstruction.reg_image_ids()):
        config.add_image(image_id)
        camera_id = reconstruction.images[image_id].camera_id
        n_images[camera_id] = n_images.get(camera_id, 0) + 1
    for camera_id in n_images:
        if camera_id in workplace.fixed_lenses:
            config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    refined = [count for camera_id, count in n_images.items() if camera_id not in workplace.fixed_lenses]
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = bool(refined) and min(refined) >= MIN_FOR_PRINCIPAL_POINT
    options.print_summary = False
    options.ceres.solver_options.num_threads = workplace.threads
    pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction).solve()
    return bool(options.refine_principal_point)


def require_posed(workplace: Workplace, mapped: Mapped | None) -> Mapped:
    """`mapped`, where it has a pose for every fixed camera; else raise SplashbenchError naming those without."""
    posed = set() if mapped is None else {i.name for i in mapped.reconstruction.images.values() if i.has_pose}
    missing = sorted(camera for camera, name in workplace.names.items() if name not in posed)
    if mapped is None or missing:
        if workplace.swept:
            where, bridge = "sweep and static scene", "sweep slowly past the neighbours of these cameras"
        else:
            where, bridge = "static scene", "film a hand-held [sweep] past these cameras, which the session lacks"
        raise SplashbenchError(
            f"{where}: no pose for camera {', '.join(missing)}; give the static scene more texture, or {bridge}"
        )
    return mapped

"""Judge a prepared scene by the truth of the synthetic session it came from, and give it its true particles.

Errors are stated as a user would ask for them: of the clocks, the lenses, the poses, the metre and the masks. A
reconstruction has a frame of its own, so it is aligned with the world first. True points of the liquid are projected by
the true cameras and triangulated by the estimated ones; the similarity between the two clouds is used throughout. The
camera centres alone would not do: on an arc they leave the turn about its chord open, by a third of a degree at
millimetre errors.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from splashbench.alignment import Similarity, umeyama
from splashbench.errors import SplashbenchError
from splashbench.files import read_gray, read_model
from splashbench.scene import Particles, Scene
from splashbench.synth.imaging.lens import distort, undistort
from splashbench.synth.recording.truth import Truth

Array = NDArray[np.float64]
# Radians, a twentieth of a pixel: cameras that agree to this count alike.
_SEEN_AS_EXACT = 7e-5


class _FromReport(BaseModel):
    """A part of prepare_report.json; other keys are ignored."""

    model_config = ConfigDict(extra="ignore")


class _Sync(_FromReport):
    start_s: float
    clock_rate: float


class _Intrinsics(_FromReport):
    K: list[list[float]]
    distortion: list[float]
    width: int
    height: int


class _Pose(_FromReport):
    w2c: list[list[float]]


class _PrepareReport(_FromReport):
    reference: str
    sync: dict[str, _Sync]
    intrinsics: dict[str, _Intrinsics]
    poses: dict[str, _Pose]


class CameraErrors(BaseModel):
    """One camera's errors; `mask_iou` is the mean over frames, None where the scene's masks cannot be compared."""

    model_config = ConfigDict(extra="forbid")
    sync_error_ms: float
    focal_error_percent: float
    rotation_error_deg: float
    position_error_mm: float
    mask_iou: float | None


class Verification(BaseModel):
    """What a prepared scene got wrong. `scale_error_percent` is None where the scene states no metric scale."""

    model_config = ConfigDict(extra="forbid")
    session: str
    scene: str
    reference: str
    cameras: dict[str, CameraErrors]
    sync_error_ms: float
    focal_error_percent: float
    rotation_error_deg: float
    position_error_mm: float
    scale_error_percent: float | None
    mask_iou: float | None
    particles_attached: int


def verify_scene(session: Path, scene_directory: Path, attach: bool = True) -> Verification:
    """Compare the scene made from `session` with its truth; with `attach`, write the scene's truth/particles.npz.

    Raises SplashbenchError where the session has no truth, or the scene was not made by `splashbench prepare` from it.
    """
    truth = Truth(session)
    scene = Scene.open(scene_directory)
    report_path = Path(scene_directory) / "prepare_report.json"
    report = read_model(report_path, _PrepareReport)
    names = set(truth.file.cameras)
    for what, reported in (("sync", report.sync), ("intrinsics", report.intrinsics), ("poses", report.poses)):
        if set(reported) != names:
            raise SplashbenchError(
                f"{report_path}: {what} covers the cameras {sorted(reported)}, the session {sorted(names)}; "
                "give the scene that was prepared from this session"
            )
    if report.reference not in names or set(scene.cameras) != names:
        raise SplashbenchError(f"{scene_directory} has other cameras than {session}; give the scene prepared from it")
    sync = {name: sync_error(truth, report, name) for name in scene.cameras}
    points = _liquid_points(truth)
    world_from_scene = umeyama(nearest_to_rays(truth, report, points), points)
    cameras = {
        name: CameraErrors(
            sync_error_ms=1e3 * sync[name],
            focal_error_percent=_focal_error(truth, report, name),
            mask_iou=mask_iou(truth, scene, report, name),
            **_pose_errors(truth, report, world_from_scene, name),
        )
        for name in sorted(names)
    }
    ious = [errors.mask_iou for errors in cameras.values() if errors.mask_iou is not None]
    metres = scene.metres_per_unit
    return Verification(
        session=str(session),
        scene=str(scene_directory),
        reference=report.reference,
        cameras=cameras,
        sync_error_ms=_largest([errors.sync_error_ms for errors in cameras.values()]),
        focal_error_percent=_largest([errors.focal_error_percent for errors in cameras.values()]),
        rotation_error_deg=_largest([errors.rotation_error_deg for errors in cameras.values()]),
        position_error_mm=_largest([errors.position_error_mm for errors in cameras.values()]),
        scale_error_percent=None if metres is None else 100 * (metres / world_from_scene.scale - 1),
        mask_iou=float(np.mean(ious)) if ious else None,
        particles_attached=attach_particles(truth, scene, report.reference, world_from_scene) if attach else 0,
    )


def _largest(values: list[float]) -> float:
    """The value furthest from zero, with its sign."""
    return max(values, key=abs)


def sync_error(truth: Truth, report: _PrepareReport, name: str) -> float:
    """Estimated minus true time on the reference's clock, in seconds, where it is worst during the pour."""
    camera, reference = truth.file.cameras[name], truth.file.cameras[report.reference]
    common = np.array([truth.file.pour.start_s, truth.file.pour.end_s])
    local = (common - camera.start_s) / camera.clock_rate
    estimated = report.sync[name].start_s + report.sync[name].clock_rate * local
    true = (common - reference.start_s) / reference.clock_rate
    return _largest((estimated - true).tolist())


def _focal_error(truth: Truth, report: _PrepareReport, name: str) -> float:
    estimated, true = np.array(report.intrinsics[name].K), np.array(truth.file.cameras[name].K)
    return float(100 * ((estimated[0, 0] + estimated[1, 1]) / (true[0, 0] + true[1, 1]) - 1))


def _centres(matrices: list[list[list[float]]] | list[Array]) -> Array:
    poses = np.array(matrices, np.float64)
    return -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])


def _liquid_points(truth: Truth, instants: int = 5, max_points: int = 2000) -> Array:
    """True particles [N, 3], spread over the pour and over the particles there are."""
    pour = truth.file.pour
    times = pour.start_s + (pour.end_s - pour.start_s) * (np.arange(instants) + 1) / (instants + 1)
    positions, _, active = truth.particles_at(times)
    points = positions[active].astype(np.float64)
    return points[:: max(1, len(points) // max_points)]


def nearest_to_rays(truth: Truth, report: _PrepareReport, points: Array, rounds: int = 10) -> Array:
    """Where the estimated cameras see world points [N, 3], in the report's frame: nearest to all their rays.

    A camera far off the others counts for less (each round weighs it by the inverse square of its rays' miss), so that
    one wrong camera is found wrong and does not turn the rest.
    """
    names = sorted(truth.file.cameras)
    centres = _centres([report.poses[name].w2c for name in names])
    off_ray = np.stack([_off_ray(truth, report, name, points) for name in names])
    weights = np.ones(len(names))
    for _ in range(rounds):
        across = np.einsum("c,cnij->nij", weights, off_ray)
        along = np.einsum("c,cnij,cj->ni", weights, off_ray, centres)
        nearest = np.linalg.solve(across, along[..., None])[..., 0]
        reach = nearest - centres[:, None]
        miss = np.linalg.norm(np.einsum("cnij,cnj->cni", off_ray, reach), axis=2) / np.linalg.norm(reach, axis=2)
        weights = 1.0 / (np.mean(miss**2, axis=1) + _SEEN_AS_EXACT**2)
        weights /= weights.sum()
    return np.asarray(nearest)


def _off_ray(truth: Truth, report: _PrepareReport, name: str, points: Array) -> Array:
    """Projectors [N, 3, 3] onto the plane across the ray along which the estimated camera sees each world point."""
    camera, lens, pose = truth.file.cameras[name], report.intrinsics[name], np.array(report.poses[name].w2c)
    w2c, K = np.array(camera.w2c), np.array(camera.K)
    local = points @ w2c[:3, :3].T + w2c[:3, 3]
    raw = distort(local[:, :2] / local[:, 2:], np.array(camera.distortion)) @ K[:2, :2].T + K[:2, 2]
    K = np.array(lens.K)
    seen = undistort((raw - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T, np.array(lens.distortion))
    rays = np.concatenate([seen, np.ones((len(seen), 1))], axis=1) @ pose[:3, :3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return np.asarray(np.eye(3) - rays[:, :, None] * rays[:, None, :])


def _pose_errors(truth: Truth, report: _PrepareReport, world_from_scene: Similarity, name: str) -> dict[str, float]:
    estimated, true = np.array(report.poses[name].w2c), np.array(truth.file.cameras[name].w2c)
    turn = estimated[:3, :3] @ world_from_scene.rotation.T @ true[:3, :3].T
    angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    offset = world_from_scene.apply(_centres([estimated])) - _centres([true])
    return {"rotation_error_deg": float(angle), "position_error_mm": float(1e3 * np.linalg.norm(offset))}


def mask_iou(truth: Truth, scene: Scene, report: _PrepareReport, name: str) -> float | None:
    """Mean IoU of the scene's masks with the true ones, seen through the lens that `prepare` estimated.

    Frames in which neither has liquid count as 1. None for a scene without frames.
    """
    import cv2

    camera, recorder, lens = scene.cameras[name], truth.file.cameras[name], report.intrinsics[name]
    clock = report.sync[name]
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    normalised = np.stack([(u - camera.K[0, 2]) / camera.K[0, 0], (v - camera.K[1, 2]) / camera.K[1, 1]], axis=-1)
    K = np.array(lens.K)
    raw = distort(normalised, np.array(lens.distortion)) @ K[:2, :2].T + K[:2, 2]
    # OpenCV counts pixel centres at whole numbers.
    map_x, map_y = ((raw[..., k] - 0.5).astype(np.float32) for k in (0, 1))
    ious = []
    for t, time in enumerate(scene.camera_times[name]):
        source = round((time - clock.start_s) / clock.clock_rate * recorder.fps)
        path = truth.mask_path(name, source)
        mask = scene.mask(name, t)
        if not path.is_file():
            ious.append(0.0 if mask.any() else 1.0)
            continue
        seen = cv2.remap(read_gray(path), map_x, map_y, cv2.INTER_LINEAR) > 127
        union = np.count_nonzero(seen | mask)
        ious.append(np.count_nonzero(seen & mask) / union if union else 1.0)
    return float(np.mean(ious)) if ious else None


def attach_particles(truth: Truth, scene: Scene, reference: str, world_from_scene: Similarity) -> int:
    """Write the true particles, at the scene's times and in its coordinates, to its truth/; returns their number."""
    clock = truth.file.cameras[reference]
    positions, velocities, active = truth.particles_at(clock.start_s + clock.clock_rate * scene.times)
    particles = Particles(
        positions=(world_from_scene.invert(positions.astype(np.float64)) * active[..., None]).astype(np.float32),
        active=active,
        velocities=(world_from_scene.invert_vectors(velocities.astype(np.float64)) * active[..., None]).astype(
            np.float32
        ),
    )
    particles.save(scene.directory / "truth" / "particles.npz")
    return int(active.any(axis=0).sum())

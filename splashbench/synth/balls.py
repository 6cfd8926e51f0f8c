"""A synthetic scene in a second: blue balls in ballistic flight over a patterned floor, with exact ground truth.

No simulation and no ray-tracing library: silhouettes, times, gravity and particles are analytic, so every figure a
test wants is known. It is for trying a new method (CONTRIBUTING.md) and for the tests, not for benchmarking.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.files import atomic_directory
from splashbench.scene import Camera, Particles, Scene, SceneMeta, write_scene

GRAVITY = 9.81
_TRAIN, _TEST = ("1", "2", "3", "4", "5"), ("6", "7")
#: Place on the arc of cameras 1 to 7: both test views lie between training views, as in the paper's rig.
_ARC_PLACES = (0, 2, 3, 5, 6, 1, 4)
_RADII = np.array([0.10, 0.08, 0.06])
_STARTS = np.array([[-0.20, 0.30, 0.0], [0.10, 0.45, 0.05], [0.0, 0.20, -0.10]])
_VELOCITIES = np.array([[0.8, 1.2, 0.0], [-0.5, 0.6, -0.3], [0.2, 1.8, 0.4]])
_COLOURS = np.array([[0.10, 0.30, 0.85], [0.15, 0.45, 0.80], [0.05, 0.20, 0.70]])
#: Half the mean spacing of the largest ball's particles.
_PARTICLE_RADIUS = 0.0138
_LIGHT = np.array([0.4, 0.8, 0.45]) / np.linalg.norm([0.4, 0.8, 0.45])


def write_balls_scene(
    directory: Path,
    size: tuple[int, int] = (96, 64),
    n_frames: int = 8,
    seed: int = 0,
    delays: Mapping[str, float] | None = None,
    replace: bool = False,
) -> Scene:
    """Write the scene and return it. Lengths are metres, y points up, steps are uneven as in real captures.

    Args:
        size: (width, height) of the images in pixels.
        n_frames: timesteps within a third of a second.
        seed: of the particles' places within the balls and the unevenness of the steps.
        delays: seconds after each timestep at which the named cameras, "1" to "7", expose; 0 for the others.
    """
    rng = np.random.default_rng(seed)
    times = np.linspace(0.0, 0.33, n_frames) + np.where(np.arange(n_frames) % 2, 0.25, 0.0) * 0.33 / n_frames
    cameras = ball_cameras(size)
    exposed = {name: times + (delays or {}).get(name, 0.0) for name in cameras}
    meta = SceneMeta(
        name="balls",
        times=times.tolist(),
        camera_times={name: instants.tolist() for name, instants in exposed.items()} if delays else None,
        metres_per_unit=1.0,
        gravity=(0.0, -1.0, 0.0),
        provenance={"made_by": "splashbench.synth.balls", "seed": seed, "particle_radius": _PARTICLE_RADIUS},
    )
    with atomic_directory(Path(directory), replace=replace, holds="train_meta.json") as staging:
        write_scene(
            staging,
            cameras=cameras,
            train=_TRAIN,
            test=_TEST,
            n_frames=n_frames,
            frames=_frames(cameras, exposed),
            meta=meta,
            initial_points=floor_points(),
        )
        truth_particles(times, rng).save(staging / "truth" / "particles.npz")
    return Scene.open(directory)


def ball_centers(time: float) -> NDArray[np.float64]:
    """Centres [3, 3] of the balls at `time` seconds: free flight."""
    fall = np.array([0.0, -0.5 * GRAVITY * time**2, 0.0])
    return _STARTS + _VELOCITIES * time + fall


def truth_particles(times: NDArray[np.float64], rng: np.random.Generator, per_ball: int = 200) -> Particles:
    """Particles spread uniformly through the balls and moving with them, with exact velocities."""
    directions = rng.normal(size=(len(_RADII), per_ball, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    offsets = directions * (_RADII[:, None, None] * rng.random((len(_RADII), per_ball, 1)) ** (1 / 3))
    positions = np.stack([(ball_centers(t)[:, None] + offsets).reshape(-1, 3) for t in times])
    falling = np.array([0.0, -GRAVITY, 0.0])
    velocities = np.stack([np.repeat(_VELOCITIES + falling * t, per_ball, axis=0) for t in times])
    active = np.ones(positions.shape[:2], dtype=bool)
    return Particles(positions.astype(np.float32), active, velocities.astype(np.float32))


def ball_cameras(size: tuple[int, int]) -> dict[str, Camera]:
    """The seven cameras by name, "1" to "7", of images of `size` (width, height) in pixels."""
    return {str(i + 1): _camera(str(i + 1), place, size) for i, place in enumerate(_ARC_PLACES)}


def _camera(name: str, place: int, size: tuple[int, int]) -> Camera:
    azimuth = np.radians(-38.5 + 77.0 * place / 6)
    elevation = np.radians(22.0)
    target = np.array([0.0, 0.3, 0.0])
    outward = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    eye = target + 2.2 * outward
    right = np.cross(-outward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(-outward, right), -outward])
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = rotation, -rotation @ eye
    width, height = size
    focal = 1.5 * width
    # Off-centre, as in a crop: a method that ignores the principal point is found out.
    K = np.array([[focal, 0, 0.48 * width], [0, focal, 0.53 * height], [0, 0, 1]])
    return Camera(name, width, height, K, w2c)


def _frames(
    cameras: dict[str, Camera], times: dict[str, NDArray[np.float64]]
) -> Iterator[tuple[str, int, NDArray[np.uint8], NDArray[np.bool_]]]:
    for name, camera in cameras.items():
        for t, time in enumerate(times[name]):
            yield name, t, *render_balls(camera, ball_centers(time))


def render_balls(camera: Camera, centers: NDArray[np.float64]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Ray-cast image uint8 [H, W, 3] and mask [H, W] of balls around `centers` [3, 3]."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    local = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T
    rays = local @ camera.w2c[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    eye = camera.center
    nearest = np.full(u.shape, np.inf)
    colour = _floor_and_sky(eye, rays)
    mask = np.zeros(u.shape, dtype=bool)
    for center, radius, tint in zip(centers, _RADII, _COLOURS):
        along = rays @ (center - eye)
        discriminant = along**2 - ((center - eye) ** 2).sum() + radius**2
        distance = along - np.sqrt(np.maximum(discriminant, 0.0))
        hit = (discriminant > 0) & (distance > 0) & (distance < nearest)
        normal = (eye + distance[..., None] * rays - center) / radius
        shaded = tint * (0.45 + 0.55 * np.maximum(normal @ _LIGHT, 0.0))[..., None]
        colour[hit] = shaded[hit]
        nearest[hit] = distance[hit]
        mask |= hit
    return np.round(np.clip(colour, 0, 1) * 255).astype(np.uint8), mask


def _pattern(x: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Floor colour [..., 3] at (x, z): smooth, so that small images do not alias."""
    wave = 0.5 + 0.25 * np.sin(9 * x + 2 * z) + 0.25 * np.cos(7 * z - 3 * x)
    return np.stack([0.45 + 0.3 * wave, 0.4 + 0.2 * wave, 0.3 + 0.15 * wave], axis=-1)


def _floor_and_sky(eye: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    distance = -eye[1] / np.where(rays[..., 1] < -1e-6, rays[..., 1], -1e-6)
    x, z = eye[0] + distance * rays[..., 0], eye[2] + distance * rays[..., 2]
    floor = (rays[..., 1] < -1e-6) & (np.abs(x) < 3) & (np.abs(z) < 3)
    return np.where(floor[..., None], _pattern(np.clip(x, -3, 3), np.clip(z, -3, 3)), [0.75, 0.8, 0.85])


def floor_points(n: int = 24) -> NDArray[np.float32]:
    """Coloured points on the floor [n * n, 7], as a sparse reconstruction would give them."""
    x, z = (grid.ravel() for grid in np.meshgrid(np.linspace(-1.5, 1.5, n), np.linspace(-1.5, 1.5, n)))
    zero = np.zeros(n * n)
    return np.column_stack([x, zero, z, _pattern(x, z), zero]).astype(np.float32)

"""From where a video looks: the camera of each frame, and what an orbit goes around."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splashbench.replay import Reconstruction
from splashbench.replay.paths import CameraPath, orbit
from splashbench.scene import Camera

# Instants at which the liquid's place is looked up.
_SAMPLES = 5
# Mean square of how far the cameras' rows leave a line, from which they span the level: an arc of some 20 degrees.
_SPREAD = 0.01


def resized(camera: Camera, factor: float) -> Camera:
    """`camera` with `factor` times as many pixels a side; itself at 1, so that stored views are still its own."""
    return camera if factor == 1 else camera.scaled(factor)


def orbit_of(
    reconstruction: Reconstruction, frames: int, degrees: float | None, height: float | None, fps: float
) -> CameraPath:
    """A path of `frames` cameras around the liquid, see `splashbench.replay.paths.orbit`."""
    cameras = [reconstruction.cameras[name] for name in reconstruction.train]
    up = _up(reconstruction, cameras)
    return orbit(cameras, liquid_center(reconstruction), up, frames, degrees=degrees, height=height, fps=fps)


def _up(reconstruction: Reconstruction, cameras: list[Camera]) -> NDArray[np.float64]:
    """Against gravity where it is known, else what is upright by the cameras."""
    if reconstruction.gravity is not None:
        return -np.asarray(reconstruction.gravity, dtype=np.float64)
    return upright(cameras)


def upright(cameras: list[Camera]) -> NDArray[np.float64]:
    """The direction that is up by `cameras` [3]: that to which the rows of their pictures, level as people hold a
    camera, are most nearly perpendicular.

    What is up in the pictures themselves leans towards the liquid, as cameras look down on it. It serves where all of
    them stand in one direction, so that their rows do not tell.
    """
    mean = np.asarray(-np.mean([camera.w2c[1, :3] for camera in cameras], axis=0))
    rows = np.array([camera.w2c[0, :3] for camera in cameras])
    sizes, directions = np.linalg.eigh(rows.T @ rows / len(rows))
    if sizes[1] < _SPREAD:
        return mean
    up = directions[:, 0]
    return np.asarray(up if up @ mean > 0 else -up)


def liquid_center(reconstruction: Reconstruction) -> NDArray[np.float64]:
    """The middle of the liquid over the recording [3], scene units.

    It is that of the surface, else of the particles; where a method hands in neither, what the cameras look at.
    """
    times = reconstruction.times[np.linspace(0, len(reconstruction.times) - 1, _SAMPLES).astype(int)]
    centers = []
    for time in dict.fromkeys(times.tolist()):
        surface = reconstruction.surface(time)
        inside = np.argwhere(surface.phi[0] < 0) if surface is not None else np.zeros((0, 3))
        if surface is not None and len(inside):
            centers.append(surface.origin + surface.voxel * inside.mean(axis=0))
    if centers:
        return np.asarray(np.mean(centers, axis=0))
    particles = reconstruction.particles()
    if particles is not None and particles.active.any():
        return np.asarray(particles.positions[particles.active].mean(axis=0, dtype=np.float64))
    return looked_at([reconstruction.cameras[name] for name in reconstruction.train])


def looked_at(cameras: list[Camera]) -> NDArray[np.float64]:
    """The point nearest to the optical axes of all `cameras` [3]."""
    axes = np.array([camera.w2c[2, :3] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    centers = np.array([camera.center for camera in cameras])
    # Parallel axes have no such point, and the solution of least squares then is one beside the cameras' middle.
    return np.asarray(np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, centers), rcond=None)[0])

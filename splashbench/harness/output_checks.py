"""Checks of what a method returns: renders, particles, signed distance. A fault is a status and a reason."""

from __future__ import annotations

import numpy as np

from splashbench.harness.contract import Render
from splashbench.harness.messages import Failure
from splashbench.scene import Camera, Particles, SignedDistance
from splashbench.submission import Status

_OVERSHOOT = 0.5


def checked_render(render: Render, camera: Camera, where: str) -> Render:
    """`render` with its arrays as arrays, after checking type, size, finiteness and range.

    where: how a reason names the view. Raises Failure.
    """
    if not isinstance(render, Render):
        raise Failure(Status.INCOMPLETE, f"{where}: render() returned {type(render).__name__}, not a Render")
    rgb, alpha = np.asarray(render.rgb), np.asarray(render.alpha)
    size = (camera.height, camera.width)
    if rgb.shape != (*size, 3) or alpha.shape != size:
        raise Failure(
            Status.WRONG_SIZE, f"{where}: rgb is {rgb.shape} and alpha {alpha.shape}; the view is {size} pixels"
        )
    if not (np.isfinite(rgb).all() and np.isfinite(alpha).all()):
        raise Failure(Status.NOT_FINITE, f"{where}: the render has NaN or infinite pixels")
    for name, values in (("rgb", rgb), ("alpha", alpha)):
        # A little over is clipped; integers, or 0 to 255, are a mistake that clipping would hide as a white image.
        if values.dtype.kind != "f" or values.min() < -_OVERSHOOT or values.max() > 1 + _OVERSHOOT:
            values_range = f"{values.dtype} from {values.min():g} to {values.max():g}"
            raise Failure(Status.OUT_OF_RANGE, f"{where}: {name} is {values_range}, not floats in [0, 1]")
    return Render(rgb, alpha)


def check_particles(particles: Particles, n_frames: int) -> None:
    """Raise Failure unless `particles` are finite and cover the `n_frames` timesteps."""
    if not isinstance(particles, Particles):
        raise Failure(Status.INCOMPLETE, f"particles() returned {type(particles).__name__}, not Particles")
    if particles.n_frames != n_frames:
        raise Failure(Status.INCOMPLETE, f"particles cover {particles.n_frames} of {n_frames} timesteps")
    for name in ("positions", "velocities"):
        values = getattr(particles, name)
        if values is not None and not np.isfinite(values).all():
            raise Failure(Status.NOT_FINITE, f"particles: {name} has NaN or infinite entries")


def check_geometry(geometry: SignedDistance, n_frames: int) -> None:
    """Raise Failure unless `geometry` covers the `n_frames` timesteps."""
    if not isinstance(geometry, SignedDistance):
        raise Failure(Status.INCOMPLETE, f"signed_distance() returned {type(geometry).__name__}, not a SignedDistance")
    if geometry.n_frames != n_frames:
        raise Failure(Status.INCOMPLETE, f"the signed distance covers {geometry.n_frames} of {n_frames} timesteps")

"""The views that a fitted model is asked for, and the digests of what it renders."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splashbench.harness.conformance.messages import Held, Kind, Seen
from splashbench.harness.contract import Fitted, Render
from splashbench.harness.messages import Failure
from splashbench.harness.output_checks import check_geometry, check_particles, checked_render
from splashbench.scene import Camera, Particles, SignedDistance, TrainingScene

#: Of the times between timesteps, at most so many, evenly chosen.
_MOST_BETWEEN = 16
#: How far outside the scene's interval a view is asked for, in steps: a test camera's clock may run that much ahead.
_OUTSIDE = 0.25
# Differences of 8-bit images that a resampled window may have.
_ROUNDING = 2 / 255


@dataclass(frozen=True)
class View:
    """A camera at a time (seconds), under a name for the user."""

    kind: Kind
    name: str
    camera: Camera
    time: float


def views_of(scene: TrainingScene) -> list[View]:
    """Every test view at every timestep; the first test camera between the timesteps and a little outside of them, at
    two other sizes, and through a window whose principal point is far from its middle."""
    views = [
        View("test", f"camera {name}, timestep {t}", camera, float(scene.camera_times[name][t]))
        for name, camera in scene.test_cameras.items()
        for t in range(scene.n_frames)
    ]
    camera, times = next(iter(scene.test_cameras.values())), scene.times
    if len(times) > 1:
        between = (times[1:] + times[:-1]) / 2
        chosen = np.unique(np.linspace(0, len(between) - 1, min(len(between), _MOST_BETWEEN)).round().astype(int))
        outside = (times[0] - _OUTSIDE * (times[1] - times[0]), times[-1] + _OUTSIDE * (times[-1] - times[-2]))
        views += [
            View("between", f"camera {camera.name} at {time:.6g} s", camera, float(time))
            for time in (outside[0], *between[chosen], outside[1])
        ]
    time = middle(scene)
    for other in (resized(camera, 0.61, 1.27), resized(camera, 1.5, 1.5)):
        views.append(View("size", f"camera {camera.name} at {other.width}x{other.height} pixels", other, time))
    views.append(View("window", f"a window of camera {camera.name}", window(camera)[2], time))
    return views


def middle(scene: TrainingScene) -> float:
    """The middle timestep, seconds."""
    return float(scene.times[scene.n_frames // 2])


def resized(camera: Camera, across: float, down: float) -> Camera:
    """`camera` with its image stretched by these factors; sizes are rounded, K scaled by the true ratios."""
    width, height = max(1, round(camera.width * across)), max(1, round(camera.height * down))
    ratios = np.diag([width / camera.width, height / camera.height, 1.0])
    return replace(camera, width=width, height=height, K=ratios @ camera.K)


def window(camera: Camera) -> tuple[int, int, Camera]:
    """The left and top pixel of a window off the middle of `camera`'s image, and its camera."""
    width, height = max(1, camera.width // 2), max(1, camera.height // 2)
    x0, y0 = (camera.width - width) // 3, (camera.height - height) // 4
    return x0, y0, camera.cropped(x0, y0, width, height)


def look(fitted: Fitted, views: Iterable[View]) -> dict[str, Seen]:
    """Render `views` in this order: name -> digest, or fault."""
    return {view.name: _seen(fitted, view) for view in views}


def _seen(fitted: Fitted, view: View) -> Seen:
    try:
        render = checked_render(fitted.render(view.camera, view.time), view.camera, view.name)
    except Failure as failure:
        return Seen(kind=view.kind, fault=str(failure))
    except Exception as error:
        return Seen(kind=view.kind, fault=f"{view.name}: render() raised {type(error).__name__}: {error}"[:300])
    return Seen(kind=view.kind, digest=digest(render.rgb, render.alpha))


def digest(*arrays: ArrayLike | None) -> str:
    """SHA-256 of types, shapes and bytes."""
    total = hashlib.sha256()
    for given in arrays:
        array = np.asarray(given if given is not None else [])
        total.update(f"{array.dtype} {array.shape} ".encode() + np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


def window_fault(fitted: Fitted, scene: TrainingScene) -> str:
    """What is wrong where a window of a view shows another part of the view than its own; "" where nothing is.

    The window's render is compared with its own part of the whole view, and with the part that it would show if the
    principal point were taken for the middle of the image.
    """
    camera = next(iter(scene.test_cameras.values()))
    x0, y0, part = window(camera)
    whole, shown = (_pixels(fitted.render(view, middle(scene))) for view in (camera, part))
    if whole.shape[:2] != (camera.height, camera.width) or shown.shape[:2] != (part.height, part.width):
        return ""  # told as a wrong size
    own = _difference(whole, shown, x0, y0)
    centred = [
        _difference(whole, shown, round(x - part.width / 2), round(y - part.height / 2))
        for x, y in ((camera.K[0, 2], camera.K[1, 2]), (camera.width / 2, camera.height / 2))
    ]
    if own <= max(_ROUNDING, min(centred)):
        return ""
    return (
        f"camera {camera.name} through the window of {part.width}x{part.height} pixels at ({x0}, {y0}) shows the part "
        "around the middle of the image"
    )


def _pixels(render: Render) -> NDArray[np.float64]:
    """[H, W, 4]."""
    return np.concatenate([np.asarray(render.rgb), np.asarray(render.alpha)[..., None]], axis=-1).astype(np.float64)


def _difference(whole: NDArray[np.float64], shown: NDArray[np.float64], x0: int, y0: int) -> float:
    """Mean difference of `shown` and the part of `whole` whose left top pixel is (x0, y0); infinite where none is."""
    height, width = shown.shape[:2]
    if min(x0, y0) < 0 or y0 + height > whole.shape[0] or x0 + width > whole.shape[1]:
        return float("inf")
    return float(np.abs(whole[y0 : y0 + height, x0 : x0 + width] - shown).mean())


def held_particles(fitted: Fitted, n_frames: int) -> Held:
    """The particles' digest, or fault."""

    def told(particles: Particles) -> Held:
        check_particles(particles, n_frames)
        return Held(
            digest=digest(particles.positions, particles.active, particles.velocities),
            about=f"{particles.positions.shape[1]} particles at {n_frames} timesteps",
        )

    return _held(fitted, "particles", told)


def held_geometry(fitted: Fitted, n_frames: int) -> Held:
    """The signed distance's digest, or fault."""

    def told(geometry: SignedDistance) -> Held:
        check_geometry(geometry, n_frames)
        return Held(
            digest=digest(geometry.phi, geometry.origin, geometry.voxel),
            about="grids of " + "x".join(map(str, geometry.phi.shape[1:])),
        )

    return _held(fitted, "signed_distance", told)


def _held(fitted: Fitted, name: str, told: Callable[[Any], Held]) -> Held:
    """What `told` says of what the method `name` returns, and as a fault whatever either raises."""
    try:
        given = getattr(fitted, name)()
        return Held(about="none") if given is None else told(given)
    except Failure as failure:
        return Held(fault=str(failure))
    except Exception as error:
        return Held(fault=f"{name}() raised {type(error).__name__}: {error}"[:300])

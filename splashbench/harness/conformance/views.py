"""The views that a fitted model is asked for, and digests of what it renders and returns."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict

from splashbench.harness.contract import Fitted, Render
from splashbench.harness.messages import Failure
from splashbench.harness.output_checks import check_geometry, check_particles, checked_render
from splashbench.scene import Camera, Particles, SignedDistance, TrainingScene

#: What a view is asked for: as in a run, between the timesteps, at another size, through a window of a view.
Kind = Literal["test", "between", "size", "window"]
#: Of the times between timesteps, at most so many, evenly chosen.
_MAX_BETWEEN = 16
#: How far outside the scene's interval a view is asked for, in steps: a test camera's clock may run that much ahead.
_OUTSIDE = 0.25
#: Difference of 8-bit images that a resampled window may have.
_ROUNDING = 2 / 255


class RenderedView(BaseModel):
    """One view as rendered: SHA-256 of its pixels, or what is wrong with it."""

    model_config = ConfigDict(extra="forbid")
    kind: Kind
    digest: str = ""
    fault: str = ""


class ReturnedArrays(BaseModel):
    """Particles or signed distance as returned: SHA-256 of the arrays, what they are, or what is wrong with them."""

    model_config = ConfigDict(extra="forbid")
    digest: str = ""
    about: str = ""
    fault: str = ""


@dataclass(frozen=True)
class ViewRequest:
    """A camera at a time (seconds), under a name for the user."""

    kind: Kind
    name: str
    camera: Camera
    time: float


def requests_of(scene: TrainingScene) -> list[ViewRequest]:
    """Every test view at every timestep, and the first test camera in unusual ways.

    These are times between the timesteps and a little outside of them, two other sizes, and a window whose principal
    point is far from its middle.
    """
    requests = [
        ViewRequest("test", f"camera {name}, timestep {t}", camera, float(scene.camera_times[name][t]))
        for name, camera in scene.test_cameras.items()
        for t in range(scene.n_frames)
    ]
    camera, times = next(iter(scene.test_cameras.values())), scene.times
    if len(times) > 1:
        between = (times[1:] + times[:-1]) / 2
        chosen = np.unique(np.linspace(0, len(between) - 1, min(len(between), _MAX_BETWEEN)).round().astype(int))
        outside = (times[0] - _OUTSIDE * (times[1] - times[0]), times[-1] + _OUTSIDE * (times[-1] - times[-2]))
        requests += [
            ViewRequest("between", f"camera {camera.name} at {time:.6g} s", camera, float(time))
            for time in (outside[0], *between[chosen], outside[1])
        ]
    time = middle(scene)
    for other in (resized(camera, 0.61, 1.27), resized(camera, 1.5, 1.5)):
        requests.append(
            ViewRequest("size", f"camera {camera.name} at {other.width}x{other.height} pixels", other, time)
        )
    requests.append(ViewRequest("window", f"a window of camera {camera.name}", window(camera)[2], time))
    return requests


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


def rendered_views(fitted: Fitted, requests: Iterable[ViewRequest]) -> dict[str, RenderedView]:
    """Render `requests` in this order: name -> digest, or fault."""
    return {request.name: _rendered(fitted, request) for request in requests}


def _rendered(fitted: Fitted, request: ViewRequest) -> RenderedView:
    kind, name, camera = request.kind, request.name, request.camera
    try:
        render = checked_render(fitted.render(camera, request.time), camera, name)
    except Failure as failure:
        return RenderedView(kind=kind, fault=str(failure))
    except Exception as error:
        return RenderedView(kind=kind, fault=f"{name}: render() raised {type(error).__name__}: {error}"[:300])
    return RenderedView(kind=kind, digest=digest(render.rgb, render.alpha))


def digest(*arrays: ArrayLike | None) -> str:
    """SHA-256 of types, shapes and bytes."""
    total = hashlib.sha256()
    for values in arrays:
        array = np.asarray(values if values is not None else [])
        total.update(f"{array.dtype} {array.shape} ".encode() + np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


def window_fault(fitted: Fitted, scene: TrainingScene) -> str:
    """What is wrong where a window of a view shows another part of the view than its own; "" where nothing is.

    The window's render is compared with its own part of the whole view, and with the part that it would show if the
    principal point were taken for the middle of the image.
    """
    camera = next(iter(scene.test_cameras.values()))
    x0, y0, part = window(camera)
    full, cropped = (_pixels(fitted.render(view, middle(scene))) for view in (camera, part))
    if full.shape[:2] != (camera.height, camera.width) or cropped.shape[:2] != (part.height, part.width):
        return ""  # reported as a wrong size
    difference = _difference(full, cropped, x0, y0)
    centred = [
        _difference(full, cropped, round(x - part.width / 2), round(y - part.height / 2))
        for x, y in ((camera.K[0, 2], camera.K[1, 2]), (camera.width / 2, camera.height / 2))
    ]
    if difference <= max(_ROUNDING, min(centred)):
        return ""
    return (
        f"camera {camera.name} through the window of {part.width}x{part.height} pixels at ({x0}, {y0}) shows the part "
        "around the middle of the image"
    )


def _pixels(render: Render) -> NDArray[np.float64]:
    """[H, W, 4]."""
    return np.concatenate([np.asarray(render.rgb), np.asarray(render.alpha)[..., None]], axis=-1).astype(np.float64)


def _difference(full: NDArray[np.float64], cropped: NDArray[np.float64], x0: int, y0: int) -> float:
    """Mean difference of `cropped` and the part of `full` whose left top pixel is (x0, y0); infinite where none is."""
    height, width = cropped.shape[:2]
    if min(x0, y0) < 0 or y0 + height > full.shape[0] or x0 + width > full.shape[1]:
        return float("inf")
    return float(np.abs(full[y0 : y0 + height, x0 : x0 + width] - cropped).mean())


def returned_particles(fitted: Fitted, n_frames: int) -> ReturnedArrays:
    """The particles' digest, or fault."""

    def described(particles: Particles) -> ReturnedArrays:
        check_particles(particles, n_frames)
        return ReturnedArrays(
            digest=digest(particles.positions, particles.active, particles.velocities),
            about=f"{particles.positions.shape[1]} particles at {n_frames} timesteps",
        )

    return _returned(fitted, "particles", described)


def returned_geometry(fitted: Fitted, n_frames: int) -> ReturnedArrays:
    """The signed distance's digest, or fault."""

    def described(geometry: SignedDistance) -> ReturnedArrays:
        check_geometry(geometry, n_frames)
        return ReturnedArrays(
            digest=digest(geometry.phi, geometry.origin, geometry.voxel),
            about="grids of " + "x".join(map(str, geometry.phi.shape[1:])),
        )

    return _returned(fitted, "signed_distance", described)


def _returned(fitted: Fitted, name: str, described: Callable[[Any], ReturnedArrays]) -> ReturnedArrays:
    """`described` of what the function `name` returns; whatever either raises is a fault."""
    try:
        arrays = getattr(fitted, name)()
        return ReturnedArrays(about="none") if arrays is None else described(arrays)
    except Failure as failure:
        return ReturnedArrays(fault=str(failure))
    except Exception as error:
        return ReturnedArrays(fault=f"{name}() raised {type(error).__name__}: {error}"[:300])

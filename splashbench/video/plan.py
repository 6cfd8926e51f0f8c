"""From settings to a film. Whatever contradicts itself, or is not there, is found before a frame is rendered."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.replay import Reconstruction
from splashbench.replay.paths import MAX_SIDE, read_camera_path
from splashbench.scene import Camera
from splashbench.scene.scene import NOMINAL_STEP_SECONDS
from splashbench.video import timing
from splashbench.video.film import Film
from splashbench.video.layers import Layer, Shot, make_layer
from splashbench.video.panels import Panel, Photographs, Rendered
from splashbench.video.scales import Scale
from splashbench.video.settings import Comparison, VideoSettings
from splashbench.video.timing import DEFAULT_FPS, Timing
from splashbench.video.views import orbit_of, resized

# Frames by which a layer's scale is chosen.
_SAMPLES = 9


def make_film(
    reconstruction: Reconstruction,
    settings: VideoSettings,
    compared: Comparison | None = None,
    rate: Callable[[float], float] = lambda fps: fps,
) -> Film:
    """The film that `settings` ask for, with what it is `compared` with.

    rate: makes frames a second that nobody has said (30, a path's own, the timesteps' own) into those that the video's
    file can have, see `splashbench.video.output.rate_for`.

    Example: `write_video(make_film(splashbench.load("submissions/bowl"), VideoSettings(slow=8)), Path("bowl.mp4"))`.

    Raises SplashbenchError where they contradict each other, or where something that they need is not there.
    """
    compared = compared or Comparison()
    sources = [reconstruction, *compared.reconstructions]
    _require_one_scene(sources)
    if compared.layout == "wipe" and len(compared.others) != 1:
        raise SplashbenchError("a wipe shows two; give it truth or one other submission")
    view = _view(reconstruction, settings)
    when, cameras = _frames(sources, settings, view, rate)
    largest = max(cameras[0].width, cameras[0].height)
    if largest > MAX_SIDE:
        raise SplashbenchError(f"pictures of {largest} pixels a side are more than {MAX_SIDE}; give a smaller --resize")
    layer = make_layer(settings.layer, settings.flat)
    photographs = None
    if compared.has_truth or layer.needs_photograph:
        photographs = _photographs(reconstruction, view)
    scale = _scale(layer, settings, sources, when, cameras)
    against = photographs if layer.needs_photograph else None
    rendered = [
        Rendered(name if layer.name == "color" else f"{name}, {layer.name}", source, layer, scale, against)
        for name, source in zip(_names(sources), sources)
    ]
    others = iter(rendered[1:])
    panels: list[Panel] = [rendered[0]]
    for other in compared.others:
        if isinstance(other, Reconstruction):
            panels.append(next(others))
        elif photographs is not None:
            panels.append(photographs)
    return Film(
        when,
        cameras,
        panels,
        wipe=compared.layout == "wipe",
        divider=compared.divider,
        captioned=settings.caption,
        nominal_step=NOMINAL_STEP_SECONDS if reconstruction.times_source == "nominal" else None,
        submissions=[source.submission.directory for source in sources],
        scene=None if reconstruction.scene is None else reconstruction.scene.directory,
    )


def _require_one_scene(sources: Sequence[Reconstruction]) -> None:
    mine, *others = sources
    for other in others:
        if other.submission.identity.scene_digest != mine.submission.identity.scene_digest:
            raise SplashbenchError(
                f"{other.submission.directory} is of scene {other.submission.identity.scene}, or of another version of "
                f"it, and {mine.submission.directory} of {mine.submission.identity.scene}; compare two of one scene"
            )


def _view(reconstruction: Reconstruction, settings: VideoSettings) -> str | None:
    """The scene camera that the film looks from, or None for an orbit or a path."""
    if (settings.view is not None) + settings.orbit + (settings.path is not None) > 1:
        raise SplashbenchError("a view, an orbit and a camera path exclude each other; give one of them")
    if settings.orbit or settings.path is not None:
        return None
    view = settings.view or (reconstruction.test or reconstruction.train)[0]
    return reconstruction.camera(view).name


def _frames(
    sources: Sequence[Reconstruction], settings: VideoSettings, view: str | None, rate: Callable[[float], float]
) -> tuple[Timing, list[Camera]]:
    """When the frames are, and their cameras: one for each, or one for all."""
    reconstruction = sources[0]
    # A view's own clock, so that its photographs are of the very instants of frames.
    times = reconstruction.times if view is None else reconstruction.camera_times[view]
    if settings.fps is not None:
        timing.require_rate(settings.fps)
    if settings.path is not None:
        return _path_frames(settings, times, rate)
    when = _timing(sources, settings, times, rate)
    if view is not None:
        return when, [resized(reconstruction.cameras[view], settings.resize)]
    path = orbit_of(reconstruction, len(when), settings.orbit_degrees, settings.orbit_height, when.fps)
    return when, [resized(camera, settings.resize) for camera in path.cameras]


def _timing(
    sources: Sequence[Reconstruction],
    settings: VideoSettings,
    times: NDArray[np.float64],
    rate: Callable[[float], float],
) -> Timing:
    """The instants of a view's or an orbit's frames, the recording's timesteps being at `times`."""
    start, end = timing.chosen_span(times, settings.start, settings.end)
    if settings.slow is not None and settings.seconds is not None:
        raise SplashbenchError("--slow and --seconds both say how long the video is; give one of them")
    fps = settings.fps or rate(DEFAULT_FPS)
    # Where there is no model, there are the timesteps alone.
    if settings.timesteps or not all(source.has_model for source in sources):
        if settings.seconds is not None:
            raise SplashbenchError("a video of the timesteps alone is as long as they are; leave --seconds out")
        steps = timing.stepwise(times, start, end, settings.fps, settings.slow or 1.0)
        return steps if settings.fps is not None else Timing(steps.times, rate(steps.fps))
    if start == end and not (settings.orbit and settings.seconds is not None):
        raise SplashbenchError(
            f"a video of {start:g} s alone is an orbit that lasts a while; give --orbit and --seconds, or a later --end"
        )
    if settings.seconds is not None:
        return timing.spread(start, end, round(min(settings.seconds * fps, 1e9)), fps)
    return timing.slowed(start, end, fps, settings.slow or 1.0)


def _path_frames(
    settings: VideoSettings, times: NDArray[np.float64], rate: Callable[[float], float]
) -> tuple[Timing, list[Camera]]:
    """A path's cameras, at its own times or spread evenly over the chosen part of the recording."""
    assert settings.path is not None
    path = read_camera_path(settings.path, (float(times[0]), float(times[-1])))
    given = {"--slow": settings.slow, "--seconds": settings.seconds, "--timesteps": settings.timesteps or None}
    if path.times is not None:
        given |= {"--start": settings.start, "--end": settings.end}
    refused = [option for option, value in given.items() if value is not None]
    if refused:
        known = "frames" if path.times is None else "frames and their times"
        raise SplashbenchError(f"{settings.path} says what {known} there are; leave {', '.join(refused)} out")
    fps = settings.fps or rate(path.fps)
    if path.times is None:
        when = timing.spread(*timing.chosen_span(times, settings.start, settings.end), len(path), fps)
    else:
        timing.require_within(path.times, times, settings.path)
        when = Timing(path.times, fps)
    return when, [resized(camera, settings.resize) for camera in path.cameras]


def _photographs(reconstruction: Reconstruction, view: str | None) -> Photographs:
    if view is None:
        raise SplashbenchError("there are photographs of the scene's cameras alone; give --view, not an orbit or path")
    if reconstruction.scene is None:
        raise SplashbenchError("the photographs to compare with are in the scene; give --scene")
    return Photographs(reconstruction.scene, view)


def _scale(
    layer: Layer, settings: VideoSettings, sources: Sequence[Reconstruction], when: Timing, cameras: Sequence[Camera]
) -> Scale | None:
    """One scale of colours for all frames and all submissions."""
    if settings.scale is None and layer.needs_sample:
        chosen = np.unique(np.linspace(0, len(when) - 1, _SAMPLES).astype(int)).tolist()
        shots = (
            Shot(source, cameras[k if len(cameras) > 1 else 0], float(when.times[k]))
            for source, k in product(sources, chosen)
        )
        return layer.scale(sources[0], layer.extent(shots))
    return layer.scale(sources[0], settings.scale)


def _names(sources: Sequence[Reconstruction]) -> list[str]:
    """What tells the submissions apart: the method, else its preset and seed too, else the folder, else a number."""
    identities = [source.submission.identity for source in sources]
    folders = [source.submission.directory.resolve().name for source in sources]
    choices = (
        [identity.method for identity in identities],
        [f"{identity.method} {identity.preset}" for identity in identities],
        [f"{identity.method} {identity.preset} {identity.seed}" for identity in identities],
        folders,
    )
    numbered = [f"{name} ({number})" for number, name in enumerate(folders, 1)]
    return next((names for names in choices if len(set(names)) == len(names)), numbered)

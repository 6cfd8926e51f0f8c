"""When the liquid moves: the part of a recording to be sampled (paper Sec. 3, "interval of effective liquid motion").

Images decide, not sound: the clap that helps synchronisation comes before the pour. Frames are compared in luma, shrunk
by area. Motion begins where the picture departs from its static beginning. It ends where successive frames stop
differing, since liquid at rest in a container does not look like the beginning. Both count pixels beyond the noise of
the static beginning, after changes of the overall brightness are taken out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from splashbench.errors import SplashbenchError
from splashbench.prepare.audio.sync import ClockFit
from splashbench.prepare.video.recording import Recording

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

WIDTH = 320  # analysed pixels across: a stream 10 px wide at 4K still covers most of a pixel
STATIC_SECONDS = 0.5  # the beginning that is taken as static
_LAG_S = 0.1  # successive means this far apart: slow surfaces still change within it
_NOISE_FACTOR, _LEAST_STEP = 5.0, 5.0  # of the noise's standard deviation; grey levels of 255
_LEAST_PIXELS = 6  # beyond this many active pixels something moves
_RESTLESS_FACTOR, _RESTLESS_PIXELS = 4.0, 30
_SUSTAINED_S = 0.1  # shorter flashes are no motion
_QUIET_S = 1.5  # pauses up to this long belong to the motion
_LONG_RECORDING_S = 45.0  # beyond this, key frames are searched first
_KEYFRAME_GAP_S = 1.1


@dataclass(frozen=True)
class MotionInterval:
    """Seconds on the reference clock, and why: `reasons` are lines for a report, `per_camera` what each one saw."""

    start: float
    end: float
    reasons: tuple[str, ...]
    per_camera: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def interval(self) -> tuple[float, float]:
        """(start, end)."""
        return (self.start, self.end)


def find_motion(
    recordings: Mapping[str, Recording],
    clocks: Mapping[str, ClockFit],
    cameras: Iterable[str] | None = None,
    override: tuple[float, float] | None = None,
) -> MotionInterval:
    """Find the motion interval from some cameras' images (all by default; training cameras suffice).

    The start is when the second camera sees motion begin and the end when the second-last sees it cease, so
    that one bumped camera decides nothing. `override` is taken as it is. Raises SplashbenchError when no
    camera, or only one of several, sees motion.
    """
    if override is not None:
        return MotionInterval(*override, ("given, by --interval or as motion_interval in session.toml",))
    chosen = list(recordings if cameras is None else cameras)
    seen: dict[str, tuple[float, float]] = {}
    reasons = []
    for camera in chosen:
        local, notes = camera_motion(recordings[camera])
        reasons += [f"camera {camera}: {note}" for note in notes]
        if local is not None:
            start, end = (float(t) for t in clocks[camera].to_reference(local))
            seen[camera] = (start, end)
            reasons.append(f"camera {camera}: motion from {start:.3f} to {end:.3f} s")
    if len(seen) < min(2, len(chosen)):
        files = recordings[chosen[0]].paths[0] if chosen else "the session"
        raise SplashbenchError(
            f"{files}: {len(seen)} of {len(chosen)} cameras see motion; set motion_interval in session.toml"
        )
    rank = min(1, len(seen) - 1)
    start = sorted(span[0] for span in seen.values())[rank]
    end = sorted((span[1] for span in seen.values()), reverse=True)[rank]
    if end <= start:
        raise SplashbenchError(
            f"{recordings[chosen[0]].paths[0]}: cameras do not see motion at the same time; "
            "set motion_interval in session.toml"
        )
    order = "the second" if rank else "the only"
    reasons.append(f"begins with {order} camera to see motion, ends with {order} to last see it")
    return MotionInterval(start, end, tuple(reasons), seen)


def camera_motion(recording: Recording) -> tuple[tuple[float, float] | None, list[str]]:
    """One camera's motion in local seconds, None where nothing moves, and remarks worth reporting."""
    times = recording.frame_times
    static = [image for _, image in recording.luma(WIDTH, 0, int(np.searchsorted(times, STATIC_SECONDS)))]
    if not static:
        raise SplashbenchError(
            f"{recording.paths[0]}: no frame of the first {STATIC_SECONDS:g} s can be decoded (was it cut without "
            "encoding anew?); export it again, or set motion_interval in session.toml"
        )
    background = _StaticBeginning(static)
    first, last = 0, len(times) - 1
    notes = []
    if times[-1] > _LONG_RECORDING_S:
        first, last = _narrow(recording, background, times)
        if last < first:
            return None, ["nothing moves between key frames"]
        notes.append(f"searched from {times[first]:.1f} to {times[last]:.1f} s, where key frames differ")
    indices, departed, changed = _activity(recording.luma(WIDTH, first, last), background, times)
    t = times[indices]
    bursts = _bursts(t, changed > _LEAST_PIXELS)
    if not bursts:
        return None, [*notes, "nothing moves"]
    mass = [float(changed[(t >= a) & (t <= b)].sum()) for a, b in bursts]
    start, end = bursts[int(np.argmax(mass))]
    if len(bursts) > 1:
        notes.append(f"{len(bursts)} separate motions; took the largest, set motion_interval for another")
    begins = [a for a, b in _bursts(t, departed > _LEAST_PIXELS) if b >= start]
    # Departure from the static beginning shows a thin stream earlier than successive frames do, but is of use
    # only for the first motion: later the scene already differs.
    if start == bursts[0][0] and begins and start - _QUIET_S < begins[0]:
        start = min(start, begins[0])
    if background.restless or start <= times[0] + STATIC_SECONDS:
        notes.append("moves from the very beginning, so what is static is unknown; check the interval")
    if end >= times[-1] - 2 * _LAG_S:
        notes.append("still moves at the end of the recording")
    return (start, end), notes


class _StaticBeginning:
    """The static beginning: median image [h, w] and, per pixel, the step that noise does not make."""

    def __init__(self, images: list[Image]) -> None:
        stack = np.stack(images).astype(np.float32)
        stack -= np.median(stack, axis=(1, 2), keepdims=True) - np.median(stack)
        self.image = np.median(stack, axis=0)
        # The scatter of one pixel over a few frames is itself noisy: its neighbours' is averaged in, and the
        # frame's median is the least that is believed.
        scatter = np.sqrt(ndimage.uniform_filter(np.square(stack - self.image).mean(axis=0), 5))
        # Noise is much the same everywhere; where a patch scatters far more, something moves already.
        floor = max(float(np.median(scatter)), 1.0)
        self.restless = bool((scatter > _RESTLESS_FACTOR * floor).sum() > _RESTLESS_PIXELS)
        self.step = np.maximum(_NOISE_FACTOR * np.maximum(scatter, np.median(scatter)), _LEAST_STEP)

    def count(self, difference: NDArray[np.float32], scale: float = 1.0) -> int:
        """Pixels that differ by more than noise, standing together (each with at least two neighbours that do)."""
        # Lamps flicker and exposure drifts: the overall change is no motion.
        active = np.abs(difference - np.median(difference)) > self.step * scale
        if not active.any():
            return 0
        return int((active & (ndimage.convolve(active.astype(np.uint8), np.ones((3, 3), np.uint8)) >= 3)).sum())


def _activity(
    frames: Iterable[tuple[int, Image]], background: _StaticBeginning, times: Floats, lag_s: float = _LAG_S
) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Per frame: its index, pixels departed from the background, pixels changed against the frame `lag_s` earlier."""
    indices: list[int] = []
    departed: list[int] = []
    changed: list[int] = []
    recent: list[tuple[int, NDArray[np.float32]]] = []
    for index, image in frames:
        now = image.astype(np.float32)
        while len(recent) > 1 and times[recent[1][0]] <= times[index] - lag_s:
            recent.pop(0)
        earlier = recent[0][1] if recent else now
        indices.append(index)
        departed.append(background.count(now - background.image))
        changed.append(background.count(now - earlier, 1.4))  # two noisy frames: sqrt(2)
        recent.append((index, now))
    return np.asarray(indices, np.int64), np.asarray(departed, np.float64), np.asarray(changed, np.float64)


def _bursts(times: Floats, active: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Spans of activity: flashes dropped, pauses bridged."""
    spans: list[tuple[float, float]] = []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], active, [False]]).astype(np.int8)))
    for begin, stop in zip(edges[::2], edges[1::2]):
        # A droplet flickers in and out: short pauses are bridged before lengths are judged.
        if spans and times[begin] - spans[-1][1] <= _SUSTAINED_S:
            spans[-1] = (spans[-1][0], float(times[stop - 1]))
        else:
            spans.append((float(times[begin]), float(times[stop - 1])))
    joined: list[tuple[float, float]] = []
    for begin, end in (span for span in spans if span[1] - span[0] >= _SUSTAINED_S):
        if joined and begin - joined[-1][1] <= _QUIET_S:
            joined[-1] = (joined[-1][0], end)
        else:
            joined.append((begin, end))
    return joined


def _narrow(recording: Recording, background: _StaticBeginning, times: Floats) -> tuple[int, int]:
    """(first, last) frame around the largest motion among key frames; everything where these are too rare."""
    indices, _, changed = _activity(recording.luma(WIDTH, keyframes=True), background, times, lag_s=1e-6)
    gaps = np.diff(times[indices])
    if not len(gaps) or gaps.max() > _KEYFRAME_GAP_S:
        return 0, len(times) - 1
    active = np.flatnonzero(changed > _LEAST_PIXELS)
    if not len(active):
        return 0, -1
    groups = np.split(active, np.flatnonzero(np.diff(times[indices[active]]) > _QUIET_S + _KEYFRAME_GAP_S) + 1)
    largest = max(groups, key=lambda group: float(changed[group].sum()))
    margin = _QUIET_S + _KEYFRAME_GAP_S
    first, last = np.searchsorted(times, [times[indices[largest[0]]] - margin, times[indices[largest[-1]]] + margin])
    return int(first), int(min(last, len(times) - 1))

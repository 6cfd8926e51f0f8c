"""The plan of a synthetic session, decided before anything is drawn: lenses, poses, clocks, sounds, times.

One seed decides it all. Common time is the local time of the reference camera; camera c's local clock reads
(t - start_s[c]) / clock_rate[c].
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from splashbench.errors import SplashbenchError
from splashbench.synth.imaging.geometry import ARC_ORDER, LOOK_AT, arc_point, look_at
from splashbench.synth.imaging.lens import LensCamera
from splashbench.synth.liquid.simulation import Pour
from splashbench.synth.recording.audio import Microphone, SoundSource, clap, pouring

Array = NDArray[np.float64]

CAMERAS = ("1", "2", "3", "4", "5", "6", "7")
TRAIN, TEST = CAMERAS[:5], CAMERAS[5:]
REFERENCE = "1"
CHAPTERED = "3"  # the camera whose recording is split in two files
BOARD: dict[str, Any] = {
    "squares_x": 8,
    "squares_y": 5,
    "square_metres": 0.055,
    "marker_metres": 0.041,
    "dictionary": "DICT_4X4_50",
    "legacy": False,
    "inverted": False,
}
GRAVITY = (0.0, -1.0, 0.0)

CLAP_AT = 1.25
POUR_AT = 1.8  # when the simulation starts; the stream comes into view shortly after
TAIL_SECONDS = 0.35
STATIC_SECONDS = 1.0
POSE_HOLD_FRAMES = 5
SWEEP_FRAMES, SWEEP_FPS = 66, 12

_FIELD_OF_VIEW_DEGREES = 38.0
_SWEEP_FIELD_OF_VIEW_DEGREES = 52.0
_WIDEST_CUT = 1.5  # width by height of the landscape image that narrower ones are cut out of
_CLOCK_SD = 20e-6
# The drifts of the two worst recorders in the paper, in seconds per second.
_BAD_CLOCKS = {"4": -49e-6, "7": -81e-6}
_CLAP_POSITION = np.array([0.32, 0.45, -0.25])
_POUR_POSITION = np.array([0.0, 0.04, 0.0])


@dataclass(frozen=True)
class RecordingOptions:
    """What the user chooses. `duration` is the liquid's motion in seconds, `particle_radius` metres."""

    size: tuple[int, int] = (480, 270)
    fps: int = 60
    seed: int = 0
    duration: float = 2.0
    particle_radius: float = 0.003

    def __post_init__(self) -> None:
        width, height = self.size
        if width % 2 or height % 2 or not (64 <= width <= 3840 and 36 <= height <= 2160):
            raise SplashbenchError(f"--size {width}x{height} will not do; both must be even, 64x36 to 3840x2160")
        if not 8 <= self.fps <= 240:
            raise SplashbenchError(f"--fps {self.fps} will not do; give 8 to 240")
        if not 0.4 <= self.duration <= 10:
            raise SplashbenchError(f"--duration {self.duration} will not do; give 0.4 to 10 seconds")
        if not 0.0018 <= self.particle_radius <= 0.006:
            raise SplashbenchError(f"--particle-radius {self.particle_radius} will not do; give 0.0018 to 0.006 metres")


@dataclass(frozen=True, eq=False)
class RigCamera:
    """One camera of the rig: its optics and place, its clock, and its microphone."""

    name: str
    camera: LensCamera
    start_s: float
    clock_rate: float
    fps: int
    n_frames: int
    microphone: Microphone

    def common_time(self, frame: int) -> float:
        """The common time at which frame `frame` of the pour recording was exposed."""
        return self.start_s + self.clock_rate * frame / self.fps


@dataclass(frozen=True, eq=False)
class RecordingPlan:
    """A session as it will be made."""

    options: RecordingOptions
    pour: Pour
    recorders: dict[str, RigCamera]
    sweep: list[LensCamera]
    sources: list[SoundSource] = field(repr=False)

    @property
    def end(self) -> float:
        """The common time at which the simulated motion ends."""
        return POUR_AT + self.pour.duration


def make_plan(options: RecordingOptions) -> RecordingPlan:
    """Decide everything, from the seed."""
    rng = np.random.default_rng([options.seed, 0])
    pour = Pour(
        duration=options.duration,
        emit_until=0.65 * options.duration,
        particle_radius=options.particle_radius,
        azimuth_degrees=float(rng.uniform(-35, 35)),
    )
    end = POUR_AT + options.duration
    recorders = {}
    starts = rng.permutation(np.linspace(-1.0, 1.0, len(CAMERAS))) + rng.uniform(-0.1, 0.1, len(CAMERAS))
    for k, name in enumerate(CAMERAS):
        start = 0.0 if name == REFERENCE else float(np.clip(starts[k], -1.0, 1.0))
        drift = 0.0 if name == REFERENCE else _BAD_CLOCKS.get(name, float(rng.normal(0, _CLOCK_SD)))
        camera = _rig_camera(rng, options.size, ARC_ORDER[k])
        seconds = (end + TAIL_SECONDS + rng.uniform(0, 0.3) - start) / (1 + drift)
        microphone = Microphone(
            camera.center, start, 1 + drift, gain=float(rng.uniform(0.5, 1.5)), seed=(options.seed, 20 + k)
        )
        n_frames = int(np.ceil(seconds * options.fps))
        recorders[name] = RigCamera(name, camera, start, 1 + drift, options.fps, n_frames, microphone)
    sounds = np.random.default_rng([options.seed, 4])
    sources = [
        clap(sounds, CLAP_AT, _CLAP_POSITION),
        pouring(sounds, POUR_AT + 0.1, end + 0.1, _POUR_POSITION),
    ]
    return RecordingPlan(options, pour, recorders, _sweep(rng, options.size), sources)


def _lens(rng: np.random.Generator, size: tuple[int, int], degrees: float) -> tuple[Array, Array]:
    """K [3, 3] and a mild barrel distortion [5], as narrow-view action cameras have it."""
    width, height = size
    # An upright image is a cut-out of a landscape one of its height: it shows no more above and below.
    fx = max(width, _WIDEST_CUT * height) / 2 / np.tan(np.radians(degrees + rng.uniform(-1, 1)) / 2)
    fy = fx * (1 + rng.uniform(-1e-3, 1e-3))
    cx, cy = np.array([width, height]) * (0.5 + rng.uniform(-0.01, 0.01, 2))
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    k1, k2 = rng.uniform(-0.14, -0.08), rng.uniform(0.02, 0.05)
    p1, p2 = rng.uniform(-6e-4, 6e-4, 2)
    return K, np.array([k1, k2, p1, p2, 0.0])


def _rig_camera(rng: np.random.Generator, size: tuple[int, int], place: int) -> LensCamera:
    K, distortion = _lens(rng, size, _FIELD_OF_VIEW_DEGREES)
    eye = arc_point(place / 6) + rng.uniform(-0.015, 0.015, 3)
    target = LOOK_AT + rng.uniform(-0.01, 0.01, 3)
    return LensCamera(*size, K, distortion, look_at(eye, target, float(rng.uniform(-1.5, 1.5))))


def _sweep(rng: np.random.Generator, size: tuple[int, int]) -> list[LensCamera]:
    """A hand-held camera carried along the arc and past its ends, in a wave, with a slight shake."""
    K, distortion = _lens(rng, size, _SWEEP_FIELD_OF_VIEW_DEGREES)
    at = np.linspace(0.0, 1.0, SWEEP_FRAMES)
    knots = np.linspace(0.0, 1.0, 14)
    sway = CubicSpline(knots, rng.normal(0, 1, (len(knots), 7)))(at)
    cameras = []
    for s, (dx, dy, dz, tx, ty, tz, roll) in zip(at, sway):
        eye = arc_point(
            -0.08 + 1.16 * s,
            radius=0.90 + 0.10 * np.cos(2 * np.pi * 1.5 * s),
            elevation_degrees=25.0 + 9.0 * np.sin(2 * np.pi * 1.5 * s),
        )
        eye += 0.008 * np.array([dx, dy, dz])
        target = LOOK_AT + np.array([0.0, -0.04, -0.05]) + 0.02 * np.array([tx, ty, tz])
        cameras.append(LensCamera(*size, K, distortion, look_at(eye, target, 1.5 * roll)))
    return cameras

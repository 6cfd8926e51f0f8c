"""What the microphones record: a clap, the pour and each camera's background noise, with exact delays.

The clap and the pour are made once on the common clock at 48 kHz, band-limited. A camera's track is that signal, read
at the instants that its clock samples, less the time that the sound has travelled. Windowed-sinc interpolation makes a
delay of any fraction of a sample exact. Colouring and reflections differ between cameras, but leave the direct sound's
delay alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SAMPLE_RATE = 48000
SPEED_OF_SOUND = 343.0  # m/s at 20 degrees Celsius
# Band of the synthetic sounds: AAC keeps it at our bit rate, and the interpolation kernel is exact in it.
_BAND_HZ = (120.0, 14000.0)
_KERNEL_HALF_WIDTH = 24
_KERNEL_BETA = 9.0


@dataclass(frozen=True, eq=False)
class SoundSource:
    """A sound: `samples` [n] at 48 kHz from the common time `start_s`, coming from `position` [3], metres, world."""

    samples: Array
    start_s: float
    position: Array


@dataclass(frozen=True, eq=False)
class Microphone:
    """A camera's ear: its place [3], the clock of its recording, its gain, and the seed of its colouring and noise."""

    position: Array
    start_s: float
    clock_rate: float
    gain: float = 1.0
    noise_level: float = 0.004
    seed: tuple[int, ...] = field(default=(0,))


def clap(rng: np.random.Generator, at_s: float, position: Array) -> SoundSource:
    """A hand clap at common time `at_s`: a sharp band-limited burst that dies out within 50 ms."""
    length = int(0.12 * SAMPLE_RATE)
    lead = int(0.01 * SAMPLE_RATE)
    t = (np.arange(length) - lead) / SAMPLE_RATE
    decay = np.where(t < 0, 0.0, 0.75 * np.exp(-t / 0.0035) + 0.25 * np.exp(-t / 0.012))
    burst = band_limit(rng.standard_normal(length) * decay, 500.0, 12000.0)
    return SoundSource(burst / np.abs(burst).max(), at_s - lead / SAMPLE_RATE, position)


def pouring(rng: np.random.Generator, start_s: float, end_s: float, position: Array) -> SoundSource:
    """The noise of a stream hitting a pool between two common times: hiss with a fluttering loudness, and bubbles."""
    length = int((end_s - start_s) * SAMPLE_RATE)
    t = np.arange(length) / SAMPLE_RATE
    beats = np.arange(0.0, t[-1] + 0.05, 0.02)
    flutter = np.interp(t, beats, 0.4 + rng.random(len(beats)))
    hiss = band_limit(rng.standard_normal(length), 700.0, 9000.0)
    sound = hiss / hiss.std() * flutter
    for _ in range(int(45 * t[-1])):
        # A bubble rings at a rising pitch (Minnaert 1933: 3 kHz per millimetre of radius, inversely).
        begin, pitch = rng.uniform(0, t[-1]), rng.uniform(600, 2600)
        late = np.maximum(t - begin, 0)
        ringing = np.exp(-late / 0.012) * np.sin(2 * np.pi * pitch * late * (1 + 2 * late))
        sound += rng.uniform(0.3, 1.2) * ringing
    ramp = np.clip(np.minimum(t / 0.15, (t[-1] - t) / 0.3), 0, 1)
    sound = band_limit(sound * ramp, *_BAND_HZ)
    return SoundSource(0.12 * sound / sound.std(), start_s, position)


def record(microphone: Microphone, sources: list[SoundSource], seconds: float) -> NDArray[np.float32]:
    """The microphone's track [n] in [-1, 1] over the first `seconds` of its recording's local clock."""
    n = round(seconds * SAMPLE_RATE)
    common = microphone.start_s + microphone.clock_rate * np.arange(n) / SAMPLE_RATE
    rng = np.random.default_rng(list(microphone.seed))
    track = np.zeros(n)
    for source in sources:
        for position, strength in _with_reflections(source.position):
            distance = float(np.linalg.norm(position - microphone.position))
            emitted = common - distance / SPEED_OF_SOUND - source.start_s
            track += strength / max(distance, 0.2) * interpolate(source.samples, emitted * SAMPLE_RATE)
    track = colour(track, rng)
    track *= 0.35 * microphone.gain / max(1e-9, np.abs(track).max(initial=0.0))
    hum = band_limit(rng.standard_normal(n), 60.0, 5000.0)
    return (track + microphone.noise_level * hum / hum.std()).astype(np.float32)


def room_noise(seconds: float, seed: tuple[int, ...], level: float = 0.004) -> NDArray[np.float32]:
    """A track [n] of nothing but the room."""
    noise = np.random.default_rng(list(seed)).standard_normal(round(seconds * SAMPLE_RATE))
    noise = band_limit(noise, 60.0, 5000.0)
    return (level * noise / noise.std()).astype(np.float32)


def _with_reflections(position: Array) -> list[tuple[Array, float]]:
    """The source and its mirror images in the table and the back wall, with their strengths."""
    return [
        (position, 1.0),
        (position * np.array([1.0, -1.0, 1.0]), 0.25),
        (np.array([position[0], position[1], -1.7 - position[2]]), 0.2),
    ]


def interpolate(samples: Array, at: Array) -> Array:
    """Band-limited values of `samples` [n] at fractional indices `at` [m], zero outside (Kaiser-windowed sinc)."""
    half = _KERNEL_HALF_WIDTH
    result = np.zeros(len(at))
    near = np.flatnonzero((at > -half) & (at < len(samples) + half))
    if not len(near):
        return result
    padded = np.pad(samples, 2 * half)
    base = np.floor(at[near]).astype(np.int64)
    fraction = at[near] - base
    for k in range(-half + 1, half + 1):
        offset = fraction - k
        window = np.i0(_KERNEL_BETA * np.sqrt(np.maximum(0.0, 1 - (offset / half) ** 2))) / np.i0(_KERNEL_BETA)
        result[near] += padded[base + k + 2 * half] * np.sinc(offset) * window
    return result


def colour(track: Array, rng: np.random.Generator) -> Array:
    """A microphone's own frequency response, up to 5 dB either way, with zero phase: it delays nothing."""
    frequency = np.fft.rfftfreq(len(track), 1 / SAMPLE_RATE)
    bands = np.geomspace(80, 20000, 9)
    decibels = np.interp(np.log(np.maximum(frequency, 1.0)), np.log(bands), rng.uniform(-5, 5, len(bands)))
    return np.fft.irfft(np.fft.rfft(track) * 10 ** (decibels / 20), len(track))


def band_limit(samples: Array, low_hz: float, high_hz: float) -> Array:
    """Keep `low_hz` to `high_hz`, with raised-cosine edges a fifth of an octave wide and zero phase."""
    frequency = np.maximum(np.fft.rfftfreq(len(samples), 1 / SAMPLE_RATE), 1e-3)
    rise = np.clip(np.log2(frequency / low_hz) / 0.2 + 0.5, 0, 1)
    fall = np.clip(np.log2(high_hz / frequency) / 0.2 + 0.5, 0, 1)
    gain = (0.5 - 0.5 * np.cos(np.pi * rise)) * (0.5 - 0.5 * np.cos(np.pi * fall))
    return np.fft.irfft(np.fft.rfft(samples) * gain, len(samples))

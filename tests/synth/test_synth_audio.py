"""Delays between recordings are what geometry and clocks say, also after AAC."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splashbench.synth.recording.audio import (
    SAMPLE_RATE,
    SPEED_OF_SOUND,
    Microphone,
    clap,
    interpolate,
    pouring,
    record,
)
from splashbench.synth.recording.video import write_recording


def decoded(path: Path) -> tuple[np.ndarray, float]:
    """The first channel [n], and the time in seconds at which its first sample is to be heard."""
    import av

    with av.open(str(path)) as container:
        frames = list(container.decode(audio=0))
    samples = np.concatenate([frame.to_ndarray()[0] for frame in frames])
    return samples, float(frames[0].pts * frames[0].time_base)


def lag_seconds(a: np.ndarray, b: np.ndarray, upsampling: int = 16) -> float:
    """How much later `a` is than `b`, by the peak of their cross-correlation."""
    n = len(a) + len(b)
    spectrum = np.fft.rfft(a, n) * np.conj(np.fft.rfft(b, n))
    correlation = np.fft.irfft(spectrum, n * upsampling)
    peak = int(np.argmax(correlation))
    if peak > n * upsampling // 2:
        peak -= n * upsampling
    return peak / upsampling / SAMPLE_RATE


def through_aac(track: np.ndarray, path: Path) -> np.ndarray:
    """The track as a player hears it: index 0 is local time 0."""
    frames = [np.full((36, 64, 3), 128, np.uint8)] * int(np.ceil(len(track) / SAMPLE_RATE * 10))
    write_recording(path, frames, 10, track)
    samples, start = decoded(path)
    assert start == 0
    return samples


@pytest.mark.parametrize("start_s", [-0.731234, 0.402117])
def test_an_offset_survives_aac_to_20_microseconds(tmp_path: Path, start_s: float) -> None:
    source = clap(np.random.default_rng(1), 1.3, np.array([0.3, 0.45, -0.25]))
    near = Microphone(np.array([0.5, 0.4, 0.6]), 0.0, 1.0, seed=(1,))
    far = Microphone(np.array([-0.9, 0.4, 0.9]), start_s, 1.0, seed=(2,))
    heard = [through_aac(record(m, [source], 2.5), tmp_path / f"{k}.mp4") for k, m in enumerate((near, far))]
    distances = [np.linalg.norm(source.position - m.position) for m in (near, far)]
    # A recorder that starts later reads an earlier local time for the same event.
    expected = (distances[1] - distances[0]) / SPEED_OF_SOUND - start_s
    assert lag_seconds(heard[1], heard[0]) == pytest.approx(expected, abs=20e-6)


@pytest.mark.parametrize("drift", [-400e-6, 250e-6])
def test_a_fast_or_slow_clock_stretches_the_track(drift: float) -> None:
    rng = np.random.default_rng(0)
    place = np.array([0.0, 0.5, 0.9])
    claps = [clap(rng, at, np.array([0.1, 0.2, 0.3])) for at in (1.0, 7.0)]
    true = record(Microphone(place, 0.0, 1.0, noise_level=1e-6), claps, 8.0)
    off = record(Microphone(place, 0.0, 1.0 + drift, noise_level=1e-6), claps, 8.0)
    middle = 4 * SAMPLE_RATE
    gained = lag_seconds(off[middle:], true[middle:], 64) - lag_seconds(off[:middle], true[:middle], 64)
    # t = rate * local: the later clap is read off 6 s of common time further on.
    assert gained == pytest.approx(6.0 / (1 + drift) - 6.0, abs=2e-6)


def test_aac_adds_no_delay_and_keeps_the_sound(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    sources = [clap(rng, 0.5, np.zeros(3)), pouring(rng, 0.9, 2.0, np.zeros(3))]
    track = record(Microphone(np.array([0.0, 0.5, 0.9]), 0.0, 1.0), sources, 2.5)
    heard = through_aac(track, tmp_path / "track.mp4")
    assert abs(lag_seconds(heard, track)) < 2e-6
    common = heard[: len(track)]
    assert np.sum((common - track) ** 2) < 0.01 * np.sum(track**2)


def test_interpolation_is_exact_within_the_band() -> None:
    index = np.arange(4000)
    frequency = 13_000 / SAMPLE_RATE
    at = np.linspace(500, 3500, 977)
    values = interpolate(np.sin(2 * np.pi * frequency * index), at)
    assert np.abs(values - np.sin(2 * np.pi * frequency * at)).max() < 2e-4


def test_nothing_is_heard_before_the_sound_arrives() -> None:
    source = clap(np.random.default_rng(1), 1.0, np.array([0.0, 3.43, 0.0]))
    track = record(Microphone(np.zeros(3), 0.0, 1.0, noise_level=1e-9), [source], 1.5)
    onset = np.argmax(np.abs(track) > 0.1 * np.abs(track).max()) / SAMPLE_RATE
    assert onset == pytest.approx(1.01, abs=5e-4)

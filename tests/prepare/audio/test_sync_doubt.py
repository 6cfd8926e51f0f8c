"""Clocks that look right and are not: refused or reported, never silently wrong."""

from __future__ import annotations

import os
from pathlib import Path

import av
import numpy as np
import pytest
from scipy import signal

from splashbench.errors import SplashbenchError
from splashbench.prepare.audio.sync import ClockFit, estimate_sync, require_synced
from splashbench.prepare.audio.waveform import join_audio
from splashbench.prepare.gates import sync_gates
from splashbench.synth.recording.audio import record as synthetic_record
from splashbench.synth.recording.plan import RecordingOptions, make_plan
from splashbench.synth.recording.video import write_recording

RATE = 48000
LEAD = 2.0  # seconds of the source before time 0


def noise(rng: np.random.Generator, seconds: float, low: float = 300, high: float = 6000) -> np.ndarray:
    """Noise of a pour, say, with a peak of 1."""
    sections = signal.butter(2, [low, high], "bandpass", fs=RATE, output="sos")
    samples = signal.sosfilt(sections, rng.standard_normal(round(seconds * RATE)))
    return samples / np.abs(samples).max()


def clap(rng: np.random.Generator) -> np.ndarray:
    return noise(rng, 0.03, 400, 9000) * np.exp(-np.arange(round(0.03 * RATE)) / (0.004 * RATE))


def emit(seconds: float, *sounds: tuple[float, np.ndarray]) -> np.ndarray:
    """(time, samples) of sounds, laid on silence that begins `LEAD` s before time 0."""
    emitted = np.zeros(round((seconds + 2 * LEAD) * RATE))
    for at, samples in sounds:
        begin = round((at + LEAD) * RATE)
        emitted[begin : begin + len(samples)] += samples[: len(emitted) - begin]
    return emitted


def record(
    emitted: np.ndarray, seconds: float, start: float, clock_rate: float = 1.0, hiss: float = 0.01, seed: int = 0
) -> np.ndarray:
    """A camera's track: windowed-sinc interpolation at its local times, and noise of its own of RMS `hiss`."""
    place = (start + clock_rate * np.arange(round(seconds * RATE)) / RATE + LEAD) * RATE
    whole = np.floor(place).astype(int)
    heard = hiss * np.random.default_rng(1000 + seed).standard_normal(len(place))
    for tap in range(-4, 6):
        distance = place - whole - tap
        taper = 0.5 + 0.5 * np.cos(np.pi * distance / 5)
        heard += emitted[np.clip(whole + tap, 0, len(emitted) - 1)] * np.sinc(distance) * taper
    return (0.3 * heard / np.abs(heard).max()).astype(np.float32)


def fit(reference: np.ndarray, track: np.ndarray) -> ClockFit:
    return estimate_sync({"1": (reference, 0.0), "2": (track, 0.0)}, RATE, "1")["2"]


def failed(clock: ClockFit) -> set[str]:
    """The gates that a session of this camera fails."""
    return {gate.name for gate in sync_gates({"2": clock}, None) if not gate.passed}


@pytest.mark.parametrize("heard", [0.0, 1.3, 2.1, -1.9])
def test_claps_at_equal_intervals_are_refused_with_advice(heard: float) -> None:
    """Every 800 ms another clap like the one before: the camera may have come in at any of them."""
    rng = np.random.default_rng(3)
    same = clap(rng)
    emitted = emit(14, *[(1 + 0.8 * k, rng.uniform(0.7, 1) * same) for k in range(8)])
    clock = fit(record(emitted, 7, 0.0), record(emitted, 7, heard, seed=1))
    assert clock.status == "ambiguous"
    assert np.isnan(clock.start_s)
    assert clock.confidence < 2
    with pytest.raises(SplashbenchError, match="more than one offset; clap several times at irregular intervals"):
        require_synced({"2": clock}, {})


def test_claps_at_irregular_intervals_need_nothing_else() -> None:
    """What the refusal advises."""
    rng = np.random.default_rng(5)
    same = clap(rng)
    emitted = emit(10, *[(at, same) for at in (0.9, 1.6, 2.9, 3.4, 5.0, 6.8, 7.5)])
    clock = fit(record(emitted, 9, 0.0), record(emitted, 9, 0.6, seed=1))
    assert clock.status == "ok"
    assert clock.start_s == pytest.approx(0.6, abs=0.1e-3)
    assert failed(clock) == set()


@pytest.mark.parametrize("seed", range(2))
def test_claps_at_equal_intervals_beside_a_pour_are_told_apart(seed: int) -> None:
    rng = np.random.default_rng(seed)
    same = clap(rng)
    emitted = emit(9, *[(0.6 + 0.8 * k, same) for k in range(8)], (2.0, 0.4 * noise(rng, 5)))
    clock = fit(record(emitted, 8, 0.0), record(emitted, 8, 0.4, seed=1))
    assert clock.status == "ok"
    assert clock.start_s == pytest.approx(0.4, abs=0.1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_a_single_clap_in_noise_gives_no_clock(seed: int) -> None:
    """Its windows share one sound: they know no drift, nor that both recordings are of one take."""
    rng = np.random.default_rng(seed)
    emitted = emit(10, (4.0 + 0.3 * seed, clap(rng)))
    clock = fit(record(emitted, 10, 0.0, seed=seed), record(emitted, 10, 0.5, seed=9 + seed))
    assert clock.status in ("unconfirmed", "unrelated")
    assert np.isnan(clock.start_s)


def test_takes_that_share_only_the_clapper_are_refused() -> None:
    rng = np.random.default_rng(11)
    same = clap(rng)
    takes = [emit(9, *[(first + 0.7 * k, same) for k in range(5)], (4.5, 0.1 * noise(rng, 3))) for first in (0.5, 1.4)]
    clock = fit(record(takes[0], 8, 0.0), record(takes[1], 8, 0.0, seed=1))
    assert clock.status != "ok" or failed(clock)


def test_pieces_of_one_recording_that_share_no_moment_are_refused() -> None:
    """The same voice in the same room: a piece of 3.78 s, and another that begins .67 s after it."""
    root = os.environ.get("SPLASHBENCH_TEST_DATA")
    path = Path(root, "real", "audio_bbc", "timbl_3.mp3") if root else None
    if path is None or not path.is_file():
        pytest.skip("SPLASHBENCH_TEST_DATA has no real/audio_bbc")
    whole = join_audio([path], [0.0], RATE).samples
    first, second = (whole[begin : begin + 181600] for begin in (829087, 615275))
    assert fit(first, second).status in ("unconfirmed", "unrelated")


@pytest.mark.parametrize("late", ["camera", "reference"])
def test_a_reflection_louder_than_the_direct_sound_is_reported(late: str) -> None:
    rng = np.random.default_rng(2)
    emitted = emit(9, (0.8, clap(rng)), (1.5, noise(rng, 6)))
    muffled = 0.4 * emitted + np.roll(emitted, round(0.012 * RATE))
    heard = {"camera": emitted, "reference": emitted} | {late: muffled}
    clock = fit(record(heard["reference"], 8, 0.0), record(heard["camera"], 8, 0.25, seed=1))
    assert clock.status == "ok"  # it followed the reflection
    shift = -0.012 if late == "camera" else 0.012
    assert clock.start_s == pytest.approx(0.25 + shift, abs=0.1e-3)
    assert clock.echo_s == pytest.approx(-shift, abs=0.1e-3)
    assert failed(clock) == {"direct_sound"}


@pytest.mark.parametrize("late", ["camera", "reference"])
def test_a_reflection_weaker_than_the_direct_sound_is_none_to_report(late: str) -> None:
    rng = np.random.default_rng(2)
    emitted = emit(9, (0.8, clap(rng)), (1.5, noise(rng, 6)))
    reflecting = emitted + 0.4 * np.roll(emitted, round(0.012 * RATE))
    heard = {"camera": emitted, "reference": emitted} | {late: reflecting}
    clock = fit(record(heard["reference"], 8, 0.0), record(heard["camera"], 8, 0.25, seed=1))
    assert clock.start_s == pytest.approx(0.25, abs=0.1e-3)
    assert clock.echo_s == 0
    assert failed(clock) == set()


def test_a_drift_lies_in_its_interval() -> None:
    """38 s, but the sound lasts for 14 of them: too short to know -81 us/s, and long enough to know that it drifts."""
    rng = np.random.default_rng(8)
    emitted = emit(40, (11.0, clap(rng)), (12.0, noise(rng, 13)))
    clock = fit(record(emitted, 38, 0.0), record(emitted, 38, 0.7, 1 - 81e-6, seed=1))
    assert clock.status == "ok"
    assert -81e-6 < clock.clock_rate - 1 < -40e-6
    assert abs(clock.clock_rate - (1 - 81e-6)) <= clock.drift_interval < 81e-6
    ends = np.array([0.0, 37.3])
    error = np.abs(clock.to_reference(ends) - (0.7 + (1 - 81e-6) * ends)).max()
    assert error <= clock.interval_s


@pytest.mark.parametrize("drift", [0.0, -81e-6])
def test_six_seconds_state_no_drift_and_how_large_it_may_be(drift: float) -> None:
    rng = np.random.default_rng(9)
    emitted = emit(7, (0.8, clap(rng)), (1.5, noise(rng, 4)))
    clock = fit(record(emitted, 6, 0.0), record(emitted, 6, 0.3, 1 + drift, seed=1))
    assert clock.clock_rate == 1.0
    assert 81e-6 < clock.drift_interval < 200e-6
    assert failed(clock) == set()


def test_a_clock_known_too_badly_fails_its_gate() -> None:
    """The pour is over after 5 of 28 s: the rate is open, and so is the clock at the other end."""
    rng = np.random.default_rng(10)
    emitted = emit(28, (0.8, clap(rng)), (1.5, noise(rng, 4)))
    clock = fit(record(emitted, 28, 0.0), record(emitted, 28, 0.3, seed=1))
    assert clock.interval_s > 2e-3
    assert "clock_interval" in failed(clock)


def test_samples_lost_on_the_way_fail_the_gate_of_the_residual() -> None:
    """One clock cannot follow the sound before and after; what lies off its line counts, too."""
    rng = np.random.default_rng(12)
    emitted = emit(13, (0.8, clap(rng)), (1.0, noise(rng, 11)))
    track = record(emitted, 12, 0.2, seed=1)
    lost, gap = round(9.5 * RATE), round(0.010 * RATE)
    clock = fit(record(emitted, 12, 0.0), np.delete(track, np.s_[lost : lost + gap]))
    assert clock.status == "ok"
    assert failed(clock) == {"clock_residual"}


def test_samples_lost_shortly_before_the_end_fail_the_gate_too() -> None:
    """A window or two are all that tells of them."""
    rng = np.random.default_rng(12)
    emitted = emit(13, (0.8, clap(rng)), (1.0, noise(rng, 11)))
    track = record(emitted, 12, 0.2, seed=1)
    lost, gap = round(11.0 * RATE), round(0.015 * RATE)
    clock = fit(record(emitted, 12, 0.0), np.delete(track, np.s_[lost : lost + gap]))
    assert clock.status == "ok"
    assert failed(clock) == {"clock_residual"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [11, 13])
def test_an_echo_that_a_window_catches_alone_fails_nothing(seed: int, tmp_path: Path) -> None:
    """By a table and a wall some windows end between a sound and its echo, and AAC leaves no noise that hides it."""
    plan = make_plan(RecordingOptions(fps=30, seed=seed, particle_radius=0.004))
    tracks = {}
    for name, recorder in plan.recorders.items():
        sound = synthetic_record(recorder.microphone, plan.sources, recorder.n_frames / recorder.fps)
        black = (np.zeros((36, 64, 3), np.uint8) for _ in range(recorder.n_frames))
        write_recording(path := tmp_path / f"{name}.mp4", black, recorder.fps, sound)
        tracks[name] = (join_audio([path], [0.0], 48000).samples, 0.0)
    clocks = estimate_sync(tracks, 48000, "1")
    assert {clock.status for clock in clocks.values()} == {"ok"}
    assert [gate.name for gate in sync_gates(clocks, None) if not gate.passed] == []


def test_samples_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "broken.mkv"
    samples = np.zeros((1, RATE), np.float32)
    samples[0, 300] = np.nan
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_f32le", rate=RATE, layout="mono")
        frame = av.AudioFrame.from_ndarray(samples, format="flt", layout="mono")
        frame.sample_rate, frame.pts = RATE, 0
        for packet in [*stream.encode(frame), *stream.encode(None)]:
            container.mux(packet)
    with pytest.raises(SplashbenchError, match=r"broken\.mkv has sound samples that are no numbers"):
        join_audio([path], [0.0], RATE)

"""Clocks from sound: known offsets and drifts are found, doubtful tracks are never given any."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from splashbench.errors import SplashbenchError
from splashbench.prepare.audio.sync import (
    PATH_SD_S,
    RATE_PRIOR_SD,
    ClockFit,
    _fit_line,
    estimate_sync,
    require_synced,
    sequence_sync_rms,
    shifted,
    sound_paths,
    track_status,
)
from splashbench.prepare.audio.waveform import join_audio

RATE = 48000
LEAD = 3.0  # seconds of source signal before time 0
METRES_PER_SECOND = 343.0
Audio = dict[str, tuple[np.ndarray, float]]


def sources(seed: int, seconds: float, clap: float = 1.0, pour: tuple[float, float] = (2.0, 5.0)) -> list[np.ndarray]:
    """A clap and the noise of pouring, as emitted: two signals on common time, which begins `LEAD` s before 0."""
    rng = np.random.default_rng(seed)
    n = round((seconds + 2 * LEAD) * RATE)
    numerator, denominator = signal.butter(2, [300, 6000], "bandpass", fs=RATE)
    burst = np.zeros(n)
    at, length = round((clap + LEAD) * RATE), round(0.03 * RATE)
    burst[at : at + length] = 3 * rng.standard_normal(length) * np.exp(-np.arange(length) / (0.004 * RATE))
    time = np.arange(n) / RATE - LEAD
    swell = np.interp(time, np.arange(-LEAD, seconds + LEAD + 1, 0.1), 0.5 + rng.random(int(10 * seconds + 70)))
    noise = rng.standard_normal(n) * swell * 0.3 * ((time > pour[0]) & (time < pour[1]))
    return [signal.lfilter(numerator, denominator, one) for one in (burst, noise)]


def hear(emitted: np.ndarray, local: np.ndarray, start: float, clock_rate: float, metres: float) -> np.ndarray:
    """What a microphone `metres` away records at its local times: windowed-sinc interpolation of the emitted signal."""
    place = (start + clock_rate * local - metres / METRES_PER_SECOND + LEAD) * RATE
    whole = np.floor(place).astype(int)
    heard = np.zeros(len(local))
    for tap in range(-4, 6):
        distance = place - whole - tap
        taper = 0.5 + 0.5 * np.cos(np.pi * distance / 5)
        heard += emitted[np.clip(whole + tap, 0, len(emitted) - 1)] * np.sinc(distance) * taper
    return heard


def record(
    emitted: list[np.ndarray],
    seconds: float,
    start: float,
    clock_rate: float = 1.0,
    metres: tuple[float, float] = (1.0, 1.0),
    decibels: float = 10.0,
    seed: int = 0,
) -> np.ndarray:
    """A camera's track at a signal-to-noise ratio of `decibels` against the sound's own power where there is any."""
    local = np.arange(round(seconds * RATE)) / RATE
    clean = sum(hear(one, local, start, clock_rate, far) for one, far in zip(emitted, metres))
    power = np.mean(np.square(clean[np.abs(clean) > 1e-4]))
    noise = np.random.default_rng(1000 + seed).standard_normal(len(clean)) * np.sqrt(power) * 10 ** (-decibels / 20)
    track = clean + noise
    return (0.3 * track / np.abs(track).max()).astype(np.float32)


def worst_error(fit: ClockFit, start: float, clock_rate: float, seconds: float) -> float:
    """Largest error in seconds of a fitted clock anywhere in a recording."""
    local = np.array([0.0, seconds])
    return float(np.abs(fit.to_reference(local) - (start + clock_rate * local)).max())


@pytest.mark.parametrize("seed", range(3))
def test_six_seconds_with_a_clap_and_pouring_are_known_to_half_a_millisecond(seed: int) -> None:
    """Sound paths differ by up to 10 cm, which no method can tell from an offset: 0.29 ms of the error are theirs."""
    rng = np.random.default_rng(seed)
    emitted = sources(seed, 6)
    audio: Audio = {"1": (record(emitted, 6, 0, seed=seed), 0.0)}
    truth = {}
    for camera in "2345":
        truth[camera] = (rng.uniform(-0.8, 0.8), 1 + 30e-6 * rng.standard_normal())
        metres = tuple(1 + rng.uniform(-0.1, 0.1, 2))
        audio[camera] = (record(emitted, 6, *truth[camera], metres, seed=int(camera) + 10 * seed), 0.0)
    fits = estimate_sync(audio, RATE, "1")
    for camera, (start, clock_rate) in truth.items():
        assert fits[camera].status == "ok"
        assert worst_error(fits[camera], start, clock_rate, 6) < 0.5e-3


@pytest.mark.slow
def test_a_minute_with_the_papers_drifts_at_10_decibels() -> None:
    """Supp. "Capture Setup": two cameras drift by -49 and -81 us/s."""
    emitted = sources(9, 60, pour=(2, 59))
    truth = {"2": (0.73, 1 - 49e-6), "3": (-1.21, 1 - 81e-6)}
    audio: Audio = {"1": (record(emitted, 60, 0, seed=1), 0.0)}
    audio |= {camera: (record(emitted, 58, *truth[camera], seed=int(camera)), 0.0) for camera in truth}
    fits = estimate_sync(audio, RATE, "1")
    for camera, (start, clock_rate) in truth.items():
        assert worst_error(fits[camera], start, clock_rate, 58) < 0.1e-3
        assert fits[camera].clock_rate == pytest.approx(clock_rate, abs=2e-6)
        assert fits[camera].residual_rms_s < 50e-6


@pytest.mark.parametrize("offset", [2.5, -2.5])
def test_both_signs_of_an_offset_and_of_a_late_first_sample(offset: float) -> None:
    emitted = sources(3, 8, clap=3.5, pour=(4, 7))
    audio: Audio = {
        "a": (record(emitted, 8, 0.25, seed=1), 0.25),
        "b": (record(emitted, 8, offset - 0.4, seed=2), -0.4),
    }
    fit = estimate_sync(audio, RATE, "a")["b"]
    assert worst_error(fit, offset, 1.0, 8) < 0.1e-3
    np.testing.assert_allclose(fit.to_local(fit.to_reference([0.0, 7.5])), [0.0, 7.5], atol=1e-9)


def test_steady_noise_without_a_clap_suffices() -> None:
    rng = np.random.default_rng(4)
    steady = 0.1 * rng.standard_normal(round(14 * RATE))
    silence = np.zeros_like(steady)
    audio: Audio = {
        "a": (record([silence, steady], 8, 0, seed=1), 0.0),
        "b": (record([silence, steady], 8, -0.9, seed=2), 0.0),
    }
    assert worst_error(estimate_sync(audio, RATE, "a")["b"], -0.9, 1.0, 8) < 0.1e-3


def test_a_long_silent_pad_is_no_obstacle() -> None:
    """A camera whose sound begins late: digital silence, whose logarithm must not outweigh everything else."""
    emitted = sources(5, 12, clap=8, pour=(9, 11.5))
    padded = record(emitted, 12, 0.3, seed=2)
    padded[: 6 * RATE] = 0
    fit = estimate_sync({"a": (record(emitted, 12, 0, seed=1), 0.0), "b": (padded, 0.0)}, RATE, "a")["b"]
    assert fit.status == "ok"
    assert worst_error(fit, 0.3, 1.0, 12) < 0.2e-3


def doubtful() -> tuple[Audio, dict[str, str]]:
    emitted = sources(6, 6)
    good = record(emitted, 6, 0, seed=1)
    rng = np.random.default_rng(8)
    tracks = {
        "good": good,
        "fine": record(emitted, 6, 0.2, seed=2),
        "dead": np.zeros_like(good),
        "hiss": (1e-5 * rng.standard_normal(len(good))).astype(np.float32),
        "clipped": np.clip(60 * good, -1, 1),
        "elsewhere": record(sources(77, 6, clap=1.3, pour=(2.5, 5.2)), 6, 0, seed=3),
        "noise": (0.1 * rng.standard_normal(len(good))).astype(np.float32),
        "hum": (0.3 * np.sin(2 * np.pi * 200 * np.arange(len(good)) / RATE)).astype(np.float32),
        "brief": good[: RATE // 4],
    }
    expected = dict.fromkeys(tracks, "unrelated") | {"good": "ok", "fine": "ok", "clipped": "clipped"}
    return {name: (track, 0.0) for name, track in tracks.items()}, expected | dict.fromkeys(("dead", "hiss"), "silent")


def test_doubtful_tracks_are_flagged_and_given_no_offset() -> None:
    audio, expected = doubtful()
    fits = estimate_sync(audio, RATE, "good")
    assert {name: fit.status for name, fit in fits.items()} == expected
    for name, fit in fits.items():
        assert np.isnan(fit.start_s) == np.isnan(fit.clock_rate) == (expected[name] != "ok")
    assert fits["fine"].confidence > 5
    assert max(fit.confidence for fit in fits.values() if fit.status == "unrelated") < 1.5


def test_a_silent_reference_is_what_the_error_names() -> None:
    audio, _ = doubtful()
    fits = estimate_sync({name: audio[name] for name in ("dead", "good", "fine")}, RATE, "dead")
    assert all(np.isnan(fit.start_s) for fit in fits.values())
    with pytest.raises(SplashbenchError, match=r"GX010003\.MP4 \(camera dead\).*silent; check the microphone"):
        require_synced(fits, {"dead": "GX010003.MP4"})


def test_require_synced_names_the_file_and_passes_good_ones() -> None:
    audio, _ = doubtful()
    fits = estimate_sync({name: audio[name] for name in ("good", "fine", "elsewhere")}, RATE, "good")
    require_synced({name: fits[name] for name in ("good", "fine")}, {})
    with pytest.raises(SplashbenchError, match=r"b\.MP4 \(camera elsewhere\).*same sitting"):
        require_synced(fits, {"elsewhere": "b.MP4"})


def test_chance_never_makes_unrelated_pours_agree() -> None:
    for seed in range(6):
        first = record(sources(200 + seed, 6), 6, 0, decibels=20, seed=seed)
        second = record(sources(300 + seed, 6, clap=1.3, pour=(2.5, 5.2)), 6, 0, decibels=20, seed=50 + seed)
        fit = estimate_sync({"a": (first, 0.0), "b": (second, 0.0)}, RATE, "a")["b"]
        assert fit.status == "unrelated"
        assert fit.confidence < 1.5


def test_track_status_forgives_a_clap_at_full_scale() -> None:
    track = record(sources(6, 6), 6, 0)
    track[RATE : RATE + 200] = 1.0
    assert track_status(track) == "ok"


@pytest.mark.parametrize(("seconds", "share"), [(6.0, 0.45), (60.0, 0.99), (600.0, 1.0)])
def test_the_less_time_windows_span_the_less_drift_is_believed(seconds: float, share: float) -> None:
    """Bayes' rule for two Gaussians: the prior of clocks, and the change of path differences over the windows' time."""
    times = np.linspace(0, seconds, 30)
    _, clock_rate = _fit_line(times, 0.1 + 80e-6 * times, np.ones(30), RATE_PRIOR_SD)
    expected = RATE_PRIOR_SD**2 / (RATE_PRIOR_SD**2 + PATH_SD_S**2 / times.var())
    assert expected == pytest.approx(share, abs=0.02)
    assert clock_rate - 1 == pytest.approx(80e-6 * expected, rel=0.01)


def test_sequence_sync_rms_finds_what_the_fit_left_over() -> None:
    emitted = sources(11, 8, pour=(2, 7))
    audio: Audio = {
        name: (record(emitted, 8, start, seed=k), 0.0)
        for k, (name, start) in enumerate({"1": 0.0, "2": 0.5, "3": -0.3}.items())
    }
    audio["4"] = (np.zeros(8 * RATE, np.float32), 0.0)
    fits = estimate_sync(audio, RATE, "1")
    exact = sequence_sync_rms(audio, RATE, fits, (3.0, 6.5), "1")
    assert exact.unmeasured == ("4",)
    assert exact.clock_rms_s is not None
    assert exact.clock_rms_s < 20e-6
    # The paper shifts by whole frames of 1/60 s: 0.5 s are 30 of them, -0.3 s are 18, so nothing is rounded.
    assert exact.whole_frame_rms_s == pytest.approx(exact.clock_rms_s, abs=20e-6)
    # At 0.07 s a frame both are rounded: 0.5 to 0.49, and -0.3 to -0.28.
    coarse = sequence_sync_rms(audio, RATE, fits, (3.0, 6.5), "1", frame_s=0.07)
    assert coarse.clock_rms_s == exact.clock_rms_s
    assert coarse.whole_frame_rms_s == pytest.approx(np.std([0.0, 0.01, -0.02]), abs=50e-6)
    # Whole-frame alignment of the paper: shift two cameras by known amounts, in both directions.
    shifted = dict(fits)
    shifted["2"] = replace(fits["2"], start_s=fits["2"].start_s - 6e-3)
    shifted["3"] = replace(fits["3"], start_s=fits["3"].start_s + 3e-3)
    found = sequence_sync_rms(audio, RATE, shifted, (3.0, 6.5), "1")
    errors = np.array([0.0, 6e-3, -3e-3])
    centred = errors - errors.mean()
    np.testing.assert_allclose([found.offsets_s[name] for name in "123"], centred, atol=30e-6)
    assert found.clock_rms_s == pytest.approx(np.sqrt(np.mean(centred**2)), abs=20e-6)


def test_sequence_sync_rms_of_silence_is_unknown() -> None:
    audio, _ = doubtful()
    fits = estimate_sync({name: audio[name] for name in ("good", "dead")}, RATE, "good")
    result = sequence_sync_rms({name: audio[name] for name in ("good", "dead")}, RATE, fits, (2.0, 4.0), "good")
    assert result.clock_rms_s is None
    assert result.whole_frame_rms_s is None
    assert result.unmeasured == ("dead",)


def test_the_papers_sync_rms_holds_the_drift_that_one_shift_leaves() -> None:
    """A clock that is 150 us/s off: its mean offset of 1.5 ms rounds to no frame, and 2.6 ms stay at second 17.5."""
    emitted = sources(21, 20, pour=(2, 19))
    drift = 150e-6
    tracks = record(emitted, 20, 0.0), record(emitted, 20, 0.0, clock_rate=1 + drift, seed=1)
    audio: Audio = {"1": (tracks[0], 0.0), "2": (tracks[1], 0.0)}
    fits = estimate_sync(audio, RATE, "1")
    late = sequence_sync_rms(audio, RATE, fits, (16.0, 19.0), "1")
    assert late.clock_rms_s is not None
    assert late.clock_rms_s < 200e-6
    assert late.whole_frame_rms_s == pytest.approx(drift * 17.5 / 2, rel=0.1)


def test_sound_paths_are_taken_out_once_positions_are_known() -> None:
    emitted = sources(12, 6)
    positions = {"1": [0.0, 0.0, 1.0], "2": [0.0, 1.6, 0.0], "3": [0.4, 0.0, 0.0]}  # metres from a source at 0
    starts = {"1": 0.0, "2": 0.31, "3": -0.22}
    audio: Audio = {
        name: (record(emitted, 6, starts[name], metres=(np.linalg.norm(at), np.linalg.norm(at)), seed=int(name)), 0.0)
        for name, at in positions.items()
    }
    raw = estimate_sync(audio, RATE, "1")
    corrected = shifted(raw, sound_paths(positions, [0.0, 0.0, 0.0], "1")[1])
    assert worst_error(raw["2"], 0.31, 1.0, 6) > 1.5e-3
    for name, start in starts.items():
        assert worst_error(corrected[name], start, 1.0, 6) < 0.1e-3


def tracks(*names: str) -> Audio:
    root = os.environ.get("SPLASHBENCH_TEST_DATA")
    if not root:
        pytest.skip("SPLASHBENCH_TEST_DATA is not set")
    folder = Path(root, "real", "audio_bbc")
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    return {name: (join_audio([folder / name], [0.0], RATE).samples, 0.0) for name in names}


@pytest.mark.slow
def test_real_recordings_of_speech_with_known_offsets() -> None:
    """BBC audio-offset-finder's excerpts; the third has white noise added and lacks 1105 samples of decoder delay."""
    audio = tracks("timbl_1.mp3", "timbl_2.mp3", "timbl_3.mp3", "r4_excerpt2.ogg")
    fits = estimate_sync(audio, RATE, "timbl_1.mp3")
    assert fits["timbl_2.mp3"].start_s == pytest.approx(12.253958, abs=5e-6)
    assert fits["timbl_3.mp3"].start_s == pytest.approx(12.230938, abs=5e-6)
    assert fits["r4_excerpt2.ogg"].status == "unrelated"
    backwards = estimate_sync(audio, RATE, "timbl_2.mp3")
    assert backwards["timbl_1.mp3"].start_s == pytest.approx(-12.253958, abs=5e-6)

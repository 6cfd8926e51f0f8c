"""Clocks from sound on sessions that are hard to tell apart: how often they are right, flagged, or silently wrong.

    python benchmarks/sound.py [--trials 600] [--seed 1] [--processes 2] [--real FOLDER] [--markdown TABLE.md]

A trial is two recordings with a known clock between them, or with nothing in common. The table has one row per kind:

    right          a clock within 2 ms of the truth throughout the recording, and every gate passed
    flagged        no clock, or a gate that failed
    silent errors  a clock that is further off than 2 ms, or one between recordings with nothing in common, with every
                   gate passed

`drift` is the share of accepted clocks whose drift lies in its stated interval, `clock` the same for the clock's error
anywhere in the recording. Kinds:

    even claps     claps 0.4 to 1 s apart with little else in common; each sounds like the next, or nearly, or not
    few sounds     two to four short sounds in noise
    one clap       a single clap in noise
    echoes         a reflection of one camera is 0.3 to 4 times as loud as the direct sound, 2 to 45 ms after it
    disjoint       pieces of one recording that share no moment
    foreign        recordings of different takes, some with the same clap or the same spacing of claps
    good           irregular claps, voices and a pour; other microphones, noise, gain, rooms and drifts (up to 100 ppm)
    good, real     cuts of the BBC recordings below --real, with noise, gain and drift

    lost samples   a good recording of which 3 to 19 ms are missing; found only where clear sounds follow

Exits with 1 where there is a silent error other than of lost samples, or where more than 5 % of good recordings are
flagged.
"""

from __future__ import annotations

import argparse
import os
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from splashbench.files import write_text
from splashbench.prepare.audio.sync import ClockFit, estimate_sync
from splashbench.prepare.audio.waveform import join_audio
from splashbench.prepare.gates import sync_gates
from splashbench.progress import track

RATE = 48000
TOLERANCE_S = 2e-3
FLAGGED_SHARE = 0.05
LEAD_S = 2.0  # of every source before common time 0
REAL_TRACKS = ("timbl_1.mp3", "timbl_2.mp3", "timbl_3.mp3")
REAL_STARTS_S = {"timbl_1.mp3": 0.0, "timbl_2.mp3": 12.253958, "timbl_3.mp3": 12.230938}

Floats = NDArray[np.float64]
Samples = NDArray[np.float32]
Generator = np.random.Generator


@dataclass(frozen=True)
class Trial:
    """Two tracks; `clock` is (start, rate) of the second against the first, None where they have nothing in common.

    lost: when, in its seconds, the second has lost samples, and how many seconds of them.
    """

    reference: Samples
    other: Samples
    clock: tuple[float, float] | None
    lost: tuple[float, float] = (np.inf, 0.0)


@dataclass(frozen=True)
class Outcome:
    """What became of a trial: its verdict, why it was flagged, its error in seconds (NaN without one), and whether the
    truth lies in the stated intervals (None where none are stated)."""

    kind: str
    verdict: str
    reason: str
    error_s: float
    drift_covered: bool | None
    clock_covered: bool | None


# Sounds, as emitted: [n] at RATE, the first sample at common time -LEAD_S.


def silence(seconds: float) -> Floats:
    """Room for `seconds` of common time, with a lead at both ends."""
    return np.zeros(round((seconds + 2 * LEAD_S) * RATE))


def clap(rng: Generator) -> Floats:
    """A burst that dies out within 30 ms."""
    length = round(0.04 * RATE)
    decay = np.exp(-np.arange(length) / (rng.uniform(0.002, 0.006) * RATE))
    return _band(rng.standard_normal(length) * decay, 400, 9000)


def chirp(rng: Generator) -> Floats:
    """A short sound of another sort: a knock that rings, or a syllable of 0.1 to 0.3 s."""
    if rng.random() < 0.5:
        t = np.arange(round(0.2 * RATE)) / RATE
        tones = [rng.normal() * np.sin(2 * np.pi * f * t) * np.exp(-t / 0.03) for f in rng.uniform(300, 4000, 6)]
        return np.sum(tones, axis=0)
    length = round(rng.uniform(0.1, 0.3) * RATE)
    return _band(rng.standard_normal(length) * np.hanning(length), 200, 4000)


def put(emitted: Floats, sound: Floats, at_s: float, loudness: float = 1.0) -> None:
    """Add a sound at common time `at_s`, scaled to the peak `loudness`."""
    begin = round((at_s + LEAD_S) * RATE)
    if 0 <= begin < len(emitted):
        piece = sound[: len(emitted) - begin]
        emitted[begin : begin + len(piece)] += loudness * piece / np.abs(sound).max()


def pour(rng: Generator, emitted: Floats, begin_s: float, end_s: float, loudness: float) -> None:
    """Add the noise of pouring, of fluttering loudness, between two common times."""
    n = round((end_s - begin_s) * RATE)
    beats = np.arange(0, n + RATE // 10, RATE // 10)
    flutter = np.interp(np.arange(n), beats, 0.4 + rng.random(len(beats)))
    put(emitted, _band(rng.standard_normal(n) * flutter, 300, 8000), begin_s, loudness)


def voice(rng: Generator, emitted: Floats, begin_s: float, end_s: float, loudness: float) -> None:
    """Add syllables: pulses of a gliding pitch through resonances, with pauses between them."""
    at = begin_s
    while at < end_s:
        seconds = rng.uniform(0.12, 0.35)
        t = np.arange(round(seconds * RATE)) / RATE
        pitch = rng.uniform(90, 200) * (1 + rng.uniform(-0.6, 0.6) * t)
        pulses = np.diff(np.floor(np.cumsum(pitch) / RATE), prepend=0.0) + 0.02 * rng.standard_normal(len(t))
        for f, width in zip(rng.uniform([300, 900, 2200], [800, 2000, 3200]), (80, 120, 180)):
            radius, angle = np.exp(-np.pi * width / RATE), 2 * np.pi * f / RATE
            pulses = signal.lfilter([1 - radius], [1, -2 * radius * np.cos(angle), radius**2], pulses)
        put(emitted, pulses * np.hanning(len(t)), at, loudness * rng.uniform(0.4, 1))
        at += seconds + rng.exponential(0.15)


def _band(samples: Floats, low: float, high: float) -> Floats:
    return np.asarray(signal.sosfilt(signal.butter(2, [low, high], "bandpass", fs=RATE, output="sos"), samples))


# Microphones.


def hear(emitted: Floats, seconds: float, start_s: float, clock_rate: float) -> Floats:
    """What arrives over `seconds` of a clock with this start and rate: windowed-sinc interpolation."""
    place = (start_s + clock_rate * np.arange(round(seconds * RATE)) / RATE + LEAD_S) * RATE
    whole = np.floor(place).astype(np.int64)
    heard = np.zeros(len(place))
    for tap in range(-4, 6):
        distance = place - whole - tap
        inside = (whole + tap >= 0) & (whole + tap < len(emitted))
        values = np.where(inside, emitted[np.clip(whole + tap, 0, len(emitted) - 1)], 0.0)
        heard += values * np.sinc(distance) * (0.5 + 0.5 * np.cos(np.pi * distance / 5))
    return heard


def room(rng: Generator, heard: Floats, reverberation: float) -> Floats:
    """Reflections of table and wall, and a reverberation with this share of the direct sound's energy."""
    response = np.zeros(round(0.25 * RATE))
    response[0] = 1.0
    for strength in (0.25, 0.2):
        response[round(rng.uniform(0.0008, 0.02) * RATE)] += strength * rng.uniform(0.5, 1.2)
    tail = rng.standard_normal(len(response)) * np.exp(-np.arange(len(response)) / (0.05 * RATE))
    tail[: round(0.003 * RATE)] = 0
    response += tail * np.sqrt(reverberation / np.square(tail).sum())
    return np.asarray(signal.fftconvolve(heard, response)[: len(heard)])


def microphone(rng: Generator, heard: Floats, noise: float) -> Samples:
    """Coloured, with the microphone's own noise (RMS against the loudest sound's peak of 1), at some gain."""
    frequency = np.fft.rfftfreq(len(heard), 1 / RATE)
    bands = np.geomspace(80, 20000, 9)
    gains = np.interp(np.log(np.maximum(frequency, 1.0)), np.log(bands), rng.uniform(-5, 5, len(bands)))
    heard = np.fft.irfft(np.fft.rfft(heard) * 10 ** (gains / 20), len(heard))
    hiss = _band(rng.standard_normal(len(heard)), 60, rng.uniform(3000, 12000))
    recorded = heard + noise * hiss / hiss.std()
    return np.asarray(recorded * rng.uniform(0.05, 0.6) / np.abs(recorded).max(), np.float32)


def record(
    rng: Generator,
    emitted: Floats,
    seconds: float,
    clock: tuple[float, float],
    noise: tuple[float, float],
    reverberation: float = 0.05,
    spread: float = 1.0,
) -> Trial:
    """Two cameras' tracks of `emitted`: the first on common time, the second on `clock`; `noise` is a range of RMS."""
    tracks = []
    for start, clock_rate in ((0.0, 1.0), clock):
        heard = room(rng, hear(emitted, seconds, start, clock_rate), reverberation)
        tracks.append(microphone(rng, heard, float(np.exp(rng.uniform(*np.log(noise))))))
    return Trial(tracks[0], tracks[1], clock)


def some_clock(rng: Generator, offset_s: float = 1.5) -> tuple[float, float]:
    """A start of up to `offset_s` either way; a rate as of the paper's cameras, worst -81 ppm."""
    return float(rng.uniform(-offset_s, offset_s)), 1 + float(np.clip(35e-6 * rng.standard_normal(), -1e-4, 1e-4))


# Kinds of trials.


def even_claps(rng: Generator) -> Trial:
    period, n = rng.uniform(0.4, 1.0), int(rng.integers(5, 15))
    emitted = silence(16)
    likeness = (1.0, 0.9, 0.0)[int(rng.integers(3))]
    same = clap(rng)
    first = rng.uniform(0.5, 2.5)
    for k in range(n):
        put(emitted, likeness * same + (1 - likeness) * clap(rng), first + k * period, rng.uniform(0.7, 1))
    if rng.random() < 0.3:  # little else is not nothing
        pour(rng, emitted, 2, 12, 0.003)
    return record(rng, emitted, rng.uniform(6, 14), some_clock(rng, 2.0), (0.003, 0.1))


def few_sounds(rng: Generator) -> Trial:
    seconds = rng.uniform(8, 20)
    emitted = silence(seconds)
    for _ in range(int(rng.integers(2, 5))):
        put(emitted, (clap, chirp)[int(rng.integers(2))](rng), rng.uniform(0, seconds), rng.uniform(0.3, 1))
    return record(rng, emitted, seconds, some_clock(rng), (0.005, 0.15))


def one_clap(rng: Generator) -> Trial:
    seconds = rng.uniform(6, 20)
    emitted = silence(seconds)
    put(emitted, clap(rng), rng.uniform(0.2, 0.8) * seconds)
    return record(rng, emitted, seconds, some_clock(rng, 1.0), (0.003, 0.2))


def echoes(rng: Generator) -> Trial:
    """One camera's direct sound is muffled, so that a wall's is louder; noise is moderate."""
    seconds = rng.uniform(8, 16)
    emitted = take(rng, seconds)
    delay, gain = rng.uniform(0.002, 0.045), float(np.exp(rng.uniform(np.log(0.3), np.log(4))))
    clock = some_clock(rng)
    tracks = []
    late = int(rng.integers(2))
    for index, (start, clock_rate) in enumerate(((0.0, 1.0), clock)):
        heard = hear(emitted, seconds, start, clock_rate)
        if index == late:
            heard = (heard + gain * hear(emitted, seconds, start - delay, clock_rate)) / max(1, gain)
        tracks.append(microphone(rng, room(rng, heard, 0.02), rng.uniform(0.002, 0.03)))
    return Trial(tracks[0], tracks[1], clock)


def take(rng: Generator, seconds: float) -> Floats:
    """A take: one to five claps at no regular times, voices, and a pour for a third to most of the time."""
    emitted = silence(seconds)
    for at in rng.uniform(0.3, seconds - 0.3, int(rng.integers(1, 6))):
        put(emitted, clap(rng), at, rng.uniform(0.5, 1))
    if rng.random() < 0.7:
        voice(rng, emitted, -LEAD_S, seconds * rng.uniform(0.3, 1), rng.uniform(0.05, 0.5))
    begin = seconds * rng.uniform(0.1, 0.4)
    pour(rng, emitted, begin, begin + seconds * rng.uniform(0.35, 0.6), rng.uniform(0.1, 0.5))
    return emitted


def disjoint(rng: Generator, real: Path | None) -> Trial:
    """Two pieces of one recording, or of two cameras' recordings of one take."""
    seconds = rng.uniform(1.5, 12)
    gap = rng.uniform(0, 4)
    if real is not None and rng.random() < 0.5:
        seconds = min(seconds, rng.uniform(1.5, 8))
        names = REAL_TRACKS if seconds > 3 else (*REAL_TRACKS, "r4_excerpt2.ogg")
        whole = real_track(real, names[int(rng.integers(len(names)))]).astype(np.float64)
        gap = min(gap, len(whole) / RATE - 2 * seconds)
        last = len(whole) / RATE - 2 * seconds - gap
        at = rng.uniform(0, last) if last > 0 else 0.0
        pieces = [whole[round(t * RATE) : round((t + seconds) * RATE)] for t in (at, at + seconds + gap)]
    else:
        length = 2 * seconds + gap
        emitted = take(rng, length) if rng.random() < 0.6 else silence(length)
        if rng.random() < 0.6:
            voice(rng, emitted, -LEAD_S, length, 0.6)
        if not np.abs(emitted).max():
            pour(rng, emitted, 0, length, 0.5)
        if rng.random() < 0.3:  # the room's own hum and fan
            t = np.arange(len(emitted)) / RATE
            emitted += 0.02 * sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (100, 200, 300, 1170))
        pieces = [room(rng, hear(emitted, seconds, start, 1.0), 0.05) for start in (0.0, seconds + gap)]
    noise = (0.0, 0.005, 0.05)[int(rng.integers(3))]
    tracks = [microphone(rng, piece / max(np.abs(piece).max(), 1e-9), noise) for piece in pieces]
    order = int(rng.integers(2))
    return Trial(tracks[order], tracks[1 - order], None)


def foreign(rng: Generator, real: Path | None) -> Trial:
    """Two takes that have nothing in common but, at times, the sound of the clap or the spacing of claps."""
    seconds = rng.uniform(6, 16)
    if real is not None and rng.random() < 0.15:
        names = ("timbl_1.mp3", "r4_excerpt2.ogg") if rng.random() < 0.5 else ("r4_excerpt.ogg", "r4_excerpt2.ogg")
        tracks = [microphone(rng, real_track(real, name)[: 12 * RATE].astype(np.float64), 0.003) for name in names]
        return Trial(tracks[0], tracks[1], None)
    takes = [take(rng, seconds) if rng.random() < 0.7 else silence(seconds) for _ in range(2)]
    sort = rng.random()
    if sort < 0.35:  # the same clapper in both
        same = clap(rng)
        for emitted in takes:
            put(emitted, same, rng.uniform(0.5, seconds - 0.5), 1.2)
    elif sort < 0.6:  # the same rhythm in both
        period, same = rng.uniform(0.4, 1.0), clap(rng)
        for emitted in takes:
            first = rng.uniform(0.3, 1.5)
            for k in range(int(rng.integers(4, 10))):
                put(emitted, same if sort < 0.47 else clap(rng), first + k * period, 1.2)
    noise = float(np.exp(rng.uniform(np.log(0.003), np.log(0.1))))
    tracks = [microphone(rng, room(rng, hear(one, seconds, 0.0, 1.0), 0.05), noise) for one in takes]
    return Trial(tracks[0], tracks[1], None)


def good(rng: Generator) -> Trial:
    seconds = rng.choice([6.5, 10.0, 16.0, 24.0, 38.0], p=[0.3, 0.25, 0.2, 0.15, 0.1])
    return record(
        rng, take(rng, seconds), float(seconds), some_clock(rng), (0.003, 0.06), float(rng.choice([0.02, 0.1, 0.3]))
    )


def lost_samples(rng: Generator) -> Trial:
    """A good recording of which 3 to 19 ms are missing, a second or more from both ends."""
    whole = good(rng)
    assert whole.clock is not None
    start, _ = whole.clock
    first, last = max(0.0, -start), min(len(whole.other), len(whole.reference) - start * RATE) / RATE
    at, gap = float(rng.uniform(first + 1, last - 1)), float(rng.uniform(0.003, 0.019))
    other = np.delete(whole.other, np.s_[round(at * RATE) : round((at + gap) * RATE)])
    return Trial(whole.reference, other, whole.clock, (at, gap))


def good_real(rng: Generator, real: Path) -> Trial:
    """Cuts that share at least half of their length, one of them on another clock."""
    name = REAL_TRACKS[int(rng.integers(3))]
    seconds = rng.uniform(8, 20)
    source, other = real_track(real, "timbl_1.mp3"), real_track(real, name)
    at = rng.uniform(12.3, len(source) / RATE - seconds)
    shift = rng.uniform(-0.4, 0.4) * seconds
    clock_rate = 1 + float(np.clip(35e-6 * rng.standard_normal(), -1e-4, 1e-4))
    begin = float(np.clip(at + shift - REAL_STARTS_S[name], 0, len(other) / RATE - seconds))
    cut = hear(np.pad(other.astype(np.float64), round(LEAD_S * RATE)), seconds, begin, clock_rate)
    first = source[round(at * RATE) : round((at + seconds) * RATE)].astype(np.float64)
    tracks = [microphone(rng, one / np.abs(one).max(), rng.uniform(0.001, 0.03)) for one in (first, cut)]
    return Trial(tracks[0], tracks[1], (begin + REAL_STARTS_S[name] - round(at * RATE) / RATE, clock_rate))


@cache
def real_track(folder: Path, name: str) -> Samples:
    """One of the BBC's recordings, mono at RATE."""
    return join_audio([folder / name], [0.0], RATE).samples


# Trials and their table.

LOST = "lost samples"
KINDS: dict[str, tuple[Callable[[Generator, Path | None], Trial], float]] = {  # how to make it, share of the trials
    "even claps": (lambda rng, _: even_claps(rng), 0.14),
    "few sounds": (lambda rng, _: few_sounds(rng), 0.12),
    "one clap": (lambda rng, _: one_clap(rng), 0.1),
    "echoes": (lambda rng, _: echoes(rng), 0.14),
    "disjoint": (disjoint, 0.18),
    "foreign": (foreign, 0.13),
    "good": (lambda rng, _: good(rng), 0.13),
    "good, real": (lambda rng, real: good_real(rng, real) if real else good(rng), 0.06),
    LOST: (lambda rng, _: lost_samples(rng), 0.1),
}


def run(trial: tuple[str, int], seed: int, real: Path | None) -> Outcome:
    """Make one trial and fit its clock."""
    kind, index = trial
    rng = np.random.default_rng([seed, list(KINDS).index(kind), index])
    made = KINDS[kind][0](rng, real)
    fits = estimate_sync({"1": (made.reference, 0.0), "2": (made.other, 0.0)}, RATE, "1")
    fit = fits["2"]
    if fit.status != "ok":
        return Outcome(kind, "flagged", fit.status, float("nan"), None, None)
    failed = ", ".join(gate.name for gate in sync_gates(fits, None) if not gate.passed)
    error = float("inf") if made.clock is None else clock_error(fit, made)
    drift, clock = None, None
    if made.clock is not None:
        drift = abs(fit.clock_rate - made.clock[1]) <= fit.drift_interval
        clock = error <= fit.interval_s
    if failed:
        return Outcome(kind, "flagged", failed, error, None, None)
    return Outcome(kind, "right" if error <= TOLERANCE_S else "silent error", "", error, drift, clock)


def clock_error(fit: ClockFit, trial: Trial) -> float:
    """Largest error in seconds of a clock while both cameras record."""
    assert trial.clock is not None
    start, clock_rate = trial.clock
    ends = np.array([max(0.0, -start), min(len(trial.other), len(trial.reference) - start * RATE) / RATE])
    at, gap = trial.lost
    true = start + clock_rate * (ends + np.where(ends > at, gap, 0.0))
    return float(np.abs(fit.to_reference(ends) - true).max())


def table(outcomes: list[Outcome]) -> str:
    """Markdown: a row per kind."""
    heads = (
        "kind",
        "trials",
        "right",
        "flagged",
        "silent errors",
        "median error [ms]",
        "drift",
        "clock",
        "why flagged",
    )
    lines = [f"| {' | '.join(heads)} |", "|---|" + "--:|" * 7 + "---|"]
    for kind in [*KINDS, "all"]:
        rows = [outcome for outcome in outcomes if kind in (outcome.kind, "all")]
        if not rows:
            continue
        verdicts = [outcome.verdict for outcome in rows]
        reasons: defaultdict[str, int] = defaultdict(int)
        for outcome in rows:
            if outcome.reason:
                reasons[outcome.reason] += 1
        why = ", ".join(f"{reason} {n}" for reason, n in sorted(reasons.items(), key=lambda item: -item[1]))
        errors = [outcome.error_s for outcome in rows if outcome.verdict == "right"]
        median = f"{np.median(errors) * 1e3:.3f}" if errors else ""
        shares = [_share([o.drift_covered for o in rows]), _share([o.clock_covered for o in rows])]
        counts = [str(verdicts.count(verdict)) for verdict in ("right", "flagged", "silent error")]
        lines.append(f"| {' | '.join([kind, str(len(rows)), *counts, median, *shares, why])} |")
    return "\n".join(lines) + "\n"


def _share(flags: list[bool | None]) -> str:
    known = [flag for flag in flags if flag is not None]
    return f"{np.mean(known):.2f}" if known else ""


def main() -> int:
    """Print the table, and write it to --markdown; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=600, help="over all kinds (default 600)")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1)
    data = os.environ.get("SPLASHBENCH_TEST_DATA")
    default = Path(data, "real", "audio_bbc") if data else None
    parser.add_argument(
        "--real", type=Path, default=default, help="folder of the BBC recordings (SPLASHBENCH_TEST_DATA)"
    )
    parser.add_argument("--verbose", action="store_true", help="also a line for every trial that was not right")
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    real = options.real if options.real and options.real.is_dir() else None
    if real is None:
        print("no BBC recordings: the kinds that need them are made of synthetic sounds")
    trials = [(kind, k) for kind in options.kinds for k in range(max(1, round(KINDS[kind][1] * options.trials)))]
    one = partial(run, seed=options.seed, real=real)
    with ProcessPoolExecutor(options.processes, get_context("spawn")) as pool:
        outcomes = list(track(pool.map(one, trials, chunksize=4), "trials", len(trials)))
    if options.verbose:
        for (kind, index), outcome in zip(trials, outcomes):
            if outcome.verdict != "right":
                print(f"{kind} {index}: {outcome.verdict} {outcome.reason} {outcome.error_s * 1e3:.2f} ms")
    text = table(outcomes)
    print(text, end="")
    if options.markdown:
        write_text(options.markdown, text)
    silent = sum(outcome.verdict == "silent error" and outcome.kind != LOST for outcome in outcomes)
    of_good = [outcome for outcome in outcomes if outcome.kind.startswith("good")]
    flagged = sum(outcome.verdict == "flagged" for outcome in of_good)
    return 1 if silent or flagged > FLAGGED_SHARE * len(of_good) else 0


if __name__ == "__main__":
    raise SystemExit(main())

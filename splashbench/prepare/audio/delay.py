"""Delay between two recordings of the same sound: loudness envelopes for the whole, GCC-PHAT for windows of it.

Serves `sync`. The delay of y against x at y's time t is d where y(t) and x(t + d) are the same sound; both
times count from the first sample. A clock line (start, rate) predicts d = start + (rate - 1) t. GCC-PHAT:
Knapp and Carter, "The generalized correlation method for estimation of time delay", 1976, eq. 22 f.; the
coherence weight is that of their ML processor without its pole, so that bands holding only noise or a codec's
emptiness do not vote.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

Samples = NDArray[np.float32]
Floats = NDArray[np.float64]

MIN_OVERLAP_S = 1.0
_LOWEST_HZ, _HIGHEST_HZ = 150.0, 16000.0  # below: handling noise, mains hum; above: emptied by codecs
_HOP_S = 0.002  # of the loudness envelope
_UPSAMPLING = 4
_NEIGHBOURHOOD_S = 1.5e-3  # peaks this near are the same one, with its first reflections
NEAR_S = 0.04  # peaks this near are reflections; those further off are other moments of the sound
_FRAME_S = 0.02  # over which the loudness is levelled, longer than a clap
ECHO_REACH_S = 0.05  # how much later than the direct sound a reflection is looked for: 17 m of detour
_SHORTEST_ECHO_S = 1.2e-3  # earlier ones shift the peak rather than make another
_SAME_ECHO_S = 4e-4  # peaks this near are one echo's
_LEAST_ECHO = 0.16  # of the chosen arrival's strength; twice what good recordings show
_LEAST_OWN_ECHO = 0.07  # of the autocorrelation


@dataclass(frozen=True)
class DelayWindow:
    """Delay measured in one window: y's time of its middle, the delay (both in seconds), peak over the next peak."""

    time_s: float
    delay_s: float
    prominence: float


@dataclass(frozen=True)
class PeakEvidence:
    """How the correlation peak on a clock line compares with others, over all sound in common.

    Attributes:
        near: its height over the highest within `NEAR_S`, by GCC-PHAT, which tells reflections apart.
        far: its height over the highest at any other lag, by the correlation of whole recordings.
        earlier_s: how much earlier than the chosen one, in seconds, a weaker arrival of the same sound comes: positive
            in y, negative in x, 0 where none does.
    """

    near: float
    far: float
    earlier_s: float


def coarse_lags(x: Samples, y: Samples, rate: int) -> list[float]:
    """Candidate delays of y against x in seconds, from loudness envelopes and the loudest pieces of the sound.

    The envelope finds claps through any drift; steady noise has no envelope to speak of, and is found by its
    waveform.
    """
    ex, ey = _envelope(x, rate), _envelope(y, rate)
    n = fft.next_fast_len(len(ex) + len(ey), real=True)
    correlation = fft.irfft(fft.rfft(ex, n) * np.conj(fft.rfft(ey, n)), n)
    lags = [lag * _HOP_S for lag in _peaks(correlation, len(ey), 4, round(0.02 / _HOP_S))]
    return _distinct(lags + _waveform_lags(x, y, rate, ey), 0.004)


def _waveform_lags(x: Samples, y: Samples, rate: int, loudness: Floats) -> list[float]:
    """Delays at which the loudest pieces of y occur in x, by GCC-PHAT below 4 kHz."""
    step = max(1, rate // 8000)
    low = rate / step
    xs, ys = (signal.resample_poly(samples, 1, step).astype(np.float32) for samples in (x, y))
    piece = int(min(4 * low, len(ys)))
    hops = max(1, round(piece / low / _HOP_S))
    power = np.convolve(np.maximum(loudness, 0) ** 2, np.ones(hops), "valid") if len(loudness) > hops else np.zeros(1)
    n = fft.next_fast_len(len(xs) + piece, real=True)
    spectrum = fft.rfft(xs, n)
    lags: list[float] = []
    for _ in range(3):
        at = int(np.argmax(power))
        power[max(0, at - hops) : at + hops] = -1.0
        begin = min(round(at * _HOP_S * low), len(ys) - piece)
        cross = spectrum * np.conj(fft.rfft(ys[begin : begin + piece], n))
        size = np.abs(cross)
        cross /= size + 1e-2 * np.median(size) + 1e-20
        cross[: int(_LOWEST_HZ / low * n)] = 0
        lags += [lag / low - begin / low for lag in _peaks(fft.irfft(cross, n), piece, 2, round(0.004 * low))]
    return lags


def _envelope(samples: Samples, rate: int) -> Floats:
    """Loudness in dB over its surroundings, one value per `_HOP_S`; 0 where the track is digitally silent."""
    hop = round(rate * _HOP_S)
    highpass = signal.butter(2, _LOWEST_HZ, "highpass", fs=rate, output="sos")
    filtered = signal.sosfilt(highpass, samples)
    energy = np.square(filtered[: len(filtered) // hop * hop]).reshape(-1, hop).mean(axis=1)
    # A silent pad has energy 0 (or the filter's dying echo), whose logarithm would outweigh all sound.
    audible = energy > 1e-10
    if not audible.any():
        return np.zeros(len(energy))
    decibels = 10 * np.log10(np.maximum(energy, np.percentile(energy[audible], 10)))
    span = max(3, round(1.0 / _HOP_S))
    surroundings = np.convolve(np.where(audible, decibels, 0.0), np.ones(span), "same")
    surroundings /= np.maximum(np.convolve(audible.astype(float), np.ones(span), "same"), 1)
    return np.where(audible, decibels - surroundings, 0.0)


def _peaks(correlation: Floats, negative: int, count: int, apart: int) -> list[int]:
    """Lags of the highest values of a circular correlation; the last `negative` entries are negative lags."""
    c = correlation.copy()
    lags = []
    for _ in range(count):
        k = int(np.argmax(c))
        lags.append(k if k < len(c) - negative else k - len(c))
        c[np.arange(k - apart, k + apart + 1) % len(c)] = -np.inf
    return lags


def _distinct(lags: list[float], apart: float) -> list[float]:
    distinct: list[float] = []
    for lag in lags:
        if all(abs(lag - other) > apart for other in distinct):
            distinct.append(lag)
    return distinct


def measure(
    x: Samples,
    y: Samples,
    rate: int,
    line: tuple[float, float],
    reach: float,
    seconds: float,
    block: int = 0,
    max_windows: int = 200,
    spacing: float = 0.5,
) -> list[DelayWindow]:
    """Delays in windows of `seconds` over the overlap of x and y, each within `reach` seconds of the line's prediction.

    `block`: samples per transform (a power of two); 0 chooses one that the reach fits into. `spacing`: from window to
    window, in windows; from 1 on they do not overlap. Where they would be more than `max_windows`, the loudest of each
    stretch is taken.
    """
    start, clock = line
    begin = max(0.0, -start / clock)
    end = min(len(y) / rate, (len(x) / rate - start) / clock)
    count = max(1, int((end - begin - seconds) / (seconds * spacing) + 1))
    middles = np.linspace(begin + seconds / 2, end - seconds / 2, count) if count > 1 else np.array([(begin + end) / 2])
    if count > max_windows:
        tenth = rate // 10
        power = np.square(y[: len(y) // tenth * tenth]).reshape(-1, tenth).sum(axis=1, dtype=np.float64)
        total = np.concatenate([[0.0], np.cumsum(power)])
        edges = np.clip(((middles[:, None] + [-seconds / 2, seconds / 2]) * 10).astype(int), 0, len(power))
        loudness = total[edges[:, 1]] - total[edges[:, 0]]
        stretches = np.array_split(np.arange(count), max_windows)
        middles = middles[[stretch[int(np.argmax(loudness[stretch]))] for stretch in stretches]]
    windows = (measure_span(x, y, rate, line, reach, (t - seconds / 2, t + seconds / 2), block) for t in middles)
    return [window for window in windows if window is not None]


def measure_span(
    x: Samples,
    y: Samples,
    rate: int,
    line: tuple[float, float],
    reach: float,
    span: tuple[float, float],
    block: int = 0,
) -> DelayWindow | None:
    """Delay within one span of y's time (seconds); None where there is no sound in common to measure."""
    block = block or max(4096, 1 << int(np.ceil(np.log2(4 * reach * rate))))
    correlation = _correlate(x, y, rate, line, span, block)
    if correlation is None:
        return None
    fine_rate = rate * _UPSAMPLING
    half = min(round(reach * fine_rate), len(correlation) // 2 - 2)
    window = np.roll(correlation, half)[: 2 * half + 1]
    at = int(np.argmax(window))
    middle = (span[0] + span[1]) / 2
    lag = (at - half + _vertex(window, at)) / fine_rate
    return DelayWindow(float(middle), float(line[0] + (line[1] - 1) * middle + lag), _prominence(window, at, fine_rate))


def peak_evidence(x: Samples, y: Samples, rate: int, line: tuple[float, float]) -> PeakEvidence:
    """What speaks for the clock line against all others; zeros without sound in common."""
    span = (max(0.0, -line[0]), min(len(y) / rate, len(x) / rate - line[0]))
    spectra: list[Floats] = []
    correlation = _correlate(x, y, rate, line, span, 8192, spectra)
    if correlation is None:
        return PeakEvidence(0.0, 0.0, 0.0)
    return PeakEvidence(
        _near_ratio(correlation, rate), _far_ratio(x, y, rate, line), _earlier_arrival(correlation, spectra, rate)
    )


def _near_ratio(correlation: Floats, rate: int) -> float:
    """Height of the peak at lag 0 over the highest within `NEAR_S`."""
    fine_rate = rate * _UPSAMPLING
    half = round(NEAR_S * fine_rate)
    window = np.roll(correlation, half)[: 2 * half + 1]
    near = round(_NEIGHBOURHOOD_S * fine_rate)
    at = half - near + int(np.argmax(window[half - near : half + near + 1]))
    return _prominence(window, at, fine_rate)


def _far_ratio(x: Samples, y: Samples, rate: int, line: tuple[float, float]) -> float:
    """Height of the whole recordings' correlation on the line over the highest further than `NEAR_S` from it."""
    start, clock = line
    n = round(len(y) * clock)
    # The nearest sample is at most 10 us off, which is nothing below 4 kHz.
    slip = np.round(np.arange(n, dtype=np.float32) * np.float32(1 / clock - 1)).astype(np.int32)
    same_clock = y[np.clip(np.arange(n, dtype=np.int32) + slip, 0, len(y) - 1)]
    step = max(1, rate // 8000)
    low = rate / step
    flat = [_flattened(samples, step, low) for samples in (x, same_clock)]
    best = 0.0
    # As they are, loud short sounds count; levelled, long quiet ones. Either may tell the lags apart.
    for share in (0.0, 0.5, 1.0):
        xs, ys = (_levelled(samples, low, share) for samples in flat)
        size = fft.next_fast_len(len(xs) + len(ys), real=True)
        correlation = np.abs(fft.irfft(fft.rfft(xs, size) * np.conj(fft.rfft(ys, size)), size))
        around = round(start * low) + np.arange(-round(NEAR_S * low), round(NEAR_S * low) + 1)
        reach = round(_NEIGHBOURHOOD_S * low)
        middle = len(around) // 2
        height = float(correlation[around[middle - reach : middle + reach + 1] % size].max())
        correlation[around % size] = 0.0
        rival = float(correlation.max())
        best = max(best, height / rival if rival > 0 else 0.0)
    return best


def _flattened(samples: Samples, step: int, low: float) -> Samples:
    """`samples` at `low` Hz (every `step`-th), all frequencies alike."""
    decimated = signal.resample_poly(samples, 1, step).astype(np.float32) if step > 1 else samples
    block = 512
    if len(decimated) < block:
        return decimated
    _, power = signal.welch(decimated, low, nperseg=block, average="median")
    gain = 1 / np.sqrt(power + 1e-3 * power.mean() + 1e-20)
    frequency = np.linspace(0, low / 2, len(gain))
    gain[(frequency < _LOWEST_HZ) | (frequency > 0.45 * low)] = 0
    kernel = np.fft.fftshift(np.fft.irfft(gain)) * np.hanning(block)
    return np.asarray(signal.oaconvolve(decimated, kernel.astype(np.float32), "same"), np.float32)


def _levelled(flat: Samples, low: float, share: float) -> Samples:
    """`flat`, at `low` Hz, with differences of loudness (in dB) reduced by `share`."""
    # Running sums may come out below 0 in silence after a loud sound.
    power = np.maximum(uniform_filter1d(np.square(flat), round(_FRAME_S * low), mode="constant"), 0)
    loudness = np.sqrt(power)
    audible = loudness > 1e-3 * loudness.max(initial=0.0)
    levelled = np.zeros_like(flat)
    levelled[audible] = flat[audible] / loudness[audible] ** share
    return levelled


def _earlier_arrival(correlation: Floats, spectra: Sequence[Floats], rate: int) -> float:
    """`PeakEvidence.earlier_s` by the correlation along the line and its `spectra` (see `_correlate`).

    A reflection louder than the direct sound makes the line follow it. The correlation
    then has a second peak at the direct sound's delay, but so has one with a weaker reflection in the other
    recording. The two differ in whose own echo it is, which each recording's autocorrelation shows. A voice's pitch
    is in both alike, and left to right, so differences leave it out.
    """
    lags, other_peak, echo_of_y = _echoes(correlation, spectra, rate)
    peaks = np.abs(other_peak) >= maximum_filter1d(np.abs(other_peak), round(_SAME_ECHO_S * rate * _UPSAMPLING))
    earlier = peaks & (other_peak * echo_of_y > 0) & (np.abs(echo_of_y) >= _LEAST_OWN_ECHO)
    strength = np.where(earlier, np.abs(other_peak), 0.0)
    at = int(np.argmax(strength))
    return float(np.sign(echo_of_y[at]) * lags[at]) if strength[at] >= _LEAST_ECHO else 0.0


def _echoes(correlation: Floats, spectra: Sequence[Floats], rate: int) -> tuple[Floats, Floats, Floats]:
    """Lags up to `ECHO_REACH_S`; the correlation there less that at the negative lag, by the main peak; and what y's
    autocorrelation has there or next to it beyond x's."""
    fine_rate = rate * _UPSAMPLING
    near = round(_NEIGHBOURHOOD_S * fine_rate / 2)
    centre = int(np.argmax(np.roll(correlation, near)[: 2 * near + 1])) - near
    around = np.roll(correlation, -centre)
    lags = np.arange(round(_SHORTEST_ECHO_S * fine_rate), round(ECHO_REACH_S * fine_rate))
    power_x, power_y, weight = spectra
    own = _autocorrelation(power_y, weight, rate)[lags] - _autocorrelation(power_x, weight, rate)[lags]
    beside = round(_SAME_ECHO_S / 4 * fine_rate)
    most, least = maximum_filter1d(own, beside), minimum_filter1d(own, beside)
    other_peak = (around[lags] - around[-lags]) / max(around[0], 1e-20)
    return lags / fine_rate, other_peak, np.where(most > -least, most, least)


def _autocorrelation(power: Floats, weight: Floats, rate: int) -> Floats:
    """Autocorrelation at `_UPSAMPLING` times the rate, 1 at lag 0, of a sound with this power spectrum, flattened.

    `weight`: of each frequency. Both are smoothed over 1 kHz: ripples of echoes over 1 ms stay.
    """
    bins = round(1000 / (rate / 2) * (len(power) - 1)) | 1
    taper = np.hanning(bins + 2)[1:-1]
    smooth, share = (
        np.convolve(np.pad(values, bins // 2, "reflect"), taper / taper.sum(), "valid") for values in (power, weight)
    )
    padded = np.zeros((len(power) - 1) * _UPSAMPLING + 1)
    padded[: len(power)] = share * power / np.maximum(smooth, 1e-20)
    correlation = fft.irfft(padded)
    return np.asarray(correlation / max(correlation[0], 1e-20))


def _prominence(window: Floats, at: int, fine_rate: float) -> float:
    near = round(_NEIGHBOURHOOD_S * fine_rate)
    others = np.concatenate([window[: max(0, at - near)], window[at + near + 1 :]])
    floor = float(np.abs(others).max()) if len(others) else 0.0
    return float(window[at]) / floor if floor > 0 else 0.0


def _vertex(values: Floats, at: int) -> float:
    """Sub-sample place of a maximum: the vertex of the parabola through it and its neighbours, in [-0.5, 0.5]."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, here, after = values[at - 1 : at + 2]
    curvature = before - 2 * here + after
    return float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5)) if curvature < 0 else 0.0


def _correlate(
    x: Samples,
    y: Samples,
    rate: int,
    line: tuple[float, float],
    span: tuple[float, float],
    block: int,
    spectra: list[Floats] | None = None,
) -> Floats | None:
    """Circular correlation (at `_UPSAMPLING` times the rate) of x against y along the clock line, over y's `span`.

    Cross spectra of short blocks are added up after each was aligned by its own predicted delay, whole
    samples by choice of the block and the rest by phase, so that drift within the span smears nothing. `spectra`
    receives the power spectra of x and y, and the weight of each frequency.
    """
    start, clock = line
    hop = block // 2
    first = round(max(0.0, span[0]) * rate)
    places = np.arange(first, min(round(span[1] * rate), len(y)) - block + 1, hop)
    exact = (start + clock * places / rate) * rate
    rounded = np.round(exact).astype(np.int64)
    inside = (rounded >= 0) & (rounded + block <= len(x))
    places, exact, rounded = places[inside], exact[inside], rounded[inside]
    if not len(places):
        return None
    frequencies = np.arange(block // 2 + 1) / block  # cycles per sample
    taper = signal.windows.hann(block, sym=False).astype(np.float32)
    cross = np.zeros(len(frequencies), np.complex128)
    power_x, power_y = np.zeros(len(frequencies)), np.zeros(len(frequencies))
    steps = np.arange(block)
    n_used = 0
    for chunk in np.array_split(np.arange(len(places)), max(1, len(places) // 64)):
        blocks_x = x[rounded[chunk, None] + steps] * taper
        blocks_y = y[places[chunk, None] + steps] * taper
        fx, fy = fft.rfft(blocks_x), fft.rfft(blocks_y)
        px, py = (np.square(f.real) + np.square(f.imag) for f in (fx, fy))
        # Every block counts alike: one loud block must not drown the rest in the spectrum it does not have.
        level = np.sqrt(px.mean(axis=1) * py.mean(axis=1)) + 1e-12
        n_used += int((level > 1e-11).sum())
        # At most a quarter turn: single precision is ample.
        shift = np.exp((2j * np.pi * frequencies * (exact - rounded)[chunk, None]).astype(np.complex64))
        cross += np.einsum("bf,bf,bf,b->f", fx, np.conj(fy), shift, 1 / level)
        power_x += (px / (px.mean(axis=1)[:, None] + 1e-12)).sum(axis=0)
        power_y += (py / (py.mean(axis=1)[:, None] + 1e-12)).sum(axis=0)
    if not n_used:
        return None
    size = np.abs(cross)
    # Magnitude-squared coherence, less what that many blocks of unrelated noise would show.
    coherence = size**2 / np.maximum(power_x * power_y, 1e-20)
    weight = np.clip(coherence - 1.0 / n_used, 0, 1) if n_used > 3 else np.ones_like(coherence)
    band = (frequencies * rate >= _LOWEST_HZ) & (frequencies * rate <= min(_HIGHEST_HZ, 0.45 * rate))
    weighted = np.where(band & (size > 0), weight * cross / np.maximum(size, 1e-20), 0)
    if spectra is not None:
        spectra += [power_x, power_y, np.where(band, weight, 0.0)]
    padded = np.zeros(block * _UPSAMPLING // 2 + 1, np.complex128)
    padded[: len(weighted)] = weighted
    return np.asarray(fft.irfft(padded, block * _UPSAMPLING))

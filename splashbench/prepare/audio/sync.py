"""Clocks of free-running cameras from their sound: offset and rate against the reference (Supp., "Capture Setup").

Coarse: loudness envelopes of whole recordings are cross-correlated. Fine: GCC-PHAT (Knapp and Carter, 1976)
with a coherence weight, in windows along the recording, to a fraction of a sample. A line through the
windows' delays is the clock:

    t_reference = start_s + clock_rate * t_local.

How well a rate is known: a short recording cannot tell drift from a sound source that moved. Path differences between
microphones change by some centimetres when the loudest source changes: `PATH_SD_S` in seconds. Windows that spread over
`spread` seconds therefore know the rate no better than PATH_SD_S / spread, however small their scatter. So the slope
is shrunk towards zero drift by Bayes' rule for two Gaussians; the other is the prior of device clocks, `RATE_PRIOR_SD`.
A slope that does not differ from zero by twice its error is no drift: the rate is 1. Either way the clock states how
far off its rate may be. 6 s of sound give a rate of 1, ten minutes give the measured rate unchanged.

How it is known that the clock is the right one, which no good fit shows by itself:

- No other lag may match nearly as well. Claps at equal intervals match at every multiple of them.
- Enough windows that do not overlap must agree, over enough time. Each may lie anywhere within 20 ms, so that chance
  agrees in one of fifty. One clap makes one window agree, in recordings of other takes as well.
- No weaker copy of the sound may arrive before the one that the clock follows: that would be the direct sound.

Arrival time is what is measured. Sound takes 2.9 ms per metre: cameras at unequal distances from the source are off by
that much until they are `shifted` by their `sound_paths`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splashbench.errors import SplashbenchError
from splashbench.prepare.audio import delay
from splashbench.prepare.audio.delay import DelayWindow, Samples

Floats = NDArray[np.float64]
Status = Literal["ok", "silent", "clipped", "unrelated", "ambiguous", "unconfirmed"]

RATE_PRIOR_SD = 50e-6  # the paper's cameras: -49 and -81 us/s for the worst two of seven
PATH_SD_S = 1e-4  # 3.4 cm of change in path difference
MAX_DRIFT = 200e-6  # ten times a poor quartz oscillator
SPEED_OF_SOUND = 343.0  # m/s in air at 20 degrees C

SILENT_PEAK = 1e-3  # -60 dB of full scale: below, a track holds nothing but its own noise
CLIPPED_LEVEL, CLIPPED_FRACTION = 0.98, 0.02  # more than a clap close to the microphone
MIN_CONFIDENCE = 2.0  # correlation peak over the next one; unrelated tracks stay below 1.5
_TOLERANCE_S = 4e-4  # windows this close to the common line support it
# What must agree with a clock: windows (of neighbours, every second one), a share of all, from first to last.
MIN_AGREEING, MIN_AGREEMENT, MIN_SPREAD_S = 3, 0.1, 1.0
_AUDIBLE, _CLEAR = 1.2, 2.0  # a window's peak over the next one: hardly chance, and no chance
# Of the clarity of the usual window: an echo caught alone has at most a quarter, what follows lost samples a third and
# more.
_ECHO_CLARITY = 0.29
_BLOCK = 4096  # samples per transform
_REACH_S = 0.02  # windows may lie this far from the line
_SIGMAS = 2.0  # of a stated interval, 95 %


@dataclass(frozen=True)
class ClockFit:
    """A camera's clock against the reference's: t_reference = start_s + clock_rate * t_local (seconds).

    Attributes:
        start_s, clock_rate: NaN where `status` is not "ok": a doubtful track is never given an offset. The rate is
            exactly 1 where the sound is too short to tell a drift from none.
        confidence: correlation peak over the highest at any other lag.
        residual_rms_s: RMS delay from the line of all windows with one clear peak, within 20 ms, whether they
            support the line or not; without those that have caught an echo alone.
        status: "ambiguous" where other lags match nearly as well, "unconfirmed" where too few windows agree.
        windows: (local time, delay from the line) of each of the `n_windows` that the line was fitted to, seconds.
        agreement: share of the windows, which do not overlap, that agree with the line.
        drift_interval: the true rate lies within this of `clock_rate`, with 95 %.
        interval_s: the true clock lies within this of the fitted one, with 95 %, while both cameras record.
        echo_s: how much earlier than the chosen arrival a weaker one comes, which would be the direct sound; positive
            in this camera, negative in the reference, 0 where there is none.
    """

    start_s: float
    clock_rate: float
    confidence: float
    residual_rms_s: float
    n_windows: int
    status: Status
    windows: tuple[tuple[float, float], ...] = ()
    agreement: float = 1.0
    drift_interval: float = 0.0
    interval_s: float = 0.0
    echo_s: float = 0.0

    def to_reference(self, local_s: ArrayLike) -> Floats:
        """Local seconds to seconds on the reference camera's clock."""
        return self.start_s + self.clock_rate * np.asarray(local_s, np.float64)

    def to_local(self, reference_s: ArrayLike) -> Floats:
        """Seconds on the reference camera's clock to local seconds."""
        return (np.asarray(reference_s, np.float64) - self.start_s) / self.clock_rate


@dataclass(frozen=True)
class SequenceSync:
    """Residual synchronisation of one sequence: what is left over along the fitted clocks, and the paper's Sync RMS.

    Attributes:
        clock_rms_s: RMS of the offsets from the fitted clocks over the measured cameras; None where fewer than two are.
        offsets_s: camera -> residual offset from its fitted clock, less their mean.
        unmeasured: cameras whose sound within the sequence tells nothing (the paper's dagger).
        whole_frame_rms_s: the paper's Sync RMS: the same, had each camera been shifted by whole frames, once for the
            whole recording, in place of the fitted clocks. It holds the rounding and the clocks' drift.
    """

    clock_rms_s: float | None
    offsets_s: dict[str, float]
    unmeasured: tuple[str, ...]
    whole_frame_rms_s: float | None = None


def estimate_sync(
    audio: Mapping[str, tuple[Samples, float]],
    rate: int,
    reference: str,
    rate_prior_sd: float = RATE_PRIOR_SD,
) -> dict[str, ClockFit]:
    """Fit every camera's clock to the reference's.

    `audio`: camera -> (mono samples float32 [S], local time of the first sample in seconds), all at `rate`
    Hz. Doubtful tracks are flagged by their status; `require_synced` turns flags into an error.
    """
    if reference not in audio:
        raise ValueError(f"reference {reference!r} is not among the cameras {sorted(audio)}")
    statuses = {camera: track_status(samples) for camera, (samples, _) in audio.items()}
    fits = {camera: _flagged(status) for camera, status in statuses.items()}
    if statuses[reference] != "ok":
        return {camera: fit if fit.status != "ok" else _flagged("unrelated") for camera, fit in fits.items()}
    reference_samples, reference_start = audio[reference]
    fits[reference] = ClockFit(0.0, 1.0, float("inf"), 0.0, 0, "ok")
    for camera, (samples, start) in audio.items():
        if camera == reference or statuses[camera] != "ok":
            continue
        fit = _fit_pair(reference_samples, samples, rate, rate_prior_sd)
        # The pair was fitted with both first samples at time 0.
        fits[camera] = replace(fit, start_s=reference_start + fit.start_s - fit.clock_rate * start)
    return fits


def track_status(samples: Samples) -> Literal["ok", "silent", "clipped"]:
    """Whether a track can be used: "silent" below -60 dB of full scale, "clipped" where over 2% is at full scale."""
    level = np.abs(samples)
    # The loudest 10 ms or so, rather than one click of a dying microphone, make a track audible.
    if len(level) < 1000 or np.partition(level, -480)[-480] < SILENT_PEAK:
        return "silent"
    if np.mean(level >= CLIPPED_LEVEL) > CLIPPED_FRACTION:
        return "clipped"
    return "ok"


def require_synced(fits: Mapping[str, ClockFit], files: Mapping[str, object]) -> None:
    """Raise SplashbenchError for the first camera without a trustworthy clock, naming its file."""
    remedies = {
        "silent": "its audio is silent; check the microphone, or leave the camera out",
        "clipped": "its audio is clipped; lower the recording level, or leave the camera out",
        "ambiguous": "its audio matches the reference camera's at more than one offset; clap several times at"
        " irregular intervals and record again, or leave the camera out",
        "unconfirmed": "its audio agrees with the reference camera's for too short a time; make sounds that every"
        " camera hears throughout the recording, such as irregular claps, or leave the camera out",
        "unrelated": "its audio does not match the reference camera's; check that both recorded the same sitting",
    }
    bad = [camera for camera, fit in fits.items() if fit.status != "ok"]
    # A silent or clipped reference makes all others look unrelated, so unrelated ones come last.
    for camera in sorted(bad, key=lambda name: fits[name].status == "unrelated"):
        fit = fits[camera]
        raise SplashbenchError(
            f"{files.get(camera, 'audio')} (camera {camera}) cannot be synchronised: {remedies[fit.status]}"
        )


def _flagged(status: Status, confidence: float = 0.0, n_windows: int = 0, agreement: float = 0.0) -> ClockFit:
    nan = float("nan")
    return ClockFit(nan, nan, confidence, nan, n_windows, status, (), agreement, nan, nan, 0.0)


def _fit_pair(x: Samples, y: Samples, rate: int, rate_prior_sd: float) -> ClockFit:
    """The clock of y against that of x, both counted from their first samples."""
    if min(len(x), len(y)) < delay.MIN_OVERLAP_S * rate:
        return _flagged("unrelated")
    line = _best_line(x, y, rate, rate_prior_sd)
    if line is None:
        return _flagged("unrelated")
    begin, end = max(0.0, -line[0]), min(len(y) / rate, (len(x) / rate - line[0]) / line[1])
    seconds = _window_seconds(end - begin)
    for _ in range(2):
        windows = delay.measure(x, y, rate, line, 2e-3, seconds, block=_BLOCK)
        _, refined = _consensus(windows, line[0], rate_prior_sd, line[1])
        if refined is None:
            return _flagged("unrelated", 0.0, len(windows))
        line = refined
    width = _separate_seconds(end - begin)
    separate = delay.measure(x, y, rate, line, _REACH_S, width, _BLOCK, spacing=1.0)
    agreeing = [window for window in _inliers(separate, line)[0] if window.prominence >= _AUDIBLE]
    # Noise agrees with a narrow window by chance in one case of five, so what the wide ones refuse has no say.
    windows = [w for w in windows if any(abs(w.time_s - other.time_s) < seconds for other in agreeing)]
    supporting, _ = _inliers(windows, line)
    if len(supporting) < 2:
        return _flagged("unrelated", 0.0, len(agreeing))
    slope = _slope(*_arrays(supporting))
    # The measured slope, not the one that is believed: sounds far apart must fall on one peak.
    steepest = slope.delay - slope.drift * slope.time, 1 + slope.drift
    peak = delay.peak_evidence(x, y, rate, steepest)
    confidence = min(peak.near, peak.far)
    agreement = len(agreeing) / len(separate)
    confirmed = _confirmed([window.time_s for window in agreeing], width) and agreement >= MIN_AGREEMENT
    if not confirmed or confidence < MIN_CONFIDENCE:
        stands_out = max(peak.near, peak.far) >= MIN_CONFIDENCE
        status: Status = "ambiguous" if confirmed else "unconfirmed" if stands_out else "unrelated"
        return _flagged(status, confidence, len(agreeing), agreement)
    fit = _clock(slope, supporting, separate, (begin, end), rate_prior_sd)
    return replace(fit, confidence=confidence, agreement=agreement, echo_s=peak.earlier_s)


def _confirmed(times: Sequence[float], width: float) -> bool:
    """Whether windows that agree at these `times`, each `width` seconds long, are enough and span enough time."""
    if not times or max(times) - min(times) < MIN_SPREAD_S:
        return False
    count, last = 0, -np.inf
    for time in sorted(times):
        # A sound on the edge of two windows makes both agree, and counts once.
        if time - last > 1.5 * width:
            count, last = count + 1, time
    return count >= MIN_AGREEING


def _best_line(x: Samples, y: Samples, rate: int, rate_prior_sd: float) -> tuple[float, float] | None:
    """The line (start, rate) that has the most support among those through the candidate lags."""
    line = None
    best = 0.0
    for lag in delay.coarse_lags(x, y, rate):
        overlap = min(len(x) / rate - lag, len(y) / rate) - max(0.0, -lag)
        if overlap < delay.MIN_OVERLAP_S:
            continue
        # What drift may add or take away on the way from the middle, and the coarseness of the lag itself.
        reach = MAX_DRIFT * overlap / 2 + 0.012
        windows = delay.measure(x, y, rate, (lag, 1.0), reach, _window_seconds(overlap), max_windows=30)
        support, candidate = _consensus(windows, lag, rate_prior_sd)
        if candidate is not None and support > best:
            best, line = support, candidate
    if line is None:
        return None
    # A window is clearer the less it reaches, so a weak reflection out of reach of the direct sound looks good.
    seconds = _window_seconds(min(len(x) / rate - line[0], len(y) / rate) - max(0.0, -line[0]))
    windows = delay.measure(x, y, rate, line, delay.ECHO_REACH_S, seconds, block=2 * _BLOCK, max_windows=60)
    _, strongest = _consensus(windows, line[0], rate_prior_sd, line[1])
    return strongest or line


def _clock(
    slope: _Slope,
    supporting: Sequence[DelayWindow],
    separate: Sequence[DelayWindow],
    overlap: tuple[float, float],
    rate_prior_sd: float,
) -> ClockFit:
    """The clock by the line through the `supporting` windows, with what is not known of it over `overlap`.

    Both cameras record during `overlap`, seconds of y.
    """
    shrunk = slope.shrunk(rate_prior_sd)
    earned = abs(slope.drift) > _SIGMAS * np.sqrt(slope.error_variance)
    drift = shrunk if earned else 0.0
    # The prior is of clocks in general and this one may be among the worst: what it took off is part of the interval.
    left = 1 / np.sqrt(1 / rate_prior_sd**2 + 1 / slope.error_variance)
    drift_interval = float(_SIGMAS * left + abs((slope.drift if earned else shrunk) - drift))
    line = slope.delay - drift * slope.time, 1 + drift
    _, residuals = _inliers(supporting, line, np.inf)
    distinct = [window for window in separate if window.prominence >= _CLEAR]
    _, clear = _inliers(distinct, line, np.inf)
    clear = clear[_heard_itself(clear, np.array([window.prominence for window in distinct]))]
    return ClockFit(
        line[0],
        line[1],
        float("nan"),
        float(np.sqrt(np.mean(np.square(clear if len(clear) else residuals)))),
        len(supporting),
        "ok",
        tuple((window.time_s, float(residual)) for window, residual in zip(supporting, residuals)),
        drift_interval=drift_interval,
        interval_s=_SIGMAS * slope.delay_sd + drift_interval * max(abs(end - slope.time) for end in overlap),
    )


def _heard_itself(residuals: Floats, prominences: Floats) -> NDArray[np.bool_]:
    """Which of clear windows are on the line, or off it and nearly as clear as those on it.

    Samples that were lost move all that follows, and leave it as clear. A window that is far less clear has caught the
    echo of a sound without the sound.
    """
    on_line = np.abs(residuals) <= _TOLERANCE_S
    usual = np.median(prominences[on_line]) if on_line.any() else 0.0
    return on_line | (prominences >= _ECHO_CLARITY * usual)


def _window_seconds(overlap: float) -> float:
    """Long recordings take windows of 4 s, short ones an eighth of their length but not less than 0.5 s."""
    return float(np.clip(overlap / 8, 0.5, 4.0))


def _separate_seconds(overlap: float) -> float:
    """Windows that are counted: two dozen or more, not so short that noise hides their peaks."""
    return float(np.clip(overlap / 24, 0.25, 1.0))


def _inliers(
    windows: Sequence[DelayWindow], line: tuple[float, float], tolerance_s: float = _TOLERANCE_S
) -> tuple[list[DelayWindow], Floats]:
    """The windows within `tolerance_s` of the line, and their delays from it."""
    residuals = np.array([w.delay_s - line[0] - (line[1] - 1) * w.time_s for w in windows])
    near = np.abs(residuals) <= tolerance_s
    return [w for w, ok in zip(windows, near) if ok], residuals[near]


def _consensus(
    windows: Sequence[DelayWindow], lag: float, rate_prior_sd: float, clock_rate: float = 1.0
) -> tuple[float, tuple[float, float] | None]:
    """The line that most windows support, by weight of their peaks: (support, (start, rate)); line None without any.

    Every pair of windows proposes a line of admissible drift; the winner's supporters are then fitted by
    weighted least squares.
    """
    if len(windows) < 2:
        return 0.0, None
    times = np.array([w.time_s for w in windows])
    delays = np.array([w.delay_s for w in windows])
    weights = np.array([max(w.prominence - 1.0, 0.0) for w in windows])
    chosen = np.argsort(-weights, kind="stable")[:60]  # proposals come from the clearest windows
    i, j = np.triu_indices(len(chosen), 1)
    i, j = chosen[i], chosen[j]
    slopes = np.concatenate(
        [
            (delays[j] - delays[i]) / np.where(times[j] == times[i], np.inf, times[j] - times[i]),
            np.full(len(chosen), clock_rate - 1),
        ]
    )
    anchors = np.concatenate([i, chosen])
    admissible = np.abs(slopes) <= MAX_DRIFT
    slopes, anchors = slopes[admissible], anchors[admissible]
    starts = delays[anchors] - slopes * times[anchors]
    misfit = np.abs(delays[None] - starts[:, None] - slopes[:, None] * times[None])
    support = np.where(misfit < _TOLERANCE_S, weights * (1 - (misfit / _TOLERANCE_S) ** 2), 0.0).sum(axis=1)
    winner = int(np.argmax(support))
    near = misfit[winner] < _TOLERANCE_S
    if near.sum() < 2 or support[winner] <= 0:
        return 0.0, None
    return float(support[winner]), _fit_line(times[near], delays[near], weights[near], rate_prior_sd)


@dataclass(frozen=True)
class _Slope:
    """A line through delays: `delay` at `time` (seconds) and its error, `drift` and the variance of its error."""

    delay: float
    time: float
    drift: float
    delay_sd: float
    error_variance: float

    def shrunk(self, rate_prior_sd: float) -> float:
        """The drift shrunk towards zero by Bayes' rule for two Gaussians."""
        return self.drift * rate_prior_sd**2 / (rate_prior_sd**2 + self.error_variance)


def _arrays(windows: Sequence[DelayWindow]) -> tuple[Floats, Floats, Floats]:
    """Times, delays and weights of windows."""
    times = np.array([window.time_s for window in windows])
    delays = np.array([window.delay_s for window in windows])
    return times, delays, np.array([max(window.prominence - 1.0, 1e-3) for window in windows])


def _slope(times: Floats, delays: Floats, weights: Floats) -> _Slope:
    """The line by Tukey-weighted least squares, and what paths that change leave unknown (see the head of the file)."""
    robust = np.ones_like(delays)
    for _ in range(20):
        w = robust * weights
        w = w / w.sum()
        centre = w @ times
        middle = w @ delays
        variance = w @ (times - centre) ** 2
        slope = w @ ((times - centre) * (delays - middle)) / variance if variance > 0 else 0.0
        residuals = delays - middle - slope * (times - centre)
        sigma = max(1.4826 * float(np.median(np.abs(residuals))), 1e-5)
        robust = np.clip(1 - (residuals / (4.685 * sigma)) ** 2, 1e-3, 1) ** 2
    delay_variance = sigma**2 * float((w**2).sum()) + PATH_SD_S**2
    error_variance = delay_variance / variance if variance > 0 else np.inf
    return _Slope(float(middle), float(centre), float(slope), float(np.sqrt(delay_variance)), float(error_variance))


def _fit_line(times: Floats, delays: Floats, weights: Floats, rate_prior_sd: float) -> tuple[float, float]:
    """(start, rate) of the line, the slope shrunk towards zero drift."""
    fit = _slope(times, delays, weights)
    drift = fit.shrunk(rate_prior_sd)
    return fit.delay - drift * fit.time, 1 + drift


def sequence_sync_rms(
    audio: Mapping[str, tuple[Samples, float]],
    rate: int,
    fits: Mapping[str, ClockFit],
    interval: tuple[float, float],
    reference: str,
    margin_s: float = 0.0,
    frame_s: float = 1 / 60,
) -> SequenceSync:
    """Offsets re-estimated by GCC-PHAT within the sequence, centred, and their RMS over cameras.

    `interval`: seconds on the reference's clock, widened by `margin_s` at both ends. The frames were chosen by `fits`;
    the offsets here are what those leave over, up to 50 ms. The paper instead shifts a camera by whole frames of
    `frame_s` seconds, once for the session (supplement, "Capture Setup"): its Sync RMS is the other figure.
    """
    x, x_start = audio[reference]
    offsets, whole_frame = {reference: 0.0}, {reference: 0.0}
    unmeasured = []
    for camera, (y, y_start) in audio.items():
        if camera == reference:
            continue
        fit = fits[camera]
        window = None
        if fit.status == "ok":
            line = (fit.start_s + fit.clock_rate * y_start - x_start, fit.clock_rate)
            local = fit.to_local([interval[0] - margin_s, interval[1] + margin_s]) - y_start
            window = delay.measure_span(x, y, rate, line, 0.05, (float(local[0]), float(local[1])))
        if window is None or window.prominence < MIN_CONFIDENCE:
            unmeasured.append(camera)
        else:
            # Sound that arrives later by the reference's clock than the fit says: the fit put the camera too
            # early.
            offsets[camera] = window.delay_s - (line[0] + (line[1] - 1) * window.time_s)
            at = y_start + window.time_s
            by_clock = float(fit.to_reference(at)) - at
            whole_frame[camera] = by_clock + offsets[camera] - _session_shift(fit, y_start, len(y) / rate, frame_s)
    if len(offsets) < 2:
        return SequenceSync(None, {}, tuple(unmeasured))
    centred, rms = _centred(offsets)
    return SequenceSync(rms, centred, tuple(unmeasured), _centred(whole_frame)[1])


def _session_shift(fit: ClockFit, start_s: float, duration_s: float, frame_s: float) -> float:
    """Whole frames, in seconds, by which a camera is shifted that recorded `duration_s` from `start_s` on (its clock):
    those nearest to its mean offset."""
    middle = start_s + 0.5 * duration_s
    return round((float(fit.to_reference(middle)) - middle) / frame_s) * frame_s


def _centred(offsets: Mapping[str, float]) -> tuple[dict[str, float], float]:
    """`offsets` less their mean, and their RMS then."""
    mean = float(np.mean(list(offsets.values())))
    centred = {camera: offset - mean for camera, offset in offsets.items()}
    return centred, float(np.sqrt(np.mean(np.square(list(centred.values())))))


def sound_paths(
    positions: Mapping[str, ArrayLike], source: ArrayLike, reference: str
) -> tuple[dict[str, float], dict[str, float]]:
    """The way of the sound to every camera, in metres, and what it adds to the start of the camera's clock, seconds.

    `positions`: camera -> [3]; `source`: [3], both in metres in the same frame. The fit takes the arrivals of a sound
    at camera and reference for the same time. A camera farther away records it later, so its clock shows a later time
    than the fit believes.
    """
    where = np.asarray(source, np.float64)
    distance = {camera: float(np.linalg.norm(np.asarray(at, np.float64) - where)) for camera, at in positions.items()}
    return distance, {camera: (way - distance[reference]) / SPEED_OF_SOUND for camera, way in distance.items()}


def shifted(fits: Mapping[str, ClockFit], shift_s: Mapping[str, float]) -> dict[str, ClockFit]:
    """The clocks with `shift_s` added to their starts."""
    return {camera: replace(fit, start_s=fit.start_s + shift_s[camera]) for camera, fit in fits.items()}

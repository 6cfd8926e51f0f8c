"""Clocks of free-running cameras from their sound: offset and rate against the reference (Supp., "Capture Setup").

Coarse: loudness envelopes of whole recordings are cross-correlated. Fine: GCC-PHAT (Knapp and Carter, 1976)
with a coherence weight, in windows along the recording, to a fraction of a sample. A line through the
windows' delays is the clock:

    t_reference = start_s + clock_rate * t_local.

How well a rate is known: a short recording cannot tell drift from a sound source that moved. Path differences between
microphones change by some centimetres when the loudest source changes: `PATH_SD_S` in seconds. Windows that spread over
`spread` seconds therefore know the rate no better than PATH_SD_S / spread, however small their scatter. So the slope
is shrunk towards zero drift by Bayes' rule for two Gaussians; the other is the prior of device clocks, `RATE_PRIOR_SD`.
6 s of sound give a rate near 1, ten minutes give the measured rate unchanged.

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
Status = Literal["ok", "silent", "clipped", "unrelated"]

RATE_PRIOR_SD = 50e-6  # the paper's cameras: -49 and -81 us/s for the worst two of seven
PATH_SD_S = 1e-4  # 3.4 cm of change in path difference
MAX_DRIFT = 200e-6  # ten times a poor quartz oscillator
SPEED_OF_SOUND = 343.0  # m/s in air at 20 degrees C

SILENT_PEAK = 1e-3  # -60 dB of full scale: below, a track holds nothing but its own noise
CLIPPED_LEVEL, CLIPPED_FRACTION = 0.98, 0.02  # more than a clap close to the microphone
MIN_CONFIDENCE = 2.0  # correlation peak over the next one; unrelated tracks stay below 1.5
_TOLERANCE_S = 4e-4  # windows this close to the common line support it


@dataclass(frozen=True)
class ClockFit:
    """A camera's clock against the reference's: t_reference = start_s + clock_rate * t_local (seconds).

    Attributes:
        start_s, clock_rate: NaN where `status` is not "ok": a doubtful track is never given an offset.
        confidence: correlation peak over the highest other peak.
        residual_rms_s: scatter of the windows about the line.
        windows: (local time, delay from the line) of each of the `n_windows`, seconds.
    """

    start_s: float
    clock_rate: float
    confidence: float
    residual_rms_s: float
    n_windows: int
    status: Status
    windows: tuple[tuple[float, float], ...] = ()

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
        "unrelated": "its audio does not match the reference camera's; check that both recorded the same sitting",
    }
    bad = [camera for camera, fit in fits.items() if fit.status != "ok"]
    # A silent or clipped reference makes all others look unrelated, so unrelated ones come last.
    for camera in sorted(bad, key=lambda name: fits[name].status == "unrelated"):
        fit = fits[camera]
        raise SplashbenchError(
            f"{files.get(camera, 'audio')} (camera {camera}) cannot be synchronised: {remedies[fit.status]}"
        )


def _flagged(status: Status, confidence: float = 0.0, n_windows: int = 0) -> ClockFit:
    nan = float("nan")
    return ClockFit(nan, nan, confidence, nan, n_windows, status)


def _fit_pair(x: Samples, y: Samples, rate: int, rate_prior_sd: float) -> ClockFit:
    """The clock of y against that of x, both counted from their first samples."""
    line = None
    best = 0.0
    if min(len(x), len(y)) < delay.MIN_OVERLAP_S * rate:
        return _flagged("unrelated")
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
        return _flagged("unrelated")
    overlap = len(y) / rate
    for _ in range(2):
        windows = delay.measure(x, y, rate, line, 2e-3, _window_seconds(overlap), block=4096)
        _, refined = _consensus(windows, line[0], rate_prior_sd, line[1])
        if refined is None:
            return _flagged("unrelated", 0.0, len(windows))
        line = refined
    confidence = delay.peak_ratio(x, y, rate, line)
    inliers, residuals = _inliers(windows, line)
    if confidence < MIN_CONFIDENCE or len(inliers) < 2:
        return _flagged("unrelated", confidence, len(inliers))
    rms = float(np.sqrt(np.mean(residuals**2)))
    scatter = tuple((window.time_s, float(residual)) for window, residual in zip(inliers, residuals))
    return ClockFit(line[0], line[1], confidence, rms, len(inliers), "ok", scatter)


def _window_seconds(overlap: float) -> float:
    """Long recordings take windows of 4 s, short ones an eighth of their length but not less than 0.5 s."""
    return float(np.clip(overlap / 8, 0.5, 4.0))


def _inliers(windows: Sequence[DelayWindow], line: tuple[float, float]) -> tuple[list[DelayWindow], Floats]:
    residuals = np.array([w.delay_s - line[0] - (line[1] - 1) * w.time_s for w in windows])
    near = np.abs(residuals) <= _TOLERANCE_S
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


def _fit_line(times: Floats, delays: Floats, weights: Floats, rate_prior_sd: float) -> tuple[float, float]:
    """(start, rate) by Tukey-weighted least squares, the slope shrunk towards zero drift (see the head of the file)."""
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
    error_variance = (sigma**2 * float((w**2).sum()) + PATH_SD_S**2) / variance if variance > 0 else np.inf
    slope *= rate_prior_sd**2 / (rate_prior_sd**2 + error_variance)
    return float(middle - slope * centre), float(1 + slope)


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

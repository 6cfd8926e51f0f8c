"""The sound of a recording on its local clock: resampling, joining chapters.

Sample times come from the files' timestamps, so an audio track that begins before or after the video stays in
its place, and the priming samples that an encoder puts in front (up to 23 ms) are dropped by the decoder as
the file declares them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import gcd
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.prepare.media.reading import sound
from splashbench.prepare.media.sound import JITTER_S, MAX_SECONDS

Samples = NDArray[np.float32]

# Of the whole numbers whose ratio two rates have: that of the rates that there are has 640 at the most.
_MAX_RATIO = 1000
# Codecs fill their last block up, AAC's of 1024 samples; an overlap shorter than that is no finding.
_PADDING_S = 0.024


@dataclass(frozen=True)
class Seam:
    """Where samples do not follow each other: `gap_s` > 0 was filled with silence, < 0 overlapped (the later won)."""

    time_s: float
    gap_s: float


@dataclass(frozen=True)
class AudioTrack:
    """Mono samples float32 [S] at `rate` Hz; the first one was taken at `start_s` on the local clock."""

    samples: Samples
    start_s: float
    rate: int
    seams: tuple[Seam, ...]


def join_audio(paths: Sequence[Path], shifts: Sequence[float], rate: int) -> AudioTrack:
    """Join the sound of chapters; `shifts` [chapters] takes each file's own time to the local clock, in seconds.

    Raises SplashbenchError when a chapter has no sound.
    """
    pieces = [
        (float(time + shift), native, samples)
        for path, shift in zip(paths, shifts)
        for time, native, samples in _sound(Path(path), rate)
    ]
    start = pieces[0][0]
    places = [max(0, round((time - start) * rate)) for time, _, _ in pieces]
    lengths = [-(-len(samples) * rate // native) for _, native, samples in pieces]
    total = max(at + length for at, length in zip(places, lengths))
    if total > MAX_SECONDS * rate:
        raise SplashbenchError(
            f"{paths[0]} and what follows it have {total / rate / 3600:.1f} hours of sound, more than"
            f" {MAX_SECONDS // 3600}; cut the recording to the pour, or copy it from the camera again"
        )
    joined = np.zeros(total, np.float32)
    seams = []
    end = 0
    for at, (_, native, samples) in zip(places, pieces):
        if at - end > JITTER_S * rate or end - at > _PADDING_S * rate:
            seams.append(Seam(time_s=start + min(at, end) / rate, gap_s=(at - end) / rate))
        # The later piece wins: what an earlier one has beyond its video is the encoder's padding.
        end = at + -(-len(samples) * rate // native)
        joined[at:end] = _resample(samples, native, rate)
    return AudioTrack(joined, start, rate, tuple(seams))


def _sound(path: Path, rate: int) -> list[tuple[float, int, Samples]]:
    """See `sound`. Raises SplashbenchError where its rate is none that sound has."""
    pieces = sound(path)
    native = pieces[0][1]
    if max(native, rate) > _MAX_RATIO * gcd(native, rate):
        raise SplashbenchError(
            f"{path} has {native} sound samples a second, which no camera has; copy it from the camera again"
        )
    return pieces


def _resample(samples: Samples, native: int, rate: int) -> Samples:
    """Band-limited change of sample rate without delay: [ceil(n * rate / native)]."""
    if native == rate:
        return samples
    from scipy.signal import resample_poly

    common = gcd(native, rate)
    return resample_poly(samples, rate // common, native // common).astype(np.float32, copy=False)

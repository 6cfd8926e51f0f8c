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
from splashbench.prepare.media.sound import JITTER_S

Samples = NDArray[np.float32]

#: Of all chapters together.
MAX_TRACK_S = 4 * 3600
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


def _resample(samples: Samples, native: int, rate: int) -> Samples:
    """Band-limited change of sample rate without delay."""
    if native == rate:
        return samples
    from scipy.signal import resample_poly

    common = gcd(native, rate)
    return resample_poly(samples, rate // common, native // common).astype(np.float32)


def join_audio(paths: Sequence[Path], shifts: Sequence[float], rate: int) -> AudioTrack:
    """Join the sound of chapters; `shifts` [chapters] takes each file's own time to the local clock, in seconds.

    Raises SplashbenchError when a chapter has no sound.
    """
    pieces = [
        (float(time + shift), _resample(samples, native, rate))
        for path, shift in zip(paths, shifts)
        for time, native, samples in sound(Path(path))
    ]
    start = pieces[0][0]
    places = [max(0, round((time - start) * rate)) for time, _ in pieces]
    length = max(at + len(samples) for at, (_, samples) in zip(places, pieces))
    if length > MAX_TRACK_S * rate:
        raise SplashbenchError(
            f"{paths[0]} and what follows it have {length / rate / 3600:.1f} hours of sound, more than"
            f" {MAX_TRACK_S // 3600}; cut the recording to the pour, or copy it from the camera again"
        )
    joined = np.zeros(length, np.float32)
    seams = []
    end = 0
    for at, (_, samples) in zip(places, pieces):
        if at - end > JITTER_S * rate or end - at > _PADDING_S * rate:
            seams.append(Seam(time_s=start + min(at, end) / rate, gap_s=(at - end) / rate))
        # The later piece wins: what an earlier one has beyond its video is the encoder's padding.
        joined[at : at + len(samples)] = samples
        end = at + len(samples)
    return AudioTrack(joined, start, rate, tuple(seams))

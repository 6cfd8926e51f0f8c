"""The sound of a recording on its local clock: decoding, mixing to mono, resampling, joining chapters.

Sample times come from the files' timestamps, so an audio track that begins before or after the video stays in
its place, and the priming samples that an encoder puts in front (up to 23 ms) are dropped by the decoder as
the file declares them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from math import gcd
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError

Samples = NDArray[np.float32]

# Timestamps of some containers are whole milliseconds; below this, samples are taken to follow each other.
_JITTER_S = 0.003
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


def decode_audio(
    path: Path, rate: int, open_media: Callable[[Path], AbstractContextManager[Any]]
) -> list[tuple[float, Samples]]:
    """Decode a file's first audio track: contiguous pieces of (first sample in the file's own time, mono samples)."""
    pieces: list[tuple[float, list[Samples]]] = []
    native = 0
    end = 0.0
    with open_media(path) as container:
        if not container.streams.audio:
            raise SplashbenchError(
                f"{path} has no audio track, and cameras are synchronised by sound; record with the microphone on, "
                "or copy the file from the camera again if it was"
            )
        for frame in container.decode(container.streams.audio[0]):
            native = native or int(frame.sample_rate)
            if frame.sample_rate != native:
                raise SplashbenchError(f"{path} changes its audio sample rate midway; copy it from the camera again")
            time = end if frame.pts is None else float(frame.pts * frame.time_base)
            if not pieces or abs(time - end) > _JITTER_S:
                pieces.append((time, []))
                end = time
            pieces[-1][1].append(_mono(frame))
            end += frame.samples / native
    if not pieces:
        raise SplashbenchError(f"{path} has an audio track without a single sample; copy it from the camera again")
    joined = [(time, np.concatenate(blocks)) for time, blocks in pieces]
    if not all(np.isfinite(samples).all() for _, samples in joined):
        raise SplashbenchError(f"{path} has sound samples that are no numbers; copy it from the camera again")
    return [(time, _resample(samples, native, rate)) for time, samples in joined]


def _mono(frame: Any) -> Samples:
    """The mean of a frame's channels, scaled to [-1, 1]."""
    data = frame.to_ndarray()
    scale = 1.0 if data.dtype.kind == "f" else 1.0 / float(np.iinfo(data.dtype).max + 1)
    if data.dtype == np.uint8:  # unsigned samples rest at 128
        data, scale = data.astype(np.int16) - 128, 1.0 / 128.0
    if not frame.format.is_planar:
        data = data.reshape(-1, frame.layout.nb_channels).T
    return (data.astype(np.float32) * np.float32(scale)).mean(axis=0, dtype=np.float32)


def _resample(samples: Samples, native: int, rate: int) -> Samples:
    """Band-limited change of sample rate without delay."""
    if native == rate:
        return samples
    from scipy.signal import resample_poly

    common = gcd(native, rate)
    return resample_poly(samples, rate // common, native // common).astype(np.float32)


def join_audio(
    paths: Sequence[Path],
    shifts: Sequence[float],
    rate: int,
    open_media: Callable[[Path], AbstractContextManager[Any]],
) -> AudioTrack:
    """Join the sound of chapters; `shifts` [chapters] takes each file's own time to the local clock, in seconds.

    Raises SplashbenchError when a chapter has no sound.
    """
    pieces = [
        (float(time + shift), samples)
        for path, shift in zip(paths, shifts)
        for time, samples in decode_audio(Path(path), rate, open_media)
    ]
    start = pieces[0][0]
    places = [max(0, round((time - start) * rate)) for time, _ in pieces]
    joined = np.zeros(max(at + len(samples) for at, (_, samples) in zip(places, pieces)), np.float32)
    seams = []
    end = 0
    for at, (_, samples) in zip(places, pieces):
        if at - end > _JITTER_S * rate or end - at > _PADDING_S * rate:
            seams.append(Seam(time_s=start + min(at, end) / rate, gap_s=(at - end) / rate))
        # The later piece wins: what an earlier one has beyond its video is the encoder's padding.
        joined[at : at + len(samples)] = samples
        end = at + len(samples)
    return AudioTrack(joined, start, rate, tuple(seams))

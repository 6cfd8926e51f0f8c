"""The samples of a file's first sound track, at the rate that it has, mixed to mono.

Everything here runs in the child process (worker.py).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError

from .container import COPY_AGAIN, limit_threads, open_media, packets

Samples = NDArray[np.float32]

#: Of one recording, seconds; of one file, pieces that do not follow each other, and what samples a second lie between.
MAX_SECONDS, MAX_PIECES, MIN_RATE, MAX_RATE = 2 * 3600, 1000, 1000, 384_000
# Timestamps of some containers are whole milliseconds; below this, samples are taken to follow each other.
JITTER_S = 0.003
# Samples that are handed over at once.
_BLOCK = 1 << 18


def pieces(path: Path, tick: Callable[[], None]) -> Iterator[tuple[float | None, int, Samples]]:
    """Yield blocks of samples: (time of the first one in the file's own time, samples a second, samples).

    The time is None where a block follows the one before it. tick: is called with every packet. Raises
    SplashbenchError without a sound track.
    """
    native = count = n_pieces = 0
    end = 0.0
    begins: float | None = None
    blocks: list[Samples] = []
    with open_media(path) as container:
        if not container.streams.audio:
            raise SplashbenchError(
                f"{path} has no audio track, and cameras are synchronised by sound; record with the microphone on, "
                "or copy the file from the camera again if it was"
            )
        stream = container.streams.audio[0]
        limit_threads(stream)
        read = packets(container, stream, path, tick)
        for frame in (frame for packet in read for frame in packet.decode()):
            native = native or int(frame.sample_rate)
            if frame.sample_rate != native:
                raise SplashbenchError(f"{path} changes its audio sample rate midway; {COPY_AGAIN}")
            if not MIN_RATE <= native <= MAX_RATE:
                raise SplashbenchError(f"{path} has {native} sound samples a second, which no camera has; {COPY_AGAIN}")
            count += frame.samples
            if count > MAX_SECONDS * native:
                raise SplashbenchError(f"{path} has more than {MAX_SECONDS // 3600} hours of sound; cut it to the pour")
            time = end if frame.pts is None else float(frame.pts * frame.time_base)
            is_apart = not count - frame.samples or abs(time - end) > JITTER_S
            if blocks and (is_apart or sum(map(len, blocks)) >= _BLOCK):
                yield begins, native, _joined(path, blocks)
                begins, blocks = None, []
            if is_apart:
                begins = end = time
                n_pieces += 1
                if n_pieces > MAX_PIECES:
                    raise SplashbenchError(f"{path} has sound in more than {MAX_PIECES} pieces; {COPY_AGAIN}")
            blocks.append(_mono(frame))
            end += frame.samples / native
        if blocks:
            yield begins, native, _joined(path, blocks)


def _joined(path: Path, blocks: list[Samples]) -> Samples:
    samples = np.concatenate(blocks)
    if not np.isfinite(samples).all():
        raise SplashbenchError(f"{path} has sound samples that are no numbers; {COPY_AGAIN}")
    return samples


def _mono(frame: Any) -> Samples:
    """The mean of a frame's channels, scaled to [-1, 1]."""
    data = frame.to_ndarray()
    scale = 1.0 if data.dtype.kind == "f" else 1.0 / float(np.iinfo(data.dtype).max + 1)
    if data.dtype == np.uint8:  # unsigned samples rest at 128
        data, scale = data.astype(np.int16) - 128, 1.0 / 128.0
    if not frame.format.is_planar:
        data = data.reshape(-1, frame.layout.nb_channels).T
    return (data.astype(np.float32) * np.float32(scale)).mean(axis=0, dtype=np.float32)

"""Frames of a video file by number, bit for bit as a decode from the beginning gives them.

Everything here runs in the child process (worker.py).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError

from .container import COPY_AGAIN, Chapter, open_media, packets, require_sane, version_of, video_stream


def whole(chapter: Chapter, wanted: Sequence[int], tick: Callable[[], None]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield (index, sRGB uint8 [H, W, 3]) of the frames `wanted`, which increase. tick: is called with every packet.

    Raises SplashbenchError when one cannot be decoded.
    """
    chosen = iter(wanted)
    expected = next(chosen)
    for k, frame in _decode(chapter, wanted[0], wanted[-1], tick):
        if k != expected:
            continue
        if frame.is_corrupt:
            break
        yield k, _upright(frame.to_ndarray(format="rgb24"), frame.rotation)
        following = next(chosen, None)
        if following is None:
            return
        expected = following
    raise SplashbenchError(f"{chapter.path}: frame {expected} cannot be decoded; {COPY_AGAIN}")


def luma(
    chapter: Chapter, width: int, first: int, last: int, keyframes: bool, tick: Callable[[], None]
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield (index, luma uint8 [h, width]) of the frames first..last that decode, shrunk by area."""
    for k, frame in _decode(chapter, first, last, tick, keyframes):
        height = max(1, round(frame.height * width / frame.width))
        small = frame.reformat(width=width, height=height, format="gray", interpolation="AREA")
        yield k, _upright(small.to_ndarray(), frame.rotation)


def _decode(
    chapter: Chapter, first: int, last: int, tick: Callable[[], None], keyframes: bool = False
) -> Iterator[tuple[int, Any]]:
    """Yield (index, PyAV frame) for the frames first..last of one file, in order, matched by timestamp."""
    with open_media(chapter.path) as container:
        if version_of(chapter.path) != chapter.version:
            raise SplashbenchError(f"{chapter.path} was changed while it was read; run the command again")
        stream = video_stream(container, chapter.path)
        stream.thread_type = "AUTO"
        if keyframes:
            stream.codec_context.skip_frame = "NONKEY"
        before = chapter.entries[chapter.entries <= first]
        if len(before) and before[-1] > 0:
            _enter_at(container, stream, int(chapter.pts[before[-1]]))
        read = packets(container, stream, chapter.path, tick)
        size = None
        for frame in (frame for packet in read for frame in packet.decode()):
            require_sane(chapter.path, frame)
            size = size or (frame.width, frame.height)
            if (frame.width, frame.height) != size:
                raise SplashbenchError(
                    f"{chapter.path} changes from {size[0]}x{size[1]} to {frame.width}x{frame.height} midway;"
                    " give the camera's own file"
                )
            k = int(np.searchsorted(chapter.pts, frame.pts)) if frame.pts is not None else len(chapter.pts)
            if k >= len(chapter.pts) or chapter.pts[k] != frame.pts or k < first:
                continue
            if k > last:
                break
            yield k, frame
            if k == last:
                break


def _enter_at(container: Any, stream: Any, pts: int) -> None:
    """Seek to the packet with exactly this timestamp or an earlier key packet, or back to the beginning."""
    container.seek(pts, stream=stream)
    landed = next((packet.pts for packet in container.demux(stream) if packet.size), None)
    # Seeking goes by decoding time: among short groups of pictures it can land on the next one, past the
    # wanted frame.
    target = pts if landed is not None and landed <= pts else int(stream.start_time or 0)
    container.seek(target, stream=stream)


def _upright(image: NDArray[np.uint8], rotation: int) -> NDArray[np.uint8]:
    """Apply a file's rotation tag (degrees, counter-clockwise), as every player does."""
    return image if rotation % 360 == 0 else np.ascontiguousarray(np.rot90(image, round(rotation / 90)))

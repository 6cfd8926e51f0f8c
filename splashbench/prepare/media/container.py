"""What a media file states of itself: headers, and the packets of its video track.

Everything here runs in the child process (worker.py), since FFmpeg's readers of strangers' files have no limits.
Pitfalls of timestamps are those of GoPro files (MP4, H.264 or HEVC, with B-frames and open groups).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# PyAV, not imageio: that numbers frames, but tells neither their timestamps nor where chapters and key frames begin,
# and reads no sound. Clocks and exact seeking need all of these.
import av
import numpy as np
from av.stream import Disposition
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import MAX_PIXELS, require_plain_file

#: Of one file: frames (two hours of 240 a second), hours between the first and the last; how many times as wide as high
#: a frame may be, or as high as wide.
MAX_FRAMES, MAX_HOURS, MAX_ASPECT = 2_000_000, 24, 32
COPY_AGAIN = "copy it from the camera again"
# Containers worth reading. The list keeps a stranger's "video" from being a playlist that opens other files.
_FORMATS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mp3,wav,ogg,flac"
_MISSING_FRAMES_TOLERATED = 2  # cameras sometimes promise one or two frames more than they write
# Of the bytes of all packets together, in those of the file: some containers leave out what packets have in common.
_MAX_UNPACKED = 8
_MAX_THREADS = 9
_MAX_LABEL = 100


@dataclass(frozen=True)
class VideoInfo:
    """What a video file states of itself.

    Attributes:
        width, height: as shown, after the file's rotation tag.
        n_frames: as the container promises; counted, for a `Recording`.
        duration, start_time: of the video stream, seconds.
        audio_minus_video_s: how much longer the audio stream is than the video stream; None without audio.
        timecode, created: of the first frame (hours, minutes, seconds, frames) and of the file (ISO 8601), where given.
    """

    width: int
    height: int
    fps: float
    n_frames: int
    duration: float
    start_time: float
    has_audio: bool
    codec: str
    timecode: str | None
    audio_minus_video_s: float | None
    created: str | None = None


@dataclass(frozen=True)
class Chapter:
    """One file's frames in order of presentation: pts [N] in units of `time_base`, and where decoding may begin."""

    path: Path
    pts: NDArray[np.int64]
    time_base: float
    duration: float  # seconds from the first frame to the end of the last
    entries: NDArray[np.int64]  # indices of frames from which on decoding does not depend on anything earlier
    version: str  # of the file, which may be exchanged for another one


@contextmanager
def open_media(path: Path) -> Iterator[Any]:
    """An open PyAV container; whatever FFmpeg has against the file becomes one line that names it."""
    require_plain_file(path)  # FFmpeg would wait for a pipe without end
    try:
        # "file:" keeps a name with a colon in it from being taken for a network address.
        with av.open(f"file:{path}", options={"format_whitelist": _FORMATS}) as container:
            yield container
    except FileNotFoundError:
        raise SplashbenchError(f"{path} does not exist; check the path") from None
    except MemoryError:
        raise
    except (av.FFmpegError, OSError) as error:
        raise SplashbenchError(damaged(path, getattr(error, "strerror", None) or str(error))) from None


def damaged(path: Path, reason: str) -> str:
    """The line for a file that cannot be read for `reason`."""
    return f"{path} is damaged, cut short or no video ({reason}); {COPY_AGAIN}"


def version_of(path: Path) -> str:
    """Tells a file from the one that is there after it was exchanged or written on."""
    facts = path.stat()
    return f"{facts.st_ino} {facts.st_size} {facts.st_mtime_ns}"


def video_stream(container: Any, path: Path) -> Any:
    """The first video track; a cover is none. Raises SplashbenchError where there is none."""
    films = (stream for stream in container.streams.video if not stream.disposition & Disposition.attached_pic)
    stream = next(films, None)
    if stream is None:
        raise SplashbenchError(f"{path} has no video track; give the camera's own file")
    limit_threads(stream)
    return stream


def limit_threads(stream: Any) -> None:
    """Let FFmpeg decode with one thread more than there are processors, as it does by itself, but with few on many.

    Each takes address space, which is limited.
    """
    stream.codec_context.thread_count = min((os.cpu_count() or 1) + 1, _MAX_THREADS)


def packets(container: Any, stream: Any, path: Path, tick: Callable[[], None]) -> Iterator[Any]:
    """The packets of `stream`. Raises SplashbenchError where they have more bytes than the file.

    A table of a few bytes can list one part of a file a million times.
    """
    left = _MAX_UNPACKED * path.stat().st_size
    for packet in container.demux(stream):
        tick()
        left -= packet.size
        if left < 0:
            raise SplashbenchError(f"{path} lists more bytes than it has; {COPY_AGAIN}")
        yield packet


def require_sane(path: Path, frame: Any) -> None:
    """Raise SplashbenchError where a frame is as no camera's."""
    sides = frame.width, frame.height
    if frame.width * frame.height > MAX_PIXELS or max(sides) > MAX_ASPECT * min(sides):
        raise SplashbenchError(
            f"{path} has frames of {frame.width}x{frame.height}: more than {MAX_PIXELS} pixels, or a side {MAX_ASPECT}"
            " times the other; give the camera's own file"
        )
    if frame.rotation % 90:
        raise SplashbenchError(f"{path} is to be shown turned by {frame.rotation} degrees; give the camera's own file")


def probe(path: Path) -> VideoInfo:
    """Read a file's headers and its first frame. Raises SplashbenchError when it is unreadable or holds no video."""
    with open_media(path) as container:
        stream = video_stream(container, path)
        fps = stream.average_rate or stream.guessed_rate
        if not fps:
            raise SplashbenchError(f"{path} does not tell its frame rate; {COPY_AGAIN}")
        base = stream.time_base
        duration = float(stream.duration * base) if stream.duration else float((container.duration or 0) / 1e6)
        audio = container.streams.audio[0] if container.streams.audio else None
        longer = float(audio.duration * audio.time_base) - duration if audio and audio.duration else None
        timecode = stream.metadata.get("timecode") or container.metadata.get("timecode")
        created = container.metadata.get("creation_time") or stream.metadata.get("creation_time")
        frame = next(container.decode(stream), None)
        if frame is None:
            raise SplashbenchError(f"{path} holds no frame that can be decoded; {COPY_AGAIN}")
        require_sane(path, frame)
        size = (frame.width, frame.height)
        width, height = size if frame.rotation % 180 == 0 else size[::-1]
        return VideoInfo(
            width=width,
            height=height,
            fps=float(fps),
            n_frames=stream.frames or round(duration * float(fps)),
            duration=duration,
            start_time=float((stream.start_time or 0) * base),
            has_audio=audio is not None,
            codec=stream.codec_context.name,
            timecode=_label(timecode),
            audio_minus_video_s=longer,
            created=_label(created),
        )


def _label(text: str | None) -> str | None:
    """A short printable text; None for any other, which says nothing."""
    return text if text and text.isprintable() and len(text) <= _MAX_LABEL else None


def scan(path: Path, tick: Callable[[], None]) -> Chapter:
    """Read the packets of a file without decoding them; complains when fewer are there than promised.

    tick: is called with every packet.
    """
    pts: list[int] = []
    entries: list[int] = []
    last_duration = discarded = 0
    with open_media(path) as container:
        version = version_of(path)
        stream = video_stream(container, path)
        seconds_per_tick = float(stream.time_base)
        rate = float(stream.average_rate or 0)
        promised = stream.frames or (round(stream.duration * seconds_per_tick * rate) if stream.duration else 0)
        for number, packet in enumerate(packets(container, stream, path, tick)):
            if number > MAX_FRAMES:
                raise SplashbenchError(f"{path} has more than {MAX_FRAMES} frames; split the recording")
            if packet.size == 0 or packet.is_corrupt:
                continue
            if packet.pts is None:
                raise SplashbenchError(f"{path} has frames without timestamps; {COPY_AGAIN}")
            if packet.is_discard:  # cut away by the file's edit list
                discarded += 1
                continue
            if not pts or packet.pts > max(pts[-64:]):
                last_duration = packet.duration or 0
            pts.append(packet.pts)
            if packet.is_keyframe and _is_clean_entry(bytes(packet), stream.codec_context):
                entries.append(packet.pts)
    n_read = len(pts) + discarded
    if n_read < promised - _MISSING_FRAMES_TOLERATED or not pts:
        raise SplashbenchError(f"{path} is cut short: {n_read} frames of the {promised} promised; {COPY_AGAIN}")
    if (max(pts) - min(pts) + abs(last_duration)) * seconds_per_tick > 3600 * MAX_HOURS:
        raise SplashbenchError(f"{path} has timestamps more than {MAX_HOURS} hours apart; {COPY_AGAIN}")
    ordered = np.sort(np.asarray(pts, np.int64))
    gaps = np.diff(ordered)
    if (gaps == 0).any():
        raise SplashbenchError(f"{path} has two frames with the same timestamp; {COPY_AGAIN}")
    tail = last_duration or (int(np.median(gaps)) if len(gaps) else 0)
    duration = float(ordered[-1] - ordered[0] + tail) * seconds_per_tick
    return Chapter(
        path,
        ordered,
        seconds_per_tick,
        duration,
        np.searchsorted(ordered, np.sort(np.asarray(entries, np.int64))),
        version,
    )


def _is_clean_entry(data: bytes, codec: Any) -> bool:
    """Whether a key packet lets every frame shown at or after it be decoded exactly without anything before it.

    True for H.264 IDR pictures (ISO/IEC 14496-10, 7.4.1.2.4) and for HEVC pictures of the IRAP kinds (ISO/IEC
    23008-2, 3.72: pictures that follow one in output order may not refer to pictures before it). A mere
    recovery point promises less.
    """
    header: bytes = codec.extradata or b""
    if codec.name not in ("h264", "hevc") or len(header) < 23 or header[0] != 1:
        return False
    hevc = codec.name == "hevc"
    prefix = (header[21 if hevc else 4] & 3) + 1
    at = 0
    while at + prefix < len(data):
        length = int.from_bytes(data[at : at + prefix], "big")
        unit = data[at + prefix]
        kind = (unit >> 1) & 0x3F if hevc else unit & 0x1F
        if (hevc and kind < 32) or (not hevc and 1 <= kind <= 5):  # the first unit that carries picture data
            return 16 <= kind <= 21 if hevc else kind == 5
        at += prefix + length
    return False

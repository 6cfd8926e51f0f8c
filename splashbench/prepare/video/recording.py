"""Reading recordings exactly: which frame is which, and when it was taken.

A recording is one or more chapter files of one camera. Its local clock runs over all of them from 0 at the
first video frame, by the presentation timestamps of the files, never by counting at a nominal rate. Paper
Sec. 3, "Capture and calibration"; pitfalls of timestamps, chapters and seeking are those of GoPro files (MP4,
H.264 or HEVC, with B-frames and open groups).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

# PyAV, not imageio: that numbers frames, but tells neither their timestamps nor where chapters and key frames begin,
# and reads no sound. Clocks and exact seeking need all of these.
import av
import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import require_plain_file
from splashbench.prepare.audio.waveform import AudioTrack, join_audio
from splashbench.prepare.video.chapters import check_chapters

Floats = NDArray[np.float64]

# Containers worth reading. The list keeps a stranger's "video" from being a playlist that opens other files.
_FORMATS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mp3,wav,ogg,flac"
_MISSING_FRAMES_TOLERATED = 2  # cameras sometimes promise one or two frames more than they write
_WORTH_SEEKING_FRAMES = 60  # decoding this many frames in passing is cheaper than opening the file again
_COPY_AGAIN = "copy it from the camera again"


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
    except (av.FFmpegError, OSError) as error:
        reason = getattr(error, "strerror", None) or error
        raise SplashbenchError(f"{path} is damaged, cut short or no video ({reason}); {_COPY_AGAIN}") from None


def _video_stream(container: Any, path: Path) -> Any:
    if not container.streams.video:
        raise SplashbenchError(f"{path} has no video track; give the camera's own file")
    return container.streams.video[0]


def probe(path: Path) -> VideoInfo:
    """Read a file's headers and its first frame. Raises SplashbenchError when it is unreadable or holds no video."""
    path = Path(path)
    with open_media(path) as container:
        stream = _video_stream(container, path)
        fps = stream.average_rate or stream.guessed_rate
        if not fps:
            raise SplashbenchError(f"{path} does not tell its frame rate; {_COPY_AGAIN}")
        base = stream.time_base
        duration = float(stream.duration * base) if stream.duration else float((container.duration or 0) / 1e6)
        audio = container.streams.audio[0] if container.streams.audio else None
        longer = float(audio.duration * audio.time_base) - duration if audio and audio.duration else None
        timecode = stream.metadata.get("timecode") or container.metadata.get("timecode")
        frame = next(container.decode(stream), None)
        if frame is None:
            raise SplashbenchError(f"{path} holds no frame that can be decoded; {_COPY_AGAIN}")
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
            timecode=timecode,
            audio_minus_video_s=longer,
            created=container.metadata.get("creation_time") or stream.metadata.get("creation_time"),
        )


@dataclass(frozen=True)
class _Chapter:
    """One file's frames in order of presentation: pts [N] in units of `time_base`, and where decoding may begin."""

    path: Path
    pts: NDArray[np.int64]
    time_base: float
    duration: float  # seconds from the first frame to the end of the last
    entries: NDArray[np.int64]  # indices of frames from which on decoding does not depend on anything earlier


def _scan(path: Path) -> _Chapter:
    """Read the packets of a file without decoding them; complains when fewer are there than promised."""
    pts: list[int] = []
    entries: list[int] = []
    last_duration = discarded = 0
    with open_media(path) as container:
        stream = _video_stream(container, path)
        seconds_per_tick = float(stream.time_base)
        rate = float(stream.average_rate or 0)
        promised = stream.frames or (round(stream.duration * seconds_per_tick * rate) if stream.duration else 0)
        for packet in container.demux(stream):
            if packet.size == 0 or packet.is_corrupt:
                continue
            if packet.pts is None:
                raise SplashbenchError(f"{path} has frames without timestamps; {_COPY_AGAIN}")
            if packet.is_discard:  # cut away by the file's edit list
                discarded += 1
                continue
            if not pts or packet.pts > max(pts[-64:]):
                last_duration = packet.duration or 0
            pts.append(packet.pts)
            if packet.is_keyframe and _is_clean_entry(bytes(packet), stream.codec_context):
                entries.append(packet.pts)
    ordered = np.sort(np.asarray(pts, np.int64))
    n_read = len(ordered) + discarded
    if n_read < promised - _MISSING_FRAMES_TOLERATED or not len(ordered):
        raise SplashbenchError(f"{path} is cut short: {n_read} frames of the {promised} promised; {_COPY_AGAIN}")
    gaps = np.diff(ordered)
    if (gaps == 0).any():
        raise SplashbenchError(f"{path} has two frames with the same timestamp; {_COPY_AGAIN}")
    tail = last_duration or (int(np.median(gaps)) if len(gaps) else 0)
    duration = float(ordered[-1] - ordered[0] + tail) * seconds_per_tick
    return _Chapter(
        path, ordered, seconds_per_tick, duration, np.searchsorted(ordered, np.sort(np.asarray(entries, np.int64)))
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


class Recording:
    """One camera's recording over all its chapters, on its local clock (0 s at the first video frame)."""

    def __init__(self, paths: Iterable[Path]) -> None:
        self.paths = tuple(Path(path) for path in paths)
        if not self.paths:
            raise ValueError("a recording needs at least one file")
        self._audio: dict[int, AudioTrack] = {}

    @cached_property
    def _chapters(self) -> tuple[_Chapter, ...]:
        return tuple(_scan(path) for path in self.paths)

    @cached_property
    def _first_indices(self) -> NDArray[np.int64]:
        """Index of every chapter's first frame, and the number of all frames behind them: [chapters + 1]."""
        return np.concatenate([[0], np.cumsum([len(chapter.pts) for chapter in self._chapters])])

    @cached_property
    def _offsets(self) -> Floats:
        """Local time at which each chapter begins: the duration of the video before it."""
        return np.concatenate([[0.0], np.cumsum([chapter.duration for chapter in self._chapters])])

    @cached_property
    def headers(self) -> tuple[VideoInfo, ...]:
        """What the headers of its chapters say.

        Raises SplashbenchError where a file cannot be read, or does not follow the one before it.
        """
        headers = tuple(probe(path) for path in self.paths)
        check_chapters(self.paths, headers)
        return headers

    @cached_property
    def info(self) -> VideoInfo:
        """Facts of the whole recording; frames are counted. Raises SplashbenchError when chapters do not match."""
        chapters = self.headers
        for path, chapter in zip(self.paths, chapters):
            if (chapter.width, chapter.height, chapter.codec) != (
                chapters[0].width,
                chapters[0].height,
                chapters[0].codec,
            ):
                raise SplashbenchError(
                    f"{path} differs in size or codec from {self.paths[0]}; list chapters of one recording only"
                )
        audio_excess = [chapter.audio_minus_video_s for chapter in chapters if chapter.audio_minus_video_s is not None]
        return replace(
            chapters[0],
            n_frames=int(self._first_indices[-1]),
            duration=float(self._offsets[-1]),
            has_audio=all(chapter.has_audio for chapter in chapters),
            audio_minus_video_s=float(sum(audio_excess)) if len(audio_excess) == len(chapters) else None,
        )

    @cached_property
    def frame_times(self) -> Floats:
        """Local time of every frame: [N] seconds, increasing, 0 first."""
        return np.concatenate(
            [
                offset + (chapter.pts - chapter.pts[0]) * chapter.time_base
                for offset, chapter in zip(self._offsets, self._chapters)
            ]
        )

    def frames(self, indices: Iterable[int] | None = None) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield (index, sRGB uint8 [H, W, 3]) in increasing order: all frames, or those of `indices`, each once.

        Frames equal those of a decode from the beginning, bit for bit: the decoder only ever starts at
        pictures that the coding standards make independent of the past. Raises SplashbenchError when a frame
        cannot be decoded.
        """
        total = int(self._first_indices[-1])
        indices_wanted = np.arange(total) if indices is None else np.unique(np.fromiter(indices, np.int64))
        if len(indices_wanted) and not 0 <= indices_wanted[0] <= indices_wanted[-1] < total:
            raise ValueError(f"frame indices must lie in 0..{total - 1}")
        for number, chapter in enumerate(self._chapters):
            first, stop = self._first_indices[number : number + 2]
            local = indices_wanted[(indices_wanted >= first) & (indices_wanted < stop)] - first
            for run in _runs(local, chapter.entries):
                chosen = iter(run)
                expected = next(chosen)
                for k, frame in _decode(chapter, int(run[0]), int(run[-1])):
                    if k != expected:
                        continue
                    if frame.is_corrupt:
                        break
                    yield int(first + k), _upright(frame.to_ndarray(format="rgb24"), frame.rotation)
                    expected = next(chosen, None)
                if expected is not None:
                    raise SplashbenchError(f"{chapter.path}: frame {expected} cannot be decoded; {_COPY_AGAIN}")

    def luma(
        self, width: int, first: int = 0, last: int | None = None, keyframes: bool = False
    ) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield (index, luma uint8 [h, width]) of frames first..last, shrunk by area and without colour conversion.

        `keyframes` decodes key frames alone, which costs a small part of the whole. Frames that do not decode
        are left out.
        """
        last = int(self._first_indices[-1]) - 1 if last is None else last
        for number, chapter in enumerate(self._chapters):
            start, stop = (int(index) for index in self._first_indices[number : number + 2])
            if last < start or first >= stop:
                continue
            for k, frame in _decode(chapter, max(first - start, 0), min(last, stop - 1) - start, keyframes):
                height = max(1, round(frame.height * width / frame.width))
                small = frame.reformat(width=width, height=height, format="gray", interpolation="AREA")
                yield start + k, _upright(small.to_ndarray(), frame.rotation)

    def audio(self, rate: int = 48000) -> tuple[NDArray[np.float32], float]:
        """Mono sound of the recording: (float32 [S] in [-1, 1], local time of its first sample in seconds).

        Gaps between chapters are silent, and listed by `audio_track(rate).seams`. Raises SplashbenchError
        without sound.
        """
        track = self.audio_track(rate)
        return track.samples, track.start_s

    def audio_track(self, rate: int = 48000) -> AudioTrack:
        """The sound with the seams between its chapters."""
        if rate not in self._audio:
            shifts = [
                offset - chapter.pts[0] * chapter.time_base for offset, chapter in zip(self._offsets, self._chapters)
            ]
            self._audio[rate] = join_audio(self.paths, shifts, rate, open_media)
        return self._audio[rate]


def _runs(indices: NDArray[np.int64], entries: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Split frame indices where starting the decoder anew saves work."""
    if not len(indices):
        return []
    entry_of = entries[np.searchsorted(entries, indices, side="right") - 1] if len(entries) else np.zeros_like(indices)
    saved = entry_of[1:] - indices[:-1]
    return np.split(indices, np.flatnonzero(saved > _WORTH_SEEKING_FRAMES) + 1)


def _decode(chapter: _Chapter, first: int, last: int, keyframes: bool = False) -> Iterator[tuple[int, Any]]:
    """Yield (index, PyAV frame) for the frames first..last of one file, in order, matched by timestamp."""
    with open_media(chapter.path) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        if keyframes:
            stream.codec_context.skip_frame = "NONKEY"
        before = chapter.entries[chapter.entries <= first]
        if len(before) and before[-1] > 0:
            _enter_at(container, stream, int(chapter.pts[before[-1]]))
        for frame in container.decode(stream):
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

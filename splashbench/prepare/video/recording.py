"""Reading recordings exactly: which frame is which, and when it was taken.

A recording is one or more chapter files of one camera. Its local clock runs over all of them from 0 at the
first video frame, by the presentation timestamps of the files, never by counting at a nominal rate. Paper
Sec. 3, "Capture and calibration". Files are decoded in a process of its own (media/).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.prepare.audio.waveform import AudioTrack, join_audio
from splashbench.prepare.media import reading
from splashbench.prepare.media.container import Chapter, VideoInfo
from splashbench.prepare.video.chapters import check_chapters

Floats = NDArray[np.float64]

_WORTH_SEEKING_FRAMES = 60  # decoding this many frames in passing is cheaper than opening the file again


class Recording:
    """One camera's recording over all its chapters, on its local clock (0 s at the first video frame)."""

    def __init__(self, paths: Iterable[Path]) -> None:
        self.paths = tuple(Path(path) for path in paths)
        if not self.paths:
            raise ValueError("a recording needs at least one file")
        self._audio: dict[int, AudioTrack] = {}

    @cached_property
    def _chapters(self) -> tuple[Chapter, ...]:
        return tuple(reading.scan(path) for path in self.paths)

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
        headers = tuple(reading.probe(path) for path in self.paths)
        check_chapters(self.paths, headers)
        return headers

    @cached_property
    def info(self) -> VideoInfo:
        """Facts of the whole recording; frames are counted. Raises SplashbenchError when chapters do not match."""
        self.require_one_size()
        chapters = self.headers
        audio_excess = [chapter.audio_minus_video_s for chapter in chapters if chapter.audio_minus_video_s is not None]
        return replace(
            chapters[0],
            n_frames=int(self._first_indices[-1]),
            duration=float(self._offsets[-1]),
            has_audio=all(chapter.has_audio for chapter in chapters),
            audio_minus_video_s=float(sum(audio_excess)) if len(audio_excess) == len(chapters) else None,
        )

    def require_one_size(self) -> None:
        """Raise SplashbenchError where chapters differ in size or codec, or cannot be read; headers alone are."""
        first = self.headers[0]
        for path, chapter in zip(self.paths, self.headers):
            if (chapter.width, chapter.height, chapter.codec) != (first.width, first.height, first.codec):
                raise SplashbenchError(
                    f"{path} differs in size or codec from {self.paths[0]}; list chapters of one recording only"
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
                for k, image in reading.frames(chapter, run):
                    yield int(first + k), image

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
            within = max(first - start, 0), min(last, stop - 1) - start
            for k, image in reading.luma(chapter, width, *within, keyframes):
                yield start + k, image

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
            self._audio[rate] = join_audio(self.paths, shifts, rate)
        return self._audio[rate]

    def forget_sound(self) -> None:
        """Hold no sound any more, of which half an hour takes 350 MB; what is asked for is read again."""
        self._audio.clear()


def _runs(indices: NDArray[np.int64], entries: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Split frame indices where starting the decoder anew saves work."""
    if not len(indices):
        return []
    entry_of = entries[np.searchsorted(entries, indices, side="right") - 1] if len(entries) else np.zeros_like(indices)
    saved = entry_of[1:] - indices[:-1]
    return np.split(indices, np.flatnonzero(saved > _WORTH_SEEKING_FRAMES) + 1)

"""Recordings as an action camera writes them: MP4 with H.264 video, AAC audio, a creation time and a timecode track."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.synth.recording.audio import SAMPLE_RATE

GROUP_OF_PICTURES = 30
QUALITY = 16  # x264's constant rate factor
AUDIO_BITS_PER_SECOND = 192_000
_NOISE_MARGIN = 64


class SensorNoise:
    """Mild sensor noise, a little stronger in the dark, that a seed determines.

    One tile is drawn, and every frame takes its own cut-out of it: far cheaper than fresh noise, and as white over
    time.
    """

    def __init__(self, width: int, height: int, seed: tuple[int, ...], level: float = 1.3) -> None:
        self._rng = np.random.default_rng(list(seed))
        self._size = (height, width)
        shape = (height + _NOISE_MARGIN, width + _NOISE_MARGIN, 3)
        self._tile = (level * self._rng.standard_normal(shape)).astype(np.float32)
        self._corners: list[tuple[int, int]] = []
        self._next = 0

    def expose(self, image: NDArray[np.float32], frame: int | None = None) -> NDArray[np.uint8]:
        """An sRGB image [H, W, 3] in [0, 1] as a noisy 8-bit frame. `frame`: its number; by default the next one."""
        frame = self._next if frame is None else frame
        self._next = frame + 1
        while len(self._corners) <= frame:
            drawn = self._rng.integers(0, _NOISE_MARGIN, 2)
            self._corners.append((int(drawn[0]), int(drawn[1])))
        row, column = self._corners[frame]
        height, width = self._size
        noise = self._tile[row : row + height, column : column + width]
        noisy = 255 * image + noise * (1.25 - 0.5 * image)
        return np.clip(noisy + 0.5, 0, 255).astype(np.uint8)


def write_recording(
    path: Path,
    frames: Iterable[NDArray[np.uint8]],
    fps: int,
    track: NDArray[np.float32],
    created: str = "2024-05-04T10:00:00Z",
    timecode: str = "10:00:00:00",
) -> None:
    """Write sRGB frames [H, W, 3] of even size at `fps`, with the 48 kHz `track` [n] on both audio channels."""
    # PyAV, not imageio: that writes no timecode track, no sound from memory, and no timestamps of one's choice.
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", format="mp4") as container:
        container.metadata.update({"creation_time": created, "timecode": timecode})
        video = container.add_stream("libx264", rate=fps)
        video.pix_fmt = "yuv420p"
        video.time_base = Fraction(1, fps * 1000)
        # One thread: the encoder's result then does not depend on the machine's number of cores.
        video.codec_context.options = {"crf": str(QUALITY), "preset": "veryfast", "threads": "1"}
        video.codec_context.gop_size = GROUP_OF_PICTURES
        # BT.709 (libav's number 1) and television's range are stated: what is not, is decoded as BT.601, with a cast.
        video.codec_context.color_primaries = video.codec_context.color_trc = video.codec_context.colorspace = 1
        video.codec_context.color_range = 1
        audio = container.add_stream("aac", rate=SAMPLE_RATE)
        audio.codec_context.layout = "stereo"
        audio.codec_context.bit_rate = AUDIO_BITS_PER_SECOND
        sized = False
        for number, pixels in enumerate(frames):
            if not sized:
                video.height, video.width = pixels.shape[:2]
                sized = True
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(
                format="yuv420p", src_colorspace="itu709", dst_colorspace="itu709"
            )
            frame.pts, frame.time_base = number, Fraction(1, fps)
            container.mux(video.encode(frame))
        if not sized:
            raise SplashbenchError(f"{path} would have no frames; give a longer --duration")
        container.mux(video.encode(None))
        for frame in _audio_frames(track):
            container.mux(audio.encode(frame))
        container.mux(audio.encode(None))


def _audio_frames(track: NDArray[np.float32]) -> Iterable[object]:
    import av

    size = 1024
    for start in range(0, len(track), size):
        block = np.ascontiguousarray(np.tile(track[start : start + size], (2, 1)))
        frame = av.AudioFrame.from_ndarray(block, format="fltp", layout="stereo")
        frame.sample_rate = SAMPLE_RATE
        frame.pts, frame.time_base = start, Fraction(1, SAMPLE_RATE)
        yield frame

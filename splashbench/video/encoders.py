"""Encoders: frames to H.264 in MP4 that browsers play, to GIF, or to PNGs, one frame after another."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import NO_ROOM, write_png

_QUALITY, _PRESET = 17, "veryfast"  # x264's constant rate factor
# A GIF's frames last whole hundredths of a second, and browsers slow down those that last one.
_GIF_TICKS, _GIF_SHORTEST = 100, 2
# Of a hundredth of a second: 33.3 frames a second are three of them.
_GIF_SLACK = 0.02


class Encoder(Protocol):
    """Takes the frames of one video in their order."""

    def add(self, pixels: NDArray[np.uint8]) -> None:
        """uint8 [H, W, 3] of the size that was said."""


def gif_rate(fps: float) -> float:
    """Frames a second nearest to `fps` that a GIF can have: each lasts whole hundredths of a second."""
    return _GIF_TICKS / max(_GIF_SHORTEST, round(_GIF_TICKS / fps))


@contextmanager
def encode_mp4(path: Path, size: tuple[int, int], fps: float) -> Iterator[Encoder]:
    """An encoder that writes H.264 to `path`. size: (width, height) in pixels. fps: frames a second."""
    with _libav_errors(), _Mp4(path, size, fps) as encoder:
        yield encoder


@contextmanager
def encode_gif(path: Path, size: tuple[int, int], fps: float) -> Iterator[Encoder]:
    """An encoder that writes a GIF to `path`, see `encode_mp4`. Raises SplashbenchError for rates that GIFs lack."""
    with _libav_errors(), _Gif(path, size, fps) as encoder:
        yield encoder


@contextmanager
def _libav_errors() -> Iterator[None]:
    """Turn what libav says of a full disk into what Python says."""
    import av

    try:
        yield
    except av.FFmpegError as error:
        if error.errno in NO_ROOM:
            raise OSError(error.errno, str(error.strerror)) from None
        raise


class PngFolder:
    """Frames in a folder, as 000000.png and so on."""

    def __init__(self, directory: Path) -> None:
        self._directory, self._count = directory, 0

    def add(self, pixels: NDArray[np.uint8]) -> None:
        write_png(self._directory / f"{self._count:06d}.png", pixels)
        self._count += 1


class _Libav:
    """A file with one video stream. PyAV, not imageio: that sets no colour space, and takes no filters."""

    def __init__(self, path: Path, form: str, options: dict[str, str] | None = None) -> None:
        import av

        self._container = av.open(str(path), "w", format=form, options=options or {})
        self._stream: Any = None
        self._count = 0

    def __enter__(self) -> _Libav:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            if kind is None:
                self._container.close()
            else:
                with suppress(Exception):  # half a file cannot be closed well, and is removed
                    self._container.close()

    def add(self, pixels: NDArray[np.uint8]) -> None:
        raise NotImplementedError

    def _finish(self) -> None:
        self._container.mux(self._stream.encode(None))


class _Mp4(_Libav):
    """H.264 in 4:2:0, with BT.709 stated; the index stands first, so that it plays while it loads.

    4:2:0 takes even sizes: an odd one repeats its last column or row.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: float) -> None:
        super().__init__(path, "mp4", {"movflags": "+faststart"})
        rate = Fraction(fps).limit_denominator(1001)
        stream = self._container.add_stream("libx264", rate=rate)
        stream.width, stream.height = (side + side % 2 for side in size)
        stream.pix_fmt = "yuv420p"
        stream.codec_context.options = {"crf": str(_QUALITY), "preset": _PRESET}
        # libav's numbers of BT.709 (ITU-T H.273), and of the range that television has.
        stream.codec_context.color_primaries = stream.codec_context.color_trc = stream.codec_context.colorspace = 1
        stream.codec_context.color_range = 1
        self._stream, self._time_base = stream, 1 / rate

    def add(self, pixels: NDArray[np.uint8]) -> None:
        import av

        height, width = pixels.shape[:2]
        even = np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24").reformat(
            format="yuv420p", src_colorspace="itu709", dst_colorspace="itu709"
        )
        frame.pts, frame.time_base = self._count, self._time_base
        self._container.mux(self._stream.encode(frame))
        self._count += 1


class _Gif(_Libav):
    """GIF, each frame with the 256 colours that suit it, played in a loop."""

    def __init__(self, path: Path, size: tuple[int, int], fps: float) -> None:
        ticks = _GIF_TICKS / fps
        if abs(ticks - round(ticks)) > _GIF_SLACK or round(ticks) < _GIF_SHORTEST:
            raise SplashbenchError(
                f"a GIF cannot have {fps:g} frames a second, as each lasts whole hundredths of one; give "
                f"--fps {gif_rate(fps):.4g}, or a name in .mp4"
            )
        super().__init__(path, "gif", {"loop": "0"})
        self._time_base = Fraction(round(ticks), _GIF_TICKS)
        stream = self._container.add_stream("gif", rate=1 / self._time_base)
        stream.width, stream.height = size
        stream.pix_fmt = "pal8"
        self._stream = stream
        self._graph = _palette_graph(size, self._time_base)

    def add(self, pixels: NDArray[np.uint8]) -> None:
        import av

        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24").reformat(format="rgba")
        frame.pts, frame.time_base = self._count, self._time_base
        self._graph.push(frame)
        self._count += 1
        self._pull()

    def _pull(self) -> None:
        import av

        while True:
            try:
                frame = self._graph.pull()
            except (av.BlockingIOError, av.EOFError):
                return
            self._container.mux(self._stream.encode(frame))

    def _finish(self) -> None:
        self._graph.push(None)
        self._pull()
        super()._finish()


def _palette_graph(size: tuple[int, int], time_base: Fraction) -> Any:
    """The filters that give each frame a palette of its own."""
    import av
    from av.filter import Graph

    graph = Graph()
    source = graph.add_buffer(width=size[0], height=size[1], format=av.VideoFormat("rgba"), time_base=time_base)
    split = graph.add("split")
    palette = graph.add("palettegen", "stats_mode=single:reserve_transparent=0")
    use = graph.add("paletteuse", "new=1:dither=sierra2_4a")
    sink = graph.add("buffersink")
    source.link_to(split)
    split.link_to(use, 0, 0)
    split.link_to(palette, 1, 0)
    palette.link_to(use, 0, 1)
    use.link_to(sink)
    graph.configure()
    return graph

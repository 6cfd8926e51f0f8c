"""Video and sound files that nobody meant: small honest ones in many containers and codecs, and mutations of them.

Half of the mutations keep the structure of an MP4 (ISO/IEC 14496-12): a box is changed, doubled or left out, and the
boxes around it keep their sizes, so that readers come far before they stumble.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np

_PARENTS = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"udta", b"mvex", b"moof", b"traf", b"dinf", b"tref")
_NUMBERS = (0, 1, 2, 3, 255, 65535, 65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1)
#: File name -> (video codec, its options, sound codec, the container's options).
_KINDS: dict[str, tuple[str | None, dict[str, str], str | None, dict[str, str]]] = {
    "plain.mp4": ("libx264", {"bf": "2", "g": "4"}, "aac", {}),
    "front.mp4": ("libx264", {"g": "4"}, "aac", {"movflags": "faststart"}),
    "pieces.mp4": ("libx264", {"g": "4"}, "aac", {"movflags": "frag_keyframe+empty_moov"}),
    "hevc.mp4": ("libx265", {"x265-params": "log-level=none"}, None, {}),
    "plain.mov": ("mjpeg", {}, "pcm_s16le", {}),
    "plain.mkv": ("libx264", {}, "flac", {}),
    "plain.webm": ("libvpx-vp9", {}, "libopus", {}),
    "plain.avi": ("mpeg4", {}, "mp3", {}),
    "plain.wav": (None, {}, "pcm_s16le", {}),
    "plain.ogg": (None, {}, "libvorbis", {}),
    "plain.flac": (None, {}, "flac", {}),
    "plain.mp3": (None, {}, "mp3", {}),
}


def honest_media(folder: Path) -> dict[str, bytes]:
    """Content of a small file of each kind that can be encoded here, by name; written into `folder` on the way."""
    import av

    made = {}
    for name, (video, options, sound, container) in _KINDS.items():
        if any(codec is not None and codec not in av.codecs_available for codec in (video, sound)):
            continue
        path = folder / name
        _write(path, video, options, sound, container)
        made[name] = path.read_bytes()
    return made


def _write(
    path: Path, video: str | None, options: dict[str, str], sound: str | None, container: dict[str, str]
) -> None:
    import av

    rng = np.random.default_rng(0)
    with av.open(str(path), "w", options=container) as out:
        pictures = samples = None
        if video is not None:
            pictures = out.add_stream(video, rate=30, options=options)
            pictures.width, pictures.height = 64, 48
            pictures.pix_fmt = "yuvj420p" if video == "mjpeg" else "yuv420p"
        if sound is not None:
            samples = out.add_stream(sound, rate=48000, layout="mono")
        packets = []
        if pictures is not None:
            for number in range(9):
                frame = av.VideoFrame.from_ndarray(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8), format="rgb24")
                frame.pts, frame.time_base = number, Fraction(1, 30)
                packets += pictures.encode(frame)
            packets += pictures.encode(None)
        if samples is not None:
            block = av.AudioFrame.from_ndarray(rng.normal(0, 0.2, (1, 14400)).astype(np.float32), "fltp", "mono")
            block.sample_rate, block.pts, block.time_base = 48000, 0, Fraction(1, 48000)
            packets += samples.encode(block)
            packets += samples.encode(None)
        for packet in sorted(packets, key=lambda packet: packet.dts * packet.time_base):
            out.mux(packet)


def mutated_media(
    rng: random.Random, name: str, content: bytes, mutated: Callable[[random.Random, bytes], bytes]
) -> bytes:
    """`content` with boxes or bytes changed. mutated: changes bytes anywhere."""
    what = rng.random()
    if what < 0.5 and name.endswith((".mp4", ".mov")):
        boxes = list(_boxes(content))
        for _ in range(rng.choice((1, 1, 2, 4))):
            boxes = _changed(rng, boxes, mutated)
        return b"".join(_framed(*box) for box in boxes)
    if what < 0.8:  # headers are small beside pictures and sound, and lie at the beginning or the end
        length = min(len(content), rng.choice((64, 400, 2000)))
        if rng.random() < 0.3:
            return content[:-length] + mutated(rng, content[-length:])
        return mutated(rng, content[:length]) + content[length:]
    return mutated(rng, content)


def _boxes(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """(kind, payload) of the boxes that `content` is made of; what is no box ends them."""
    place = 0
    while place + 8 <= len(content):
        size, kind = struct.unpack_from(">I4s", content, place)
        if size < 8:
            size = len(content) - place
        yield kind, content[place + 8 : place + size]
        place += size


def _framed(kind: bytes, payload: bytes) -> bytes:
    return struct.pack(">I4s", (8 + len(payload)) & 0xFFFFFFFF, kind) + payload


def _changed(
    rng: random.Random, boxes: list[tuple[bytes, bytes]], mutated: Callable[[random.Random, bytes], bytes]
) -> list[tuple[bytes, bytes]]:
    """The boxes with one of them changed, or something within one that holds boxes."""
    if not boxes:
        return boxes
    boxes = list(boxes)
    inner = [k for k, (kind, _) in enumerate(boxes) if kind in _PARENTS]
    if inner and rng.random() < 0.85:
        k = rng.choice(inner)
        kind, payload = boxes[k]
        within = _changed(rng, list(_boxes(payload)), mutated)
        boxes[k] = kind, b"".join(_framed(*box) for box in within)
        return boxes
    k = rng.randrange(len(boxes))
    kind, payload = boxes[k]
    change = rng.randrange(7)
    if change == 0 and len(boxes) > 1:
        del boxes[k]
    elif change == 1:
        boxes.insert(rng.randrange(len(boxes) + 1), (kind, payload))
    elif change == 2:
        boxes[k] = rng.choice((*_PARENTS, b"free", b"stts", b"ctts", b"elst", b"cmov", b"uuid")), payload
    elif change == 3:
        boxes[k] = kind, mutated(rng, payload)
    elif change == 4:
        boxes[k] = kind, payload * rng.choice((2, 100))
    else:  # a number of a table or of its length
        data = bytearray(payload)
        for _ in range(rng.choice((1, 1, 2, 5))):
            if len(data) >= 4:
                place = 4 * rng.randrange(len(data) // 4)
                data[place : place + 4] = struct.pack(">I", rng.choice(_NUMBERS))
        boxes[k] = kind, bytes(data)
    return boxes

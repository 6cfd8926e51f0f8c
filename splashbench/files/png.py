"""PNG files held against their specification (W3C, Portable Network Graphics) without decoding a pixel.

Every chunk must be there with its checksum, up to the end's. So a file that was cut or damaged is found in a few per
cent of the time that decoding takes, and its header can be believed: Pillow, for one, drops the lower half of 16 bits.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_COLOURS = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGB with alpha"}
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
_BITS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
_LAST_FILTER, _HEADER_BYTES = 4, 13
# Of an interlaced image: the first column and row of each pass, and the steps between them.
_PASSES = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
_MAX_CHUNKS = 100_000
# Deflate packs no tighter than this (RFC 1951: 258 bytes in two bits).
_MOST_PACKED = 1032


@dataclass(frozen=True)
class PngHeader:
    """width, height in pixels; bits of a channel; colour: "grey", "RGB", "palette", or one "with alpha".

    passes: of the unpacked pixels, one or, interlaced, up to seven: (rows, bytes of a row with its filter's byte).
    packed: the content of its IDAT chunks. is_bare: whether it has no chunk beside the pixels' own. stated: of IHDR.
    """

    width: int
    height: int
    bits: int
    colour: str
    passes: tuple[tuple[int, int], ...]
    packed: tuple[memoryview, ...]
    is_bare: bool
    stated: bytes

    @property
    def n_bytes(self) -> int:
        """Of its pixels, unpacked, with the filter's byte before each row."""
        return sum(rows * row_bytes for rows, row_bytes in self.passes)


def png_header(content: bytes) -> PngHeader:
    """What a PNG file states of its pixels. Raises ValueError, in words, where it is no PNG, cut short or damaged."""
    if not content.startswith(_SIGNATURE):
        raise ValueError("no PNG")
    view, place, stated, packed, is_bare, is_ended = memoryview(content), len(_SIGNATURE), None, [], True, False
    for _ in range(_MAX_CHUNKS):
        if place + 12 > len(content):
            break
        (length,), kind = struct.unpack_from(">I", content, place), content[place + 4 : place + 8]
        end = place + 12 + length
        if end > len(content):
            break
        (checksum,) = struct.unpack_from(">I", content, end - 4)
        if zlib.crc32(view[place + 4 : end - 4]) != checksum:
            raise ValueError(f"damaged in its part {kind.decode('ascii', 'replace')}")
        if stated is None:
            stated = _stated(kind, content[place + 8 : end - 4])
        elif kind == b"IDAT":
            packed.append(view[place + 8 : end - 4])
        elif kind[:1].isupper() and kind not in (b"PLTE", b"IEND"):
            raise ValueError(f"with an unknown part {kind.decode('ascii', 'replace')}")  # which pixels may depend on
        elif kind != b"IEND":
            is_bare = False
        place = end
        if kind == b"IEND":
            is_ended = True
            break
    if stated is None or not is_ended:
        raise ValueError("cut short")
    width, height, bits, colour, is_interlaced = stated
    passes = tuple(_passes(width, height, bits * _CHANNELS[colour], is_interlaced))
    chunk = content[len(_SIGNATURE) + 8 :][:_HEADER_BYTES]
    header = PngHeader(width, height, bits, _COLOURS[colour], passes, tuple(packed), is_bare, chunk)
    if sum(map(len, packed)) * _MOST_PACKED < header.n_bytes:
        raise ValueError("cut short: it has too few bytes for its pixels")
    return header


def bare_png(header: PngHeader) -> bytes:
    """The PNG with its pixels alone: without gamma, profiles, animation and texts, over which decoders stumble."""
    return png_of([(b"IHDR", header.stated), (b"IDAT", b"".join(header.packed)), (b"IEND", b"")])


def png_of(chunks: Iterable[tuple[bytes, bytes]]) -> bytes:
    """The PNG file of `chunks`, (kind, content) each, with checksums that hold."""
    out = [_SIGNATURE]
    for kind, data in chunks:
        out += [struct.pack(">I", len(data)), kind, data, struct.pack(">I", zlib.crc32(kind + data))]
    return b"".join(out)


def require_pixels(header: PngHeader) -> None:
    """Raise ValueError, in words, where a PNG's pixels cannot be unpacked; half as long as decoding them takes."""
    try:
        unpacked = zlib.decompressobj().decompress(b"".join(header.packed), header.n_bytes)
    except zlib.error as error:
        raise ValueError(f"its pixels cannot be unpacked: {error}") from None
    if len(unpacked) < header.n_bytes:
        raise ValueError("cut short: pixels are missing")
    start = 0
    for rows, row_bytes in header.passes:
        stop = start + rows * row_bytes
        if max(unpacked[start:stop:row_bytes]) > _LAST_FILTER:
            raise ValueError("a row has a filter that there is not")
        start = stop


def _passes(width: int, height: int, bits_per_pixel: int, is_interlaced: bool) -> Iterator[tuple[int, int]]:
    """(rows, bytes of a row with its filter's byte) of each pass that has pixels."""
    for x, y, step_x, step_y in _PASSES if is_interlaced else [(0, 0, 1, 1)]:
        columns, rows = -(-(width - x) // step_x), -(-(height - y) // step_y)
        if columns > 0 and rows > 0:
            yield rows, 1 + (columns * bits_per_pixel + 7) // 8


def _stated(kind: bytes, data: bytes) -> tuple[int, int, int, int, bool]:
    """Width, height, bits, type of colour and whether it is interlaced, of the first chunk, which must be IHDR."""
    if kind != b"IHDR" or len(data) != _HEADER_BYTES:
        raise ValueError("without a header")
    width, height, bits, colour, compression, filtering, interlace = struct.unpack(">IIBBBBB", data)
    known = bits in _BITS.get(colour, ()) and not compression and not filtering and interlace < 2
    if not 0 < width < 1 << 31 or not 0 < height < 1 << 31 or not known:
        raise ValueError("of no known kind")
    return width, height, bits, colour, bool(interlace)

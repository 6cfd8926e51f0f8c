"""Images in and out: the bytes that are written, and how little of a stranger's file is trusted."""

from __future__ import annotations

import hashlib
import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splashbench.errors import SplashbenchError
from splashbench.files import (
    image_size,
    jpeg_bytes,
    read_gray,
    read_image,
    read_png,
    read_rgba,
    require_png,
    write_image,
    write_png,
)
from splashbench.files.png import png_header, png_of, require_pixels

NOISE = np.random.default_rng(0).integers(0, 255, (40, 30, 3), dtype=np.uint8)


def _saved(image: np.ndarray, suffix: str, **options: object) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, format={".png": "PNG", ".jpg": "JPEG"}[suffix], **options)
    return stream.getvalue()


@pytest.mark.parametrize("pixels", [NOISE, NOISE[..., 0], NOISE[:1, :1]], ids=["colour", "grey", "one pixel"])
def test_png_is_lossless_at_the_fastest_level(tmp_path: Path, pixels: np.ndarray) -> None:
    write_png(path := tmp_path / "image.png", pixels)
    assert path.read_bytes() == _saved(pixels, ".png", compress_level=1)
    np.testing.assert_array_equal(read_image(path) if pixels.ndim == 3 else read_gray(path), pixels)
    assert image_size(path) == pixels.shape[1::-1]


def test_jpeg_keeps_chroma_at_full_size(tmp_path: Path) -> None:
    write_image(path := tmp_path / "image.jpg", NOISE, quality=80)
    assert path.read_bytes() == _saved(NOISE, ".jpg", quality=80, subsampling=0)
    assert jpeg_bytes(NOISE, quality=88) == _saved(NOISE, ".jpg", quality=88)


def test_only_bytes_become_images(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="written from uint8, not float64"):
        write_png(tmp_path / "image.png", np.zeros((4, 4)))
    assert list(tmp_path.iterdir()) == []


def test_a_write_that_fails_leaves_the_old_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_png(path := tmp_path / "image.png", NOISE)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError

    monkeypatch.setattr("imageio.v3.imwrite", fail)
    with pytest.raises(RuntimeError):
        write_png(path, NOISE[::-1])
    assert hashlib.sha256(path.read_bytes()).hexdigest() == digest
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("kind", ["BMP", "GIF", "TIFF", "PPM"])
def test_formats_but_png_and_jpeg_are_refused_whatever_the_name_says(tmp_path: Path, kind: str) -> None:
    Image.fromarray(NOISE).save(path := tmp_path / "image.png", format=kind)
    for read in (image_size, read_image, read_gray, read_rgba):
        with pytest.raises(SplashbenchError, match=r"image\.png is not a readable image"):
            read(path)


def test_an_image_of_too_many_pixels_is_refused_by_its_header(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_png(path := tmp_path / "image.png", NOISE)
    monkeypatch.setattr("splashbench.files.images.MAX_PIXELS", NOISE.shape[0] * NOISE.shape[1] - 1)
    monkeypatch.setattr("imageio.v3.imread", lambda *_, **__: pytest.fail("pixels were read"))
    with pytest.raises(SplashbenchError, match="is 30x40, more than 1199 pixels"):
        read_image(path)


def test_an_image_of_16_bits_is_refused(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((4, 4), np.uint16)).save(path := tmp_path / "image.png")
    with pytest.raises(SplashbenchError, match="more than 8 bits per channel"):
        read_gray(path)


def test_of_an_animation_the_first_image_is_read(tmp_path: Path) -> None:
    first, second = Image.fromarray(NOISE), Image.fromarray(NOISE[::-1])
    first.save(path := tmp_path / "image.png", save_all=True, append_images=[second])
    np.testing.assert_array_equal(read_image(path), NOISE)


def test_a_broken_exif_block_neither_turns_nor_stops_a_photograph(tmp_path: Path) -> None:
    turned = Image.Exif()
    turned[0x0112] = 6
    for exif in (turned.tobytes(), b"Exif\x00\x00garbage", b"Exif\x00\x00II*\x00\x08\x00\x00\x00\x05\x00\x12\x01"):
        Image.fromarray(NOISE).save(path := tmp_path / "image.jpg", quality=95, exif=exif)
        assert read_image(path).shape == NOISE.shape  # a warning would fail the test


def test_opacity_is_read_where_there_is_one(tmp_path: Path) -> None:
    pixels = np.dstack([NOISE, NOISE[..., 0]])
    Image.fromarray(pixels).save(tmp_path / "image.png")
    np.testing.assert_array_equal(read_rgba(tmp_path / "image.png"), pixels)
    write_png(tmp_path / "opaque.png", NOISE)
    with pytest.raises(SplashbenchError, match=r"opaque\.png has no alpha channel \(it is RGB\)"):
        read_rgba(tmp_path / "opaque.png")


@pytest.mark.parametrize("channels", [1, 3])
def test_sixteen_bits_are_refused_in_colour_too(tmp_path: Path, channels: int) -> None:
    # Pillow reads the upper half of 16-bit colour as if there were no more; OpenCV writes it.
    import cv2

    pixels = np.zeros((4, 4, channels), np.uint16)
    path = tmp_path / "image.png"
    assert cv2.imwrite(str(path), pixels)
    for read in (image_size, read_image, read_gray):
        with pytest.raises(SplashbenchError, match="more than 8 bits per channel"):
            read(path)


def test_a_photograph_of_thousands_of_scans_is_refused(tmp_path: Path) -> None:
    Image.fromarray(NOISE).save(path := tmp_path / "image.jpg", progressive=True)
    content = path.read_bytes()
    assert read_image(path).shape == NOISE.shape
    scan = content.index(b"\xff\xda")
    path.write_bytes(content[:scan] + content[scan : scan + 40] * 5000 + content[scan:])
    with pytest.raises(SplashbenchError, match="more than 100 scans"):
        read_image(path)


def _png(path: Path, mode: str, **options: object) -> Path:
    Image.fromarray(NOISE).convert(mode).save(path, format="PNG", **options)
    return path


@pytest.mark.parametrize(
    ("mode", "said"),
    [
        ("RGBA", "RGB with alpha of 8"),
        ("P", "palette of 8"),
        ("L", "grey of 8"),
        ("LA", "grey with alpha"),
        ("1", "grey of 1"),
    ],
)
def test_a_png_of_another_colour_is_refused_by_reader_and_checker_alike(tmp_path: Path, mode: str, said: str) -> None:
    path = _png(tmp_path / "image.png", mode)
    for read in (require_png, read_png):
        with pytest.raises(SplashbenchError, match=f"{said}.*write it as RGB of 8 bits"):
            read(path, "RGB")


def test_a_png_is_told_by_its_content(tmp_path: Path) -> None:
    Image.fromarray(NOISE).save(path := tmp_path / "image.png", format="JPEG")
    for read in (require_png, read_png):
        with pytest.raises(SplashbenchError, match="is not a readable PNG"):
            read(path, "RGB")


def test_a_cut_or_damaged_png_is_found_without_decoding_it(tmp_path: Path) -> None:
    path = _png(tmp_path / "image.png", "RGB")
    content = path.read_bytes()
    header = require_png(path, "RGB", pixels=True)
    assert (header.width, header.height) == NOISE.shape[1::-1]
    np.testing.assert_array_equal(read_png(path, "RGB"), NOISE)
    for length in (0, 8, 33, 200, len(content) - 12, len(content) - 1):
        path.write_bytes(content[:length])
        with pytest.raises(SplashbenchError, match=r"image\.png is not a readable PNG"):
            require_png(path, "RGB")
    for place in range(8, len(content), 97):
        path.write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
        with pytest.raises(SplashbenchError, match=r"image\.png is not a readable PNG"):
            require_png(path, "RGB")


@pytest.mark.parametrize("pixels", [b"", bytes(100), b"\x09" * (121 * 40), b"\x00" * (121 * 40 - 1)])
def test_pixels_that_cannot_be_unpacked_are_found_when_asked_for(tmp_path: Path, pixels: bytes) -> None:
    """Forged: every checksum holds."""
    parts = [(b"IHDR", struct.pack(">IIBBBBB", 40, 40, 8, 2, 0, 0, 0)), (b"IDAT", zlib.compress(pixels) + bytes(100))]
    parts.append((b"IEND", b""))
    (path := tmp_path / "image.png").write_bytes(png_of(parts))
    require_png(path, "RGB")
    with pytest.raises(SplashbenchError, match="is not a readable PNG"):
        require_png(path, "RGB", pixels=True)
    with pytest.raises(SplashbenchError, match="cut short or damaged"):
        read_png(path, "RGB")


@pytest.mark.parametrize("size", [(1, 1), (3, 9), (8, 8), (13, 5)])
@pytest.mark.parametrize("is_interlaced", [False, True])
def test_an_honest_png_has_the_bytes_it_should(size: tuple[int, int], is_interlaced: bool) -> None:
    width, height = size
    passes = [(0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)]
    rows = 0
    for x, y, step_x, step_y in passes if is_interlaced else [(0, 0, 1, 1)]:
        columns = len(range(x, width, step_x))
        rows += len(range(y, height, step_y)) * (1 + 3 * columns) if columns else 0
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, int(is_interlaced))
    content = png_of([(b"IHDR", header), (b"IDAT", zlib.compress(bytes(rows))), (b"IEND", b"")])
    stated = png_header(content)
    assert stated.n_bytes == rows
    require_pixels(stated)
    assert Image.open(io.BytesIO(content)).convert("RGB").size == size


@pytest.mark.parametrize("is_interlaced", [False, True])
def test_a_filter_that_there_is_not_is_found_in_every_row(is_interlaced: bool, tmp_path: Path) -> None:
    header = struct.pack(">IIBBBBB", 8, 8, 8, 2, 0, 0, int(is_interlaced))
    passes = png_header(png_of([(b"IHDR", header), (b"IDAT", bytes(9)), (b"IEND", b"")])).passes
    starts = [row_bytes for rows, row_bytes in passes for _ in range(rows)]
    for place in [0, *np.cumsum(starts)[:-1].tolist()]:
        pixels = bytearray(sum(starts))
        pixels[place] = 9
        path = tmp_path / "image.png"
        path.write_bytes(png_of([(b"IHDR", header), (b"IDAT", zlib.compress(bytes(pixels))), (b"IEND", b"")]))
        for read in (lambda path: require_png(path, "RGB", pixels=True), lambda path: read_png(path, "RGB")):
            with pytest.raises(SplashbenchError, match=r"image\.png is"):
                read(path)


def test_parts_that_say_nothing_of_pixels_do_not_matter(tmp_path: Path) -> None:
    """Damaged, they stop Pillow; whole, they must not change a colour."""
    bare = _png(tmp_path / "bare.png", "RGB").read_bytes()
    for kind in (b"tRNS", b"gAMA", b"acTL", b"fcTL", b"iCCP", b"eXIf", b"zTXt", b"PLTE"):
        for data in (b"", b"\0", b"\1" * 40):
            chunk = struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
            (path := tmp_path / "image.png").write_bytes(bare[:33] + chunk + bare[33:])
            require_png(path, "RGB", pixels=True)
            np.testing.assert_array_equal(read_png(path, "RGB"), NOISE)


def test_a_png_with_a_part_that_nobody_knows_is_refused(tmp_path: Path) -> None:
    bare = _png(path := tmp_path / "image.png", "RGB").read_bytes()
    for kind in (b"IHDR", b"ABCD"):
        data = bare[16:29]
        chunk = struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        path.write_bytes(bare[:33] + chunk + bare[33:])
        with pytest.raises(SplashbenchError, match="with an unknown part"):
            require_png(path, "RGB")

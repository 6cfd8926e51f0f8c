"""Images in and out: the bytes that are written, and how little of a stranger's file is trusted."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splashbench.errors import SplashbenchError
from splashbench.files import image_size, jpeg_bytes, read_gray, read_image, read_rgba, write_image, write_png

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

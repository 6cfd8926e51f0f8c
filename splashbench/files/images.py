"""Images read and written by imageio: 8 bits a channel, PNG or JPEG, bounded in size.

Every file may come from a stranger. Its header is checked first, by Pillow, as imageio cannot be limited to formats.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files.atomic import atomic_path
from splashbench.files.plain import open_plain, read_plain
from splashbench.files.png import PngHeader, bare_png, png_header, require_pixels

MAX_PIXELS = 8192 * 8192
#: Of an image file; so many pixels of noise, in colour and not packed at all, take 192 MiB.
MAX_IMAGE_BYTES = 256 << 20
# Whatever a file's name says: Pillow would hand an EPS to Ghostscript.
_FORMATS = ("PNG", "JPEG")
# A progressive JPEG is unpacked anew for every scan, of which a few bytes make one; encoders write some ten.
_MAX_SCANS = 100
_DEPTH_PLACE = 24  # of a PNG's bits per channel


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image in pixels, from its header alone."""
    with _checked(Path(path)) as (_, size, _):
        return size


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read an image file as sRGB uint8 [H, W, 3]; transparency is dropped."""
    return _read_pixels(Path(path), "RGB")


def read_rgba(path: Path) -> NDArray[np.uint8]:
    """Read an image file as sRGB and opacity, uint8 [H, W, 4]; one without an alpha channel is refused."""
    return _read_pixels(Path(path), "RGBA")


def read_gray(path: Path) -> NDArray[np.uint8]:
    """Read an image file as grey uint8 [H, W] (masks are 0 and 255)."""
    return _read_pixels(Path(path), "L")


@contextmanager
def _checked(path: Path) -> Iterator[tuple[BinaryIO, tuple[int, int], str]]:
    """Yield the open file, its (width, height) and Pillow's mode; raises SplashbenchError where it is unusable."""
    from PIL import Image, UnidentifiedImageError

    with _opened(path) as stream:
        try:
            with warnings.catch_warnings():
                # Of many pixels, for which the limit below is lower, and of EXIF, which is not used.
                warnings.simplefilter("ignore")
                image = Image.open(stream, formats=_FORMATS)
        except (OSError, UnidentifiedImageError, Image.DecompressionBombError, ValueError) as error:
            raise SplashbenchError(f"{path} is not a readable image ({error}); restore the file") from None
        width, height = int(image.width), int(image.height)
        if width * height > MAX_PIXELS:
            raise SplashbenchError(f"{path} is {width}x{height}, more than {MAX_PIXELS} pixels; scale it down")
        if image.mode.startswith(("I", "F")) or (image.format == "PNG" and _png_bits(stream) > 8):
            raise SplashbenchError(f"{path} has more than 8 bits per channel; write it as an 8-bit image")
        stream.seek(0)
        yield stream, (width, height), image.mode


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """Yield the file, opened; errors are those of an image."""
    try:
        with open_plain(path, MAX_IMAGE_BYTES) as (stream, _):
            yield stream
    except FileNotFoundError:
        raise SplashbenchError(f"{path} does not exist; restore the file") from None
    except OSError as error:
        raise SplashbenchError(f"{path} is not a readable image ({error}); restore the file") from None


def _png_bits(stream: BinaryIO) -> int:
    """Bits per channel of the PNG file `stream`: Pillow reads the upper eight of sixteen and says nothing."""
    stream.seek(_DEPTH_PLACE)
    return (stream.read(1) or b"\0")[0]


def _read_pixels(path: Path, mode: str) -> NDArray[np.uint8]:
    with _checked(path) as (stream, _, file_mode):
        if mode == "RGBA" and "A" not in file_mode:
            raise SplashbenchError(f"{path} has no alpha channel (it is {file_mode}); restore the RGBA file")
        content = stream.read(MAX_IMAGE_BYTES)
    if content.startswith(b"\xff\xd8") and content.count(b"\xff\xda") > _MAX_SCANS:
        raise SplashbenchError(f"{path} has more than {_MAX_SCANS} scans; write it as a plain JPEG")
    return _decoded(path, content, mode)


def _decoded(path: Path, content: bytes, mode: str) -> NDArray[np.uint8]:
    """The pixels of the image file `content`, in Pillow's `mode`."""
    import imageio.v3 as iio

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of EXIF again
            # An animated PNG is its first image.
            return iio.imread(content, plugin="pillow", index=0, mode=mode, writeable_output=False)
    except Exception as error:  # Pillow lets whatever a broken EXIF block causes through
        raise SplashbenchError(f"{path} is cut short or damaged ({error}); restore the file") from None


def require_png(path: Path, colour: str, pixels: bool = False) -> PngHeader:
    """Header of a PNG of 8 bits a channel and of `colour` ("RGB" or "grey"), which `read_png` reads.

    pixels: whether to unpack them, too. Without, only a file that was forged on purpose, with checksums that hold over
    pixels that cannot be unpacked, passes here and fails there; with, it takes half as long as reading.

    Raises SplashbenchError for what is missing, too large, of another format or colour, cut short or damaged.
    """
    header, _ = _png(path, colour)
    try:
        if pixels:
            require_pixels(header)
    except ValueError as error:
        raise SplashbenchError(f"{path} is not a readable PNG ({error}); restore the file") from None
    return header


def _png(path: Path, colour: str) -> tuple[PngHeader, bytes]:
    """Header and content, checked but for the packed pixels."""
    path = Path(path)
    try:
        content = read_plain(path, MAX_IMAGE_BYTES)
        header = png_header(content)
    except FileNotFoundError:
        raise SplashbenchError(f"{path} is missing; restore the file") from None
    except (OSError, ValueError) as error:
        raise SplashbenchError(f"{path} is not a readable PNG ({error}); restore the file") from None
    if header.bits != 8 or header.colour != colour:
        raise SplashbenchError(
            f"{path} is {header.colour} of {header.bits} bits a channel; write it as {colour} of 8 bits"
        )
    if header.width * header.height > MAX_PIXELS:
        raise SplashbenchError(
            f"{path} is {header.width}x{header.height}, more than {MAX_PIXELS} pixels; scale it down"
        )
    return header, content


def read_png(path: Path, colour: str) -> NDArray[np.uint8]:
    """Read a PNG that `require_png` accepts: uint8 [H, W, 3] of "RGB", [H, W] of "grey"."""
    header, content = _png(path, colour)
    return _decoded(Path(path), content if header.is_bare else bare_png(header), {"RGB": "RGB", "grey": "L"}[colour])


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write uint8 [H, W] or [H, W, 3] losslessly as PNG, whole or not at all."""
    write_image(path, image)


def write_image(path: Path, image: NDArray[np.uint8], quality: int = 97) -> None:
    """Write uint8 [H, W] or [H, W, 3] in the format of the file's ending (.png lossless, .jpg at `quality`)."""
    path = Path(path)
    # Level 1: our images are small and many; the higher levels cost far more time than they save space.
    options: dict[str, Any] = {"compress_level": 1} if path.suffix == ".png" else {"quality": quality, "subsampling": 0}
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        _encode(stream, image, path.suffix, options)


def jpeg_bytes(image: NDArray[np.uint8], quality: int) -> bytes:
    """Encode uint8 [H, W] or [H, W, 3] as a JPEG file's bytes, for pages that hold images (chroma at half size)."""
    return _encode("<bytes>", image, ".jpg", {"quality": quality})


def _encode(target: BinaryIO | str, image: NDArray[np.uint8], extension: str, options: dict[str, Any]) -> Any:
    import imageio.v3 as iio

    if image.dtype != np.uint8:
        raise TypeError(f"images are written from uint8, not {image.dtype}")
    pixels = np.ascontiguousarray(image)
    return iio.imwrite(target, pixels, plugin="pillow", extension=extension.lower(), is_batch=False, **options)

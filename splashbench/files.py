"""Reading and writing files so that nothing is lost, half-written or trusted too far.

Every output is written beside its place and renamed onto it; every input that may come from a stranger is read
with limits on its size, without pickles, and fails with one line that names the file.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import uuid
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from splashbench.errors import DiskFullError, SplashbenchError

MAX_JSON_BYTES = 256 << 20
MAX_NPZ_BYTES = 4 << 30
MAX_PIXELS = 8192 * 8192

Model = TypeVar("Model", bound=BaseModel)


def _sibling(path: Path) -> Path:
    return path.with_name(f".tmp-{uuid.uuid4().hex[:8]}-{path.name}")


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling of `path`; rename it onto `path` on success, remove it on any failure."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _sibling(path)
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        _raise_if_unwritable(path, error)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def _raise_if_unwritable(path: Path, error: OSError) -> None:
    """Turn "the disk took no more" into the one line a user needs; libraries report it in several ways."""
    no_room = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    # Pillow's encoders report a failed write by a number of their own and lose the system's.
    encoder_failed = error.errno is None and "when writing image file" in str(error)
    if no_room or encoder_failed:
        raise DiskFullError(
            f"{path} could not be written: the disk is full; free some space and run the command again"
        ) from None


@contextmanager
def atomic_directory(path: Path, replace: bool = False) -> Iterator[Path]:
    """Yield a temporary sibling directory that becomes `path` on success and disappears on any failure.

    Raises SplashbenchError when `path` exists and `replace` is false; an empty directory counts as absent.
    """
    path = Path(path).absolute()
    if path.is_dir() and not any(path.iterdir()):
        path.rmdir()
    if path.exists() and not replace:
        raise SplashbenchError(f"{path} exists already; give another place, or --replace to replace it")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _sibling(path)
    temporary.mkdir()
    retired = _sibling(path)
    try:
        yield temporary
        if path.exists():
            path.rename(retired)
        temporary.rename(path)
    finally:
        # A failed rename must not cost the user what was there before.
        if retired.exists() and not path.exists():
            retired.rename(path)
        for leftover in (temporary, retired):
            shutil.rmtree(leftover, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, data: Any) -> None:
    """Write `data` as indented JSON, whole or not at all. NaN and infinity are refused: JSON has neither."""
    write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file. Raises SplashbenchError when it is missing, too large or not JSON."""
    path = Path(path)
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise SplashbenchError(f"{path} is larger than {MAX_JSON_BYTES >> 20} MiB; this is not a file of ours")
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SplashbenchError(f"{path} does not exist; check the path, or make the folder anew") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise SplashbenchError(f"{path} cannot be read as JSON ({error}); mend or restore it") from None


def validate_model(path: Path, model: type[Model], data: Any) -> Model:
    """Validate `data`, read from `path`, against a pydantic model; the first fault becomes the one-line error."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the whole file"
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        raise SplashbenchError(f"{path}: {place}: {first['msg']}{more}; mend this entry") from None


def read_model(path: Path, model: type[Model]) -> Model:
    """Read a JSON file as a pydantic model."""
    return validate_model(path, model, read_json(path))


def write_model(path: Path, model: BaseModel) -> None:
    """Write a pydantic model as JSON, whole or not at all."""
    write_text(path, model.model_dump_json(indent=1) + "\n")


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image in pixels, from its header alone."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            size = (int(image.width), int(image.height))
    except FileNotFoundError:
        raise SplashbenchError(f"{path} does not exist; restore the file") from None
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError, ValueError) as error:
        raise SplashbenchError(f"{path} is not a readable image ({error}); restore the file") from None
    if size[0] * size[1] > MAX_PIXELS:
        raise SplashbenchError(f"{path} is {size[0]}x{size[1]}, more than {MAX_PIXELS} pixels; scale it down")
    return size


def _read_pixels(path: Path, mode: str) -> NDArray[np.uint8]:
    from PIL import Image

    image_size(path)
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert(mode))
    except (OSError, SyntaxError, ValueError, MemoryError) as error:
        raise SplashbenchError(f"{path} is cut short or damaged ({error}); restore the file") from None


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read an image file as sRGB uint8 [H, W, 3]; transparency is dropped."""
    return _read_pixels(Path(path), "RGB")


def read_gray(path: Path) -> NDArray[np.uint8]:
    """Read an image file as grey uint8 [H, W] (masks are 0 and 255)."""
    return _read_pixels(Path(path), "L")


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write uint8 [H, W] or [H, W, 3] losslessly as PNG, whole or not at all."""
    write_image(path, image)


def write_image(path: Path, image: NDArray[np.uint8], quality: int = 97) -> None:
    """Write uint8 [H, W] or [H, W, 3] in the format of the file's ending (.png lossless, .jpg at `quality`)."""
    from PIL import Image

    path = Path(path)
    if image.dtype != np.uint8:
        raise TypeError(f"images are written from uint8, not {image.dtype}")
    # Level 1: our images are small and many; the higher levels cost far more time than they save space.
    options: dict[str, Any] = {"compress_level": 1} if path.suffix == ".png" else {"quality": quality, "subsampling": 0}
    with atomic_path(path) as temporary:
        Image.fromarray(np.ascontiguousarray(image)).save(temporary, **options)


def read_npz(path: Path, names: Mapping[str, int], optional: Mapping[str, int] | None = None) -> dict[str, Any]:
    """Read named arrays with the number of dimensions given, without pickles and within limits.

    Returns the arrays of `names`, and those of `optional` that are there. Raises SplashbenchError when the file is
    missing, holds too much, or an array is absent, of another rank, not numeric, or not finite.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            # The sizes are the archive's claims, but numpy's reader never inflates beyond them.
            if sum(entry.file_size for entry in archive.infolist()) > MAX_NPZ_BYTES:
                raise SplashbenchError(f"{path} unpacks to more than {MAX_NPZ_BYTES >> 30} GiB; refused")
        with np.load(path, allow_pickle=False) as archive:
            missing = [name for name in names if name not in archive.files]
            if missing:
                raise SplashbenchError(f"{path} lacks the array {missing[0]!r}; write it again")
            wanted = dict(names) | {name: rank for name, rank in (optional or {}).items() if name in archive.files}
            arrays = {name: archive[name] for name in wanted}
    except FileNotFoundError:
        raise SplashbenchError(f"{path} does not exist; check the path") from None
    except (OSError, ValueError, zipfile.BadZipFile, EOFError, KeyError, MemoryError) as error:
        raise SplashbenchError(f"{path} is not a readable .npz without pickles ({error}); write it again") from None
    for name, array in arrays.items():
        if array.ndim != wanted[name]:
            raise SplashbenchError(f"{path}: {name} has {array.ndim} dimensions, not {wanted[name]}; write it again")
        if array.dtype.kind not in "biuf":
            raise SplashbenchError(f"{path}: {name} holds {array.dtype}, not numbers; write it again")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise SplashbenchError(f"{path}: {name} has NaN or infinite entries; write finite numbers")
    return arrays


def sha256_file(path: Path) -> str:
    """Hex SHA-256 of a file's bytes."""
    digest = hashlib.sha256()
    with Path(path).open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def tree_bytes(directory: Path) -> int:
    """Total size in bytes of the regular files below `directory` (0 where it does not exist)."""
    total = 0
    for root, _, names in os.walk(directory):
        for name in names:
            path = Path(root, name)
            total += 0 if path.is_symlink() else path.stat().st_size
    return total

"""Reading and writing files so that nothing is lost, half-written or trusted too far.

Every output is written beside its place and renamed onto it; every input that may come from a stranger is read
with limits on its size, without pickles, and fails with one line that names the file.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import uuid
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from splashbench.errors import DiskFullError, SplashbenchError

MAX_JSON_BYTES = 256 << 20
MAX_NPZ_BYTES = 4 << 30
MAX_PIXELS = 8192 * 8192
# Whatever a file's name says: Pillow would hand an EPS to Ghostscript.
_IMAGE_FORMATS = ("PNG", "JPEG")
# RuntimeError and its NotImplementedError: encrypted archives, and compressions that zipfile does not know.
_DAMAGED = (OSError, ValueError, EOFError, KeyError, MemoryError, RuntimeError)
_STAGED = re.compile(r"\.tmp-[0-9a-f]{8}-")

Model = TypeVar("Model", bound=BaseModel)


def _sibling(path: Path) -> Path:
    return path.with_name(f".tmp-{uuid.uuid4().hex[:8]}-{path.name}")


def is_staged_for(path: Path, output: Path) -> bool:
    """Whether `path` has the place and name of a staging folder for `output`: what a killed process may leave."""
    output = Path(output).resolve()
    staged = _STAGED.match(path.name)
    return path.parent == output.parent and staged is not None and path.name[staged.end() :] == output.name


def as_asked(path: Path | str) -> str:
    """`path` under the name the user knows, not that of its staging place."""
    return _STAGED.sub("", str(path))


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling of `path`; rename it onto `path` on success, remove it on any failure."""
    path = Path(path)
    require_file_place(path)
    made_parent = not path.parent.exists()
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _sibling(path)
    done = False
    try:
        yield temporary
        temporary.replace(path)
        done = True
    except OSError as error:
        raise_if_disk_full(path, error)
        raise
    finally:
        temporary.unlink(missing_ok=True)
        if made_parent and not done:
            with suppress(OSError):  # others may have written into it meanwhile
                path.parent.rmdir()


def raise_if_disk_full(path: Path | str, error: OSError) -> None:
    """Turn "the disk took no more" into the one line a user needs; libraries report it in several ways."""
    no_room = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    # Pillow's encoders and numpy's tofile report a failed write by words of their own and lose the system's number.
    text = str(error)
    library_failed = error.errno is None and (
        "when writing image file" in text or ("requested and" in text and "written" in text)
    )
    if no_room or library_failed:
        raise DiskFullError(
            f"{as_asked(path)} could not be written: the disk is full; free some space and run the command again"
        ) from None


@contextmanager
def atomic_directory(
    path: Path, replace: bool = False, *, holds: str | None = None, inputs: Sequence[Path] = ()
) -> Iterator[Path]:
    """Yield a temporary sibling directory that becomes `path` on success and disappears on any failure.

    Args:
        replace: whether what is at `path` may go; an empty directory counts as absent.
        holds: a file by which earlier outputs are told: a directory without it is never replaced.
        inputs: what the output is made from; a place that holds one of them is never replaced.

    Raises SplashbenchError where there is something at `path` that may not be replaced.
    """
    path = Path(path).resolve()  # a link stays and its target is replaced
    _require_replaceable(path, replace, holds, inputs)
    require_folder_place(path.parent if path.exists() else path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _sibling(path)
    retired = _sibling(path)
    try:
        temporary.mkdir()
        yield temporary
        # Again, as another process may have made its own meanwhile.
        _require_replaceable(path, replace, holds, inputs)
        if path.exists():
            path.rename(retired)
        temporary.rename(path)
    except OSError as error:
        raise_if_disk_full(path, error)
        raise
    finally:
        # A failed rename must not cost the user what was there before.
        if retired.exists() and not path.exists():
            retired.rename(path)
        for leftover in (temporary, retired):
            shutil.rmtree(leftover, ignore_errors=True)


def _require_replaceable(path: Path, replace: bool, holds: str | None, inputs: Sequence[Path]) -> None:
    """Raise SplashbenchError unless an output may take the place `path`, resolved."""
    for source in inputs:
        if Path(source).resolve().is_relative_to(path):
            raise SplashbenchError(f"{path} holds the input {source}; give another place for the output")
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    if not replace:
        raise SplashbenchError(f"{path} exists already; give another place, or --replace to replace it")
    if not path.is_dir():
        raise SplashbenchError(f"{path} is a file; give the name of a folder")
    if holds is not None and not (path / holds).is_file():
        raise SplashbenchError(f"{path} is no earlier output (it has no {holds}) and stays; give another place")


@contextmanager
def files_together(directory: Path) -> Iterator[Path]:
    """Yield a temporary sibling of `directory`; on success its files move into `directory`, on failure none does.

    Unlike `atomic_directory` it leaves other files in `directory` where they are.
    """
    directory = Path(directory).resolve()  # "." has no name to put one beside, and a link may lead to another disk
    require_folder_place(directory)
    directory.parent.mkdir(parents=True, exist_ok=True)
    staging = _sibling(directory)
    try:
        staging.mkdir()
        yield staging
        directory.mkdir(exist_ok=True)
        for path in sorted(staging.iterdir()):
            path.replace(directory / path.name)
    except OSError as error:
        raise_if_disk_full(directory, error)
        raise
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def require_file_place(path: Path) -> None:
    """Raise SplashbenchError where a file cannot take the place `path`: before long work."""
    if Path(path).is_dir():
        raise SplashbenchError(f"{path} is a folder; give the name of a file")
    require_folder_place(Path(path).parent)


def require_folder_place(directory: Path) -> None:
    """Raise SplashbenchError where `directory` is or lies below a file, or may not be written: before long work."""
    place = Path(directory).resolve()
    while not place.exists():
        place = place.parent
    if not place.is_dir():
        raise SplashbenchError(f"{place} is a file; give another place for {directory}")
    if not os.access(place, os.W_OK | os.X_OK):
        raise SplashbenchError(f"{place} may not be written; give another place for {directory}")


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, data: Any) -> None:
    """Write `data` as indented JSON, whole or not at all. NaN and infinity are refused: JSON has neither."""
    write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")


def require_plain_file(path: Path) -> None:
    """Raise SplashbenchError for a folder, a pipe or a device: reading it would fail oddly, or wait for ever.

    A file that does not exist is left to the reader.
    """
    if path.exists() and not path.is_file():
        raise SplashbenchError(
            f"{path} is {'a folder' if path.is_dir() else 'a device or pipe'}, not a file; restore it"
        )


def read_json(path: Path) -> Any:
    """Read a JSON file. Raises SplashbenchError when it is missing, too large or not JSON."""
    path = Path(path)
    try:
        require_plain_file(path)
        if path.stat().st_size > MAX_JSON_BYTES:
            raise SplashbenchError(f"{path} is larger than {MAX_JSON_BYTES >> 20} MiB; this is not a file of ours")
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SplashbenchError(f"{path} does not exist; check the path, or make the folder anew") from None
    except (OSError, ValueError, RecursionError) as error:
        raise SplashbenchError(f"{path} cannot be read as JSON ({error}); mend or restore it") from None


def validate_model(path: Path, model: type[Model], data: Any) -> Model:
    """Validate `data`, read from `path`, against a pydantic model; the first fault becomes the one-line error."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the whole file"
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        fault = first["msg"].removeprefix("Value error, ")
        raise SplashbenchError(f"{path}: {place}: {fault}{more}; mend this entry") from None


def read_model(path: Path, model: type[Model]) -> Model:
    """Read a JSON file as a pydantic model."""
    return validate_model(path, model, read_json(path))


def write_model(path: Path, model: BaseModel) -> None:
    """Write a pydantic model as JSON, whole or not at all."""
    write_text(path, model.model_dump_json(indent=1) + "\n")


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image in pixels, from its header alone."""
    from PIL import Image, UnidentifiedImageError

    path = Path(path)
    try:
        require_plain_file(path)
        with warnings.catch_warnings():
            # The limit below is lower than Pillow's; one line says so.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=_IMAGE_FORMATS) as image:
                size = (int(image.width), int(image.height))
                mode = image.mode
    except FileNotFoundError:
        raise SplashbenchError(f"{path} does not exist; restore the file") from None
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError, ValueError) as error:
        raise SplashbenchError(f"{path} is not a readable image ({error}); restore the file") from None
    if size[0] * size[1] > MAX_PIXELS:
        raise SplashbenchError(f"{path} is {size[0]}x{size[1]}, more than {MAX_PIXELS} pixels; scale it down")
    if mode.startswith(("I", "F")):
        raise SplashbenchError(f"{path} has more than 8 bits per channel; write it as an 8-bit image")
    return size


def _read_pixels(path: Path, mode: str) -> NDArray[np.uint8]:
    from PIL import Image

    image_size(path)
    try:
        with Image.open(path, formats=_IMAGE_FORMATS) as image:
            return np.asarray(image.convert(mode))
    except (OSError, SyntaxError, ValueError, MemoryError) as error:
        raise SplashbenchError(f"{path} is cut short or damaged ({error}); restore the file") from None


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read an image file as sRGB uint8 [H, W, 3]; transparency is dropped."""
    return _read_pixels(Path(path), "RGB")


def read_rgba(path: Path) -> NDArray[np.uint8]:
    """Read an image file as sRGB and opacity, uint8 [H, W, 4]; one without an alpha channel is refused."""
    from PIL import Image

    path = Path(path)
    image_size(path)
    with Image.open(path, formats=_IMAGE_FORMATS) as image:
        if "A" not in image.getbands():
            raise SplashbenchError(f"{path} has no alpha channel (it is {image.mode}); restore the RGBA file")
    return _read_pixels(path, "RGBA")


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


def read_npz(
    path: Path,
    names: Mapping[str, int],
    optional: Mapping[str, int] | None = None,
    *,
    max_bytes: int | None = None,
) -> dict[str, Any]:
    """Read named arrays with the number of dimensions given, without pickles and within limits.

    Returns the arrays of `names`, and those of `optional` that are there. Raises SplashbenchError when the file is
    missing, holds too much, or an array is absent, of another rank, not numeric, or not finite.
    """
    path = Path(path)
    limit = MAX_NPZ_BYTES if max_bytes is None else max_bytes
    try:
        require_plain_file(path)
        with zipfile.ZipFile(path) as archive:
            # The sizes are the archive's claims, but numpy's reader never inflates beyond them.
            if sum(entry.file_size for entry in archive.infolist()) > limit:
                raise SplashbenchError(f"{path} unpacks to more than {limit / 2**30:.3g} GiB; refused")
        with np.load(path, allow_pickle=False) as archive:
            missing = [name for name in names if name not in archive.files]
            if missing:
                raise SplashbenchError(f"{path} lacks the array {missing[0]!r}; write it again")
            wanted = dict(names) | {name: rank for name, rank in (optional or {}).items() if name in archive.files}
            arrays = {name: archive[name] for name in wanted}
    except FileNotFoundError:
        raise SplashbenchError(f"{path} does not exist; check the path") from None
    # zipfile: RuntimeError for encrypted archives, NotImplementedError for compressions it does not know.
    except (
        OSError,
        ValueError,
        zipfile.BadZipFile,
        EOFError,
        KeyError,
        MemoryError,
        RuntimeError,
        zlib.error,
    ) as error:
        raise SplashbenchError(f"{path} is not a readable .npz without pickles ({error}); write it again") from None
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray):  # numpy hands out what is no array as bytes
            raise SplashbenchError(f"{path}: {name} is no array; write it again")
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

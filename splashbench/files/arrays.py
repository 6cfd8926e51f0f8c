"""Archives of arrays (.npz) from strangers: no pickles, bounded sizes, finite numbers."""

from __future__ import annotations

import bz2
import math
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.files.atomic import atomic_path
from splashbench.files.places import require_plain_file

MAX_NPZ_BYTES = 4 << 30
# zipfile: RuntimeError for encrypted archives, NotImplementedError for compressions that it does not know.
_DAMAGED = (OSError, ValueError, EOFError, KeyError, MemoryError, RuntimeError, zipfile.BadZipFile, zlib.error)

# LZMA is not among them: its decoder allocates what a file asks for.
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2)


def write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays as an .npz that is compressed by bzip2, atomically: smaller than numpy's own by a third where
    they are whole numbers of little entropy, and read by `numpy.load` as well. The same arrays give the same bytes."""
    with atomic_path(Path(path)) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_BZIP2) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asarray(array, order="C"), allow_pickle=False)


def compressed_bytes(arrays: Mapping[str, np.ndarray]) -> int:
    """How large the file of `write_npz` gets, to within a few hundred bytes."""
    return sum(len(bz2.compress(np.ascontiguousarray(array).tobytes())) for array in arrays.values())


def _require_its_size(stream: IO[bytes], entry: zipfile.ZipInfo) -> None:
    """Raise ValueError where an array's header states another size than the archive: numpy allocates what it states."""
    try:
        version = np.lib.format.read_magic(stream)
    except ValueError:
        return  # no array, which is said later if it is asked for
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"{entry.filename} has a header of version {version}")
    shape, _, kind = readers[version](stream)
    if kind.hasobject:
        return  # which is refused later
    if stream.tell() + math.prod(shape) * kind.itemsize != entry.file_size:
        raise ValueError(f"{entry.filename} states {kind} {shape} in {entry.file_size} bytes")


def read_npz(
    path: Path,
    names: Mapping[str, int],
    optional: Mapping[str, int] | None = None,
    *,
    max_bytes: int | None = None,
) -> dict[str, Any]:
    """Read named arrays with the number of dimensions given, without pickles and within limits.

    `names` and `optional` map an array's name to its number of dimensions. Returns the arrays of `names`, and those of
    `optional` that exist. Raises SplashbenchError where the file is missing or too large, or where an array is absent,
    of another rank, not numeric or not finite.
    """
    path = Path(path)
    limit = MAX_NPZ_BYTES if max_bytes is None else max_bytes
    try:
        require_plain_file(path)
        with zipfile.ZipFile(path) as archive:
            # The sizes are the archive's claims, but numpy's reader never inflates beyond them.
            entries = archive.infolist()
            if sum(entry.file_size for entry in entries) > limit:
                raise SplashbenchError(f"{path} unpacks to more than {limit / 2**30:.3g} GiB; refused")
            unknown = [entry.filename for entry in entries if entry.compress_type not in _COMPRESSIONS]
            if unknown:
                raise NotImplementedError(f"{unknown[0]!r} is neither deflated nor bzipped")
            for entry in entries:
                with archive.open(entry) as stream:
                    _require_its_size(stream, entry)
        with np.load(path, allow_pickle=False) as archive:
            missing = [name for name in names if name not in archive.files]
            if missing:
                raise SplashbenchError(f"{path} lacks the array {missing[0]!r}; write it again")
            ranks = dict(names) | {name: rank for name, rank in (optional or {}).items() if name in archive.files}
            arrays = {name: archive[name] for name in ranks}
    except FileNotFoundError:
        raise SplashbenchError(f"{path} does not exist; check the path") from None
    except _DAMAGED as error:
        raise SplashbenchError(f"{path} is not a readable .npz without pickles ({error}); write it again") from None
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray):  # numpy hands out what is no array as bytes
            raise SplashbenchError(f"{path}: {name} is not an array; write it again")
        if array.ndim != ranks[name]:
            raise SplashbenchError(f"{path}: {name} has {array.ndim} dimensions, not {ranks[name]}; write it again")
        if array.dtype.kind not in "biuf":
            raise SplashbenchError(f"{path}: {name} holds {array.dtype}, not numbers; write it again")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise SplashbenchError(f"{path}: {name} has NaN or infinite entries; write finite numbers")
    return arrays

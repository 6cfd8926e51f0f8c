"""Archives of arrays (.npz) from strangers: no pickles, bounded sizes, finite numbers.

An array's header is held against the archive before anything is allocated, and only arrays that are asked for are
unpacked.
"""

from __future__ import annotations

import bz2
import copy
import io
import math
import warnings
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files.atomic import atomic_path
from splashbench.files.plain import open_plain

#: Of all arrays of a file together, unpacked.
MAX_NPZ_BYTES = 2 << 30
MAX_ARRAYS = 1000
# zipfile: RuntimeError for encrypted archives, NotImplementedError for compressions that it does not know.
_DAMAGED = (OSError, ValueError, EOFError, KeyError, MemoryError, RuntimeError, zipfile.BadZipFile, zlib.error)

# LZMA is not among them: its decoder allocates what a file asks for. bzip2 is unpacked by `_Bunzipped`.
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2)
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
_LARGEST_NUMBER = 8  # bytes
_MAX_DIMENSIONS = 16
# zipfile reads the list of entries in one go: as long as the file says, each of them some 600 bytes in memory.
_MAX_READ = 4 << 20
_CHUNK = 1 << 20


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


class _ShortReads(io.RawIOBase):
    """A file that gives no more than _MAX_READ bytes at once."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return self._stream.seek(offset, whence)

    def tell(self) -> int:
        return self._stream.tell()

    def read(self, size: int = -1) -> bytes:
        content = self._stream.read(_MAX_READ + 1 if size < 0 else min(size, _MAX_READ + 1))
        if len(content) > _MAX_READ:
            raise ValueError("its list of entries is too long")
        return content


def read_npz(
    path: Path,
    names: Mapping[str, int],
    optional: Mapping[str, int] | None = None,
    *,
    max_bytes: int | None = None,
) -> dict[str, NDArray[Any]]:
    """Read named arrays with the number of dimensions given, without pickles and within limits.

    `names` and `optional` map an array's name to its number of dimensions. Returns the arrays of `names`, and those of
    `optional` that exist. Raises SplashbenchError where the file is missing or too large, or where an array is absent,
    of another rank, not numeric or not finite.
    """
    path = Path(path)
    limit = MAX_NPZ_BYTES if max_bytes is None else max_bytes
    try:
        with open_plain(path) as (stream, _), zipfile.ZipFile(_ShortReads(stream)) as archive:
            entries = {entry.filename: entry for entry in archive.infolist()}
            _require_bounded(path, archive.infolist(), limit)
            ranks = dict(names) | {name: rank for name, rank in (optional or {}).items() if _entry(entries, name)}
            arrays = {}
            for name, rank in ranks.items():
                if (entry := _entry(entries, name)) is None:
                    raise SplashbenchError(f"{path} lacks the array {name!r}; write it again")
                with _opened(archive, entry) as member:
                    arrays[name] = _read_array(path, name, rank, member, entry.file_size)
    except FileNotFoundError:
        raise SplashbenchError(f"{path} does not exist; check the path") from None
    except _DAMAGED as error:
        raise SplashbenchError(f"{path} is not a readable .npz without pickles ({error}); write it again") from None
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise SplashbenchError(f"{path}: {name} has NaN or infinite entries; write finite numbers")
    return arrays


def _require_bounded(path: Path, entries: list[zipfile.ZipInfo], limit: int) -> None:
    """Raise for what an archive's list of entries says already. Sizes are its claims; nothing is read beyond them."""
    if len(entries) > MAX_ARRAYS:
        raise SplashbenchError(f"{path} holds more than {MAX_ARRAYS} arrays; refused")
    if sum(entry.file_size for entry in entries) > limit:
        raise SplashbenchError(f"{path} unpacks to more than {limit / 2**30:.3g} GiB; refused")
    unknown = [entry.filename for entry in entries if entry.compress_type not in _COMPRESSIONS]
    if unknown:
        raise NotImplementedError(f"{unknown[0]!r} is neither deflated nor bzipped")


class _Bunzipped(io.RawIOBase):
    """The content of a bzipped `entry` of an archive, from its packed bytes.

    zipfile unpacks all that it has read of these at once, which for a few kilobytes may be gigabytes; bz2 does not.
    Raises BadZipFile at the end where the checksum is another, and where there is more than the entry states.
    """

    def __init__(self, packed: IO[bytes], entry: zipfile.ZipInfo) -> None:
        self._packed, self._stream, self._entry = packed, bz2.BZ2File(packed), entry
        self._place, self._checksum = 0, 0

    def readable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._place

    def read(self, size: int = -1) -> bytes:
        left = self._entry.file_size - self._place
        content = self._stream.read(left + 1 if size < 0 else min(size, left + 1))
        self._place += len(content)
        self._checksum = zlib.crc32(content, self._checksum)
        wrong = size != 0 and not content and self._checksum != self._entry.CRC
        if wrong or self._place > self._entry.file_size:
            raise zipfile.BadZipFile(f"{self._entry.filename!r} is damaged")
        return content

    def close(self) -> None:
        self._stream.close()
        self._packed.close()
        super().close()


def _opened(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> IO[bytes]:
    """The content of an entry, of which no more is held at once than is asked for."""
    if entry.compress_type != zipfile.ZIP_BZIP2:
        return archive.open(entry)
    packed = copy.copy(entry)
    packed.compress_type, packed.file_size = zipfile.ZIP_STORED, entry.compress_size
    del packed.CRC  # of what is unpacked: zipfile compares none then
    return cast(IO[bytes], _Bunzipped(archive.open(packed), entry))


def _entry(entries: Mapping[str, zipfile.ZipInfo], name: str) -> zipfile.ZipInfo | None:
    return entries.get(f"{name}.npy") or entries.get(name)


def _read_array(path: Path, name: str, rank: int, stream: IO[bytes], size: int) -> NDArray[Any]:
    """The array in `stream`, of `size` bytes with its header. numpy would allocate whatever the header states."""
    try:
        version = np.lib.format.read_magic(stream)
    except ValueError:
        raise SplashbenchError(f"{path}: {name} is not an array; write it again") from None
    if version not in _HEADERS:
        raise ValueError(f"{name} has a header of version {version}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of notations of old
            shape, in_columns, kind = _HEADERS[version](stream)
    # A header is Python's own notation, and numpy lets whatever reading that raises through.
    except Exception as error:
        raise ValueError(f"{name} has no valid header ({str(error)[:200]})") from None
    if kind.hasobject:
        raise ValueError(f"{name} holds objects")
    if len(shape) != rank:
        raise SplashbenchError(f"{path}: {name} has {len(shape)} dimensions, not {rank}; write it again")
    if kind.kind not in "biuf" or kind.itemsize > _LARGEST_NUMBER:
        raise SplashbenchError(f"{path}: {name} holds {kind}, not numbers; write it again")
    n_bytes = math.prod(shape) * kind.itemsize
    if min(shape, default=0) < 0 or len(shape) > _MAX_DIMENSIONS or stream.tell() + n_bytes != size:
        raise ValueError(f"{name} states {kind} {shape} in {size} bytes")
    array: NDArray[Any] = np.empty(math.prod(shape), kind)
    target = array.view(np.uint8)
    for start in range(0, n_bytes, _CHUNK):
        part = stream.read(min(_CHUNK, n_bytes - start))
        if len(part) != min(_CHUNK, n_bytes - start):
            raise EOFError(f"{name} ends early")
        target[start : start + len(part)] = np.frombuffer(part, np.uint8)
    stream.read(1)  # beyond the end: zipfile compares the checksum then
    return array.reshape(shape[::-1]).T if in_columns else array.reshape(shape)

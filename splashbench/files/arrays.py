"""Archives of arrays (.npz) from strangers: no pickles, bounded sizes, finite numbers."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.files.places import require_plain_file

MAX_NPZ_BYTES = 4 << 30
# zipfile: RuntimeError for encrypted archives, NotImplementedError for compressions that it does not know.
_DAMAGED = (OSError, ValueError, EOFError, KeyError, MemoryError, RuntimeError, zipfile.BadZipFile, zlib.error)


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
            if sum(entry.file_size for entry in archive.infolist()) > limit:
                raise SplashbenchError(f"{path} unpacks to more than {limit / 2**30:.3g} GiB; refused")
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

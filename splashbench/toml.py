"""TOML in and out: the standard library's reader (or its backport on Python 3.10) and the tomli-w writer."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import tomli_w

from splashbench.errors import SplashbenchError
from splashbench.files import require_plain_file

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_MAX_BYTES = 1 << 20


def load(path: Path) -> dict[str, Any]:
    """Read a TOML file. Raises SplashbenchError naming the file when it is missing, too large or not TOML."""
    path = Path(path)
    try:
        require_plain_file(path)
        if path.stat().st_size > _MAX_BYTES:
            raise SplashbenchError(f"{path} is larger than {_MAX_BYTES} bytes; this is no description file")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SplashbenchError(f"{path} does not exist; check the path") from None
    except (OSError, ValueError, RecursionError) as error:
        raise SplashbenchError(f"{path} cannot be read as TOML ({error}); mend or restore it") from None


def dumps(data: dict[str, Any]) -> str:
    """The TOML text of `data`, keys in the order given. Values may not be None: TOML has no null."""
    return tomli_w.dumps(data)

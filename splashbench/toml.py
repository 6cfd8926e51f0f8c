"""TOML files: read by the standard library (its backport on Python 3.10), written by tomli-w."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import tomli_w

from splashbench.files import read_document

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_MAX_BYTES = 1 << 20


def load(path: Path) -> dict[str, Any]:
    """Read a TOML file. Raises SplashbenchError where it is missing, too large or not TOML."""
    return read_document(path, "TOML", tomllib.loads, _MAX_BYTES)


def dumps(data: dict[str, Any]) -> str:
    """The TOML text of `data`, keys in the order given. Values may not be None: TOML has no null."""
    return tomli_w.dumps(data)

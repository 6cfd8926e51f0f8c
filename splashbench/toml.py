"""TOML files: read by the standard library (its backport on Python 3.10), written by tomli-w."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import tomli_w

from splashbench.files import MAX_NESTING, read_document

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_MAX_BYTES = 1 << 20
# Texts and comments, in which nothing is nested. A text that is not closed reaches to the end, and is the parser's to
# report: looking for its end anew at every later quotation mark would take the square of the length.
_TEXTS = re.compile(
    r'"""(?:\\.|[^\\"]|"(?!""))*"{3,5}|"""[\s\S]*'
    r"|'''(?:[^']|'(?!''))*'{3,5}|'''[\s\S]*"
    r'|"(?:\\.|[^"\\\n])*"|"[\s\S]*'
    r"|'[^'\n]*'|'[\s\S]*"
    r"|#[^\n]*",
    re.DOTALL,
)
_WORDS, _SPACES = re.compile(r"[\w+-]+"), re.compile(r"[ \t]+")


def load(path: Path) -> dict[str, Any]:
    """Read a TOML file. Raises SplashbenchError where it is missing, too large, nested too deep or not TOML."""
    return read_document(path, "TOML", _parse, _MAX_BYTES)


def _parse(text: str) -> dict[str, Any]:
    # The parser keeps every beginning of a key a.b.c: time and memory by the square of its length.
    bare = _SPACES.sub("", _WORDS.sub("k", _TEXTS.sub("k", text)))
    if "k." * MAX_NESTING in bare:
        raise ValueError(f"a key of more than {MAX_NESTING} parts")
    return tomllib.loads(text)


def dumps(data: dict[str, Any]) -> str:
    """The TOML text of `data`, keys in the order given. Values may not be None: TOML has no null."""
    return tomli_w.dumps(data)

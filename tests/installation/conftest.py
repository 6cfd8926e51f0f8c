"""Shared by the tests of the build: the build's own modules, and stand-ins for compilers."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# The build's modules are beside the package and not in it. From here on any test can import them.
sys.path.insert(0, str(ROOT))
import build_compilers  # noqa: E402, F401
import build_kernel  # noqa: E402, F401

sys.path.remove(str(ROOT))

# A stand-in for a compiler: notes its arguments, writes the file that -o names, fails where told to.
STAND_IN = """#!/bin/sh
if [ "$1" = --version ]; then echo "stand-in {version}"; exit 0; fi
echo "$*" >> "$0.log"
failed=0
for word in "$@"; do case "$word" in {refused}) failed=1;; esac; done
while [ $# -gt 0 ]; do if [ "$1" = -o ]; then echo made > "$2"; fi; shift; done
if [ $failed = 1 ]; then echo "stand-in: cannot" >&2; fi
exit $failed
"""


def _stand_in(path: Path, refused: str = "nothing", version: str = "1") -> Path:
    """A compiler at `path` that fails where an argument matches the shell pattern `refused`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(STAND_IN.format(refused=refused, version=version), encoding="utf-8")
    path.chmod(0o755)
    return path


def _calls(compiler: Path) -> list[str]:
    """The arguments of each call of a stand-in since the last time."""
    log = compiler.with_name(compiler.name + ".log")
    lines = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
    log.unlink(missing_ok=True)
    return lines


@pytest.fixture(scope="session")
def stand_in() -> Callable[..., Path]:
    return _stand_in


@pytest.fixture(scope="session")
def calls() -> Callable[[Path], list[str]]:
    return _calls

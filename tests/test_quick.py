"""`make quick-test` names files that exist, and something of every folder of tests."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: What takes minutes by its nature: wheels are built.
_SLOW = {"installation"}


def quick_files() -> list[Path]:
    """The files of `make quick-test`, from the Makefile."""
    if not (ROOT / "Makefile").is_file():
        pytest.skip("the Makefile is not beside the tests")
    text = (ROOT / "Makefile").read_text(encoding="utf-8").replace("\\\n", " ")
    (names,) = re.findall(r"^QUICK := (.*)$", text, re.MULTILINE)
    groups = re.findall(r"\$\(addprefix ([^,]+), ([^)]*)\)", names)
    return [ROOT / f"{prefix}{name}" for prefix, group in groups for name in group.split()]


def test_every_file_exists() -> None:
    files = quick_files()
    assert files
    assert [path.relative_to(ROOT).as_posix() for path in files if not path.is_file()] == []


def test_every_folder_is_represented() -> None:
    tests = ROOT / "tests"
    folders = {path.relative_to(tests).parts[0] for path in tests.glob("*/**/test_*.py")} - _SLOW
    assert folders - {path.relative_to(tests).parts[0] for path in quick_files()} == set()

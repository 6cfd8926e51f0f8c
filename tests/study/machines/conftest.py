"""Fixtures for studies that run as processes, here and on Ray."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))  # for the module beside this one


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A folder on a disk of 200 MB; the test skips where none can be mounted."""
    place = tmp_path / "small"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=200m", "tmpfs", str(place)], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("no file system can be mounted here (that takes root)")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=False)


@pytest.fixture(params=["here", pytest.param("ray", marks=pytest.mark.slow)])
def place(request: pytest.FixtureRequest) -> list[str]:
    """The words that say where runs are made: here, two at once, or on Ray."""
    if request.param == "here":
        return ["--jobs", "2"]
    pytest.importorskip("ray", reason="comes with the extra [cluster]")
    return ["--on", "ray", "--jobs", "2"]

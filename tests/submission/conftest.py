"""What the tests of submissions share: one of the oracle on the scene of balls, and copies to damage."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from splashbench.harness.oracle import write_oracle
from splashbench.scene import Scene


@pytest.fixture(scope="session")
def sealed(balls: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Read-only; use `copy` to change something."""
    directory = tmp_path_factory.mktemp("submission") / "oracle"
    write_oracle(balls, directory)
    return directory


@pytest.fixture
def copy(sealed: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(sealed, tmp_path / "copy"))

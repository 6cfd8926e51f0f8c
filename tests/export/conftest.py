"""A submission whose every number is known, and readers of exports that share nothing with their writers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from splashbench.harness.contract import Fitted
from splashbench.harness.runner import run_method
from splashbench.replay import Reconstruction, load

METHOD = f"{Path(__file__).with_name('exact_balls.py')}:Exact"


@pytest.fixture(scope="session")
def exact(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The submission of the method that knows the balls; not to be changed."""
    directory = tmp_path_factory.mktemp("submissions") / "exact"
    run_method(METHOD, balls_directory, directory, timing_frames=0)
    return directory


@pytest.fixture(scope="session")
def known(exact: Path) -> Reconstruction:
    """That submission, opened without its scene."""
    return load(exact, method=METHOD)


@pytest.fixture(scope="session")
def oracle(balls_directory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A submission without a model, whose particles are the truth; not to be changed."""
    directory = tmp_path_factory.mktemp("submissions") / "oracle"
    run_method("oracle", balls_directory, directory, timing_frames=0)
    return directory


def showing(reconstruction: Reconstruction, fitted: Fitted) -> Reconstruction:
    """`reconstruction` with another model."""
    return Reconstruction(reconstruction.submission, fitted, reconstruction._known, reconstruction.scene)


def read_points(path: Path) -> dict[str, np.ndarray]:
    """Properties of the points of a .ply by name, as trimesh reads them."""
    rows = trimesh.load(path, process=False).metadata["_ply_raw"]["vertex"]["data"]
    return {name: np.asarray(rows[name]).ravel() for name in rows.dtype.names}


def columns(points: dict[str, np.ndarray], *names: str) -> np.ndarray:
    """The properties `names` as [N, len(names)]."""
    return np.stack([points[name] for name in names], axis=1).astype(np.float64)

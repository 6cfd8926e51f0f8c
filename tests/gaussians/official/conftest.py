"""What tests of official models share: exports of two scenes, and helper modules beside this file by their names."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from splashbench.gaussians.torch_threads import one_torch_thread
from splashbench.observe import initial_points
from splashbench.scene import Scene
from splashbench.scene.export import export_scene
from splashbench.synth.balls import write_balls_scene

# Tests are collected one by one, without a package about them: helpers are imported by their bare names.
for _name in ("official_reference", "official_layouts", "official_comparison"):
    _spec = importlib.util.spec_from_file_location(_name, Path(__file__).with_name(f"{_name}.py"))
    assert _spec is not None
    assert _spec.loader is not None
    sys.modules[_name] = importlib.util.module_from_spec(_spec)
    _spec.loader.exec_module(sys.modules[_name])

POINTS = 20


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


@pytest.fixture(scope="module")
def nerfies(balls: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("nerfies") / "NeRF" / "balls"
    export_scene(balls, out, "nerfies", initial_points(balls, POINTS))
    return out


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A scene whose cameras each have a clock of their own."""
    return write_balls_scene(tmp_path_factory.mktemp("scenes") / "balls", delays={"2": 0.011, "6": 0.017, "7": -0.006})


@pytest.fixture(scope="module")
def blender(late: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("blender") / "balls"
    export_scene(late, out, "blender", initial_points(late, POINTS), test_images="blank")
    return out

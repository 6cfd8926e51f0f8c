"""`from splashbench import Method, Scene, ...`: the names that CONTRIBUTING.md teaches, imported when asked for."""

import subprocess
import sys

import pytest

import splashbench
from splashbench import errors, replay, submission
from splashbench.harness import contract
from splashbench.scene import Camera, Gaussians, Particles, Scene, SignedDistance, TrainingScene, VelocityField


def test_each_name_is_the_one_of_its_room() -> None:
    expected = {
        "SplashbenchError": errors.SplashbenchError,
        "Submission": submission.Submission,
        **{name: getattr(contract, name) for name in ("Fitted", "Method", "MethodConfig", "Render", "Run", "Support")},
        **{one.__name__: one for one in (Camera, Gaussians, Particles, Scene, SignedDistance, TrainingScene)},
        **{one.__name__: one for one in (VelocityField, replay.Reconstruction, replay.load)},
    }
    assert sorted(expected) == sorted(set(splashbench.__all__) - {"__version__"})
    for name, value in expected.items():
        assert getattr(splashbench, name) is value, name


def test_names_are_listed_before_they_are_imported_and_nothing_heavy_comes_along() -> None:
    code = """
import sys, splashbench
assert set(splashbench.__all__) <= set(dir(splashbench))
assert "Scene" not in vars(splashbench)
heavy = {"numpy", "pydantic", "torch", "splashbench.scene"} & set(sys.modules)
assert not heavy, heavy
from splashbench import *
assert Method.__module__ == "splashbench.harness.contract"
assert "torch" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_name_that_is_not_there_is_told() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'Methods'"):
        _ = splashbench.Methods  # type: ignore[attr-defined]

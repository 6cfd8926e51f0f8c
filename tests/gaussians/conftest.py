"""What tests of the shared Gaussians need: one torch thread, a scene of cameras with clocks, and a model that stays."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from splashbench.gaussians.torch_threads import one_torch_thread

_spec = importlib.util.spec_from_file_location("still_gaussians", Path(__file__).with_name("still_gaussians.py"))
assert _spec is not None
assert _spec.loader is not None
sys.modules["still_gaussians"] = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(sys.modules["still_gaussians"])


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield

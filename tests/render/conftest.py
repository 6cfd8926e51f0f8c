"""Shared by the renderer's tests: the definition in reference.py, and torch on one thread (the tensors are small)."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from splashbench.gaussians.torch_threads import one_torch_thread


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread():
        yield


@pytest.fixture(scope="session")
def reference() -> ModuleType:
    """The module reference.py: the renderer in plain torch."""
    spec = importlib.util.spec_from_file_location("render_reference", Path(__file__).with_name("reference.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module

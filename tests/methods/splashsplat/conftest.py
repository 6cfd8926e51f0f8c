"""Shared by SplashSplat's tests: torch on one thread, since the tensors are small."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from splashbench.gaussians.torch_threads import one_torch_thread


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread():
        yield

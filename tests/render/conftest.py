"""The reference renderer works on small tensors: more torch threads only get in each other's way."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from splashbench.render.torch_threads import one_torch_thread


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_torch_thread():
        yield

"""Shared by the tests of the CUDA backend: gsplat on a CUDA device where there is one, and its stand-in everywhere.

The stand-in renders CPU tensors. It checks what is passed to gsplat and what is made of its answers.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

sys.path.insert(0, str(Path(__file__).parent))  # for the modules beside this one
from cuda_comparison import VIEW, ComparedBackend, random_gaussians
from gsplat_stand_in import GsplatStandIn, install

from splashbench.render import cuda, rasterize


@pytest.fixture(autouse=True)
def _found_out_anew() -> Iterator[None]:
    cuda.available.cache_clear()
    yield
    cuda.available.cache_clear()


@pytest.fixture
def stand_in(reference: ModuleType, monkeypatch: pytest.MonkeyPatch) -> ComparedBackend:
    module = GsplatStandIn(reference)
    install(monkeypatch, module)
    return ComparedBackend(reference, "cpu", 1e-5, 1e-4, module.calls)


def _real_gsplat(reference: ModuleType) -> ComparedBackend:
    # gsplat compiles its kernels at first use; what that warns about is not this package's.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reason = cuda.available()
        if reason is not None:
            pytest.skip(reason)
        gaussians = random_gaussians(0, 4)
        rasterize(*(t.cuda() for t in gaussians), VIEW, backend="cuda")
    # gsplat's backward pass starts from 1 - opacity: in a pixel with the least transmittance, 1e-4, float32 leaves
    # 6e-4 of doubt about that.
    return ComparedBackend(reference, "cuda", 1e-3, 1e-3)


@pytest.fixture
def real(reference: ModuleType) -> ComparedBackend:
    return _real_gsplat(reference)


@pytest.fixture(params=["stand-in", pytest.param("gsplat", marks=pytest.mark.cuda)])
def backend(request: pytest.FixtureRequest, reference: ModuleType) -> ComparedBackend:
    if request.param == "gsplat":
        return _real_gsplat(reference)
    result: ComparedBackend = request.getfixturevalue("stand_in")
    return result

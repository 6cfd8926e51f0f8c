"""Which of the renderer's backends draws: the CPU kernel, or gsplat on a CUDA device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from splashbench.errors import SplashbenchError

BACKENDS = ("auto", "cpu", "cuda")


@dataclass(frozen=True)
class Backend:
    """A way to draw. `rasterize` takes means, factors, opacities, colors (or None) and a list of views, and returns
    (color, opacity) of each; a view is a camera's own arguments: camera, background, modes, frozen, depth, compact."""

    name: str
    rasterize: Callable[..., list[tuple[torch.Tensor, torch.Tensor]]]


def backend_for(name: str, means: Any) -> Backend:
    """The backend called `name`; "auto" is CUDA for tensors on a CUDA device, where gsplat is there, else the CPU.

    Raises ValueError for another name, SplashbenchError where CUDA is asked for and not there.
    """
    if name not in BACKENDS:
        raise ValueError(f"backend is {name!r}, not one of {', '.join(BACKENDS)}")
    if name == "cuda" or (name == "auto" and means.is_cuda):
        from splashbench.render import cuda

        reason = cuda.available()
        if reason is None:
            return Backend("cuda", cuda.rasterize)
        if name == "cuda":
            raise SplashbenchError(f"the renderer's CUDA backend cannot be used: {reason}")
    from splashbench.render import autograd

    return Backend("cpu", autograd.rasterize)

"""The CPU renderer as a torch function, for one camera or several at once."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from splashbench.render import cpu
from splashbench.render.arguments import GAUSSIANS, floats


class _Rasterize(torch.autograd.Function):
    """Inputs: means, factors, opacities, colors (None for none), and a view (camera and options) per camera.

    Outputs: color and opacity of each camera in turn.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means: torch.Tensor,
        factors: torch.Tensor,
        opacities: torch.Tensor,
        colors: torch.Tensor | None,
        views: list[dict[str, Any]],
    ) -> tuple[torch.Tensor, ...]:
        tensors = (means, factors, opacities, colors)
        per_view = colors is not None and colors.ndim == 3
        needs_gradients = any(t is not None and t.requires_grad for t in tensors)
        arrays = [floats(t, name) for t, name in zip(tensors[:3], GAUSSIANS)]
        channels = None if colors is None else floats(colors, "colors")
        renderings = []
        for i, view in enumerate(views):
            view_colors = channels[i] if per_view and channels is not None else channels
            renderings.append(
                cpu.forward(arrays[0], arrays[1], arrays[2], view_colors, **view, for_backward=needs_gradients)
            )
        if needs_gradients:
            ctx.renderings, ctx.per_view = renderings, per_view
            # The kernel reads the inputs again; torch notices where they were changed in place since.
            ctx.save_for_backward(*[t for t in tensors if t is not None])
        outputs = []
        for rendering in renderings:
            outputs += [torch.from_numpy(image).to(means.device) for image in (rendering.color, rendering.opacity)]
        ctx.set_materialize_grads(False)
        return tuple(outputs)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *outer: torch.Tensor | None) -> tuple:
        inputs = list(ctx.saved_tensors)
        total: tuple | None = None
        colors: list[np.ndarray] = []
        for i, rendering in enumerate(ctx.renderings):
            grads = [None if g is None else g.detach().cpu().numpy() for g in outer[2 * i : 2 * i + 2]]
            if ctx.per_view and total is not None:
                total = (*total[:3], np.zeros_like(total[3]))
            total = rendering.backward(*grads, add_to=total)
            if ctx.per_view:
                colors.append(total[3])
        assert total is not None
        arrays = [*total[:3], *([np.stack(colors)] if ctx.per_view else total[3:])]
        moved = [torch.from_numpy(array).to(t.device, t.dtype) for array, t in zip(arrays, inputs)]
        return (*moved, *([None] * (5 - len(moved))))


def rasterize(
    means: torch.Tensor,
    factors: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor | None,
    views: list[dict[str, Any]],
) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """(color, opacity) of each view: the keyword arguments of `cpu.forward`, `camera` among them."""
    outputs = _Rasterize.apply(means, factors, opacities, colors, views)
    return list(zip(outputs[::2], outputs[1::2]))

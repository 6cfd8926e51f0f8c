"""Static anchors to Gaussians, compiled, as a torch function (Lu et al. 2024, Sec. 3.2).

The definition in plain torch, with its equations, is the model's (../model.py), which CUDA devices take. Results and
gradients do not depend on the number of threads.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from splashbench.native import memory
from splashbench.native.library import DONE
from splashbench.native.threads import kernel_threads

from .library import KERNEL, AnchorGradientsStruct, AnchorsStruct, ChildrenStruct, HeadsStruct


@dataclass(frozen=True)
class Tables:
    """N anchors, float32. features: [N, F]; offsets: [N, K, 3]; log_scales: [N, 6]; positions: [N, 3]."""

    features: Tensor
    offsets: Tensor
    log_scales: Tensor
    positions: Tensor


@dataclass(frozen=True)
class Heads:
    """Weights of the opacity, shape and colour heads, float32, four each in the order of nn.Linear's parameters: hidden
    [H, F + 3] and [H], output [M, H] and [M], with M = K, 7K and 3K.

    shape_sees_direction: or else opacity and shape have zeros in its place. base_color: whether the first three
    features are added to the colours' logits.
    """

    weights: tuple[Tensor, ...]
    shape_sees_direction: bool
    base_color: bool


def decode(
    tables: Tables, heads: Heads, eye: Tensor, rows: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """n anchors as seen from `eye` [3]: means [n, K, 3], factors [n, K, 3, 3], opacities [n, K], colors [n, K, 3] and
    scales [n, K, 3] of their children; differentiable by all but positions and eye.

    rows: int64 [n], those to decode, each once; all by default. Raises TypeError or ValueError naming the argument.
    """
    _check(tables, heads, eye, rows)
    learned = (tables.features, tables.offsets, tables.log_scales, *heads.weights)
    needs_gradients = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in learned)
    return _Decode.apply(*learned, tables.positions, eye, rows, heads, needs_gradients)


def _check(tables: Tables, heads: Heads, eye: Tensor, rows: Tensor | None) -> None:
    if len(heads.weights) != 12 or tables.features.ndim != 2 or tables.offsets.ndim != 3 or heads.weights[1].ndim != 1:
        raise ValueError("there are three heads of four tensors, features [N, F] and offsets [N, K, 3]")
    (n, size), k, hidden = tables.features.shape, tables.offsets.shape[1], len(heads.weights[1])
    if k < 1 or (heads.base_color and size < 3):
        raise ValueError(f"{size} features and {k} children per anchor are too few")
    shapes: dict[str, tuple[Tensor, tuple[int, ...]]] = {
        "features": (tables.features, (n, size)),
        "offsets": (tables.offsets, (n, k, 3)),
        "log_scales": (tables.log_scales, (n, 6)),
        "positions": (tables.positions, (n, 3)),
        "eye": (eye, (3,)),
    }
    for number, (name, outputs) in enumerate((("opacity", k), ("shape", 7 * k), ("color", 3 * k))):
        expected = ((hidden, size + 3), (hidden,), (outputs, hidden), (outputs,))
        for part, shape in enumerate(expected):
            shapes[f"{name} head's tensor {part}"] = (heads.weights[4 * number + part], shape)
    for name, (value, shape) in shapes.items():
        if value.dtype != torch.float32 or value.device.type != "cpu":
            raise TypeError(f"{name} is {value.dtype} on {value.device}, not float32 on the CPU")
        if tuple(value.shape) != shape:
            raise ValueError(f"{name} is {list(value.shape)}, not {list(shape)}")
    if rows is None:
        return
    if rows.dtype != torch.int64 or rows.device.type != "cpu" or rows.ndim != 1:
        raise TypeError(f"rows is {rows.dtype} {list(rows.shape)} on {rows.device}, not int64 [n] on the CPU")
    if len(rows) and not (int(rows.min()) >= 0 and int(rows.max()) < n and bool((rows[1:] > rows[:-1]).all())):
        raise ValueError(f"rows is not ascending, or holds numbers outside 0 to {n - 1}")


def _address(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


def _empty(*shape: int) -> Tensor:
    return torch.from_numpy(memory.empty(shape))


class _Call:
    """What the kernel reads, in both directions: contiguous tensors, and the structures that point to them."""

    def __init__(self, learned: tuple[Tensor, ...], positions: Tensor, eye: Tensor, rows: Tensor | None, heads: Heads):
        features, offsets, log_scales, *weights = learned
        tables = (rows, features, offsets, log_scales, positions)
        self._alive = [None if t is None else t.detach().contiguous() for t in (*tables, *weights)]
        addresses = [_address(tensor) for tensor in self._alive]
        self.count, self.children = len(features) if rows is None else len(rows), offsets.shape[1]
        self.all_decoded = rows is None
        self.heads = HeadsStruct(
            features.shape[1],
            self.children,
            len(weights[1]),
            heads.shape_sees_direction,
            heads.base_color,
            (ctypes.c_void_p * 12)(*addresses[5:]),
        )
        self.anchors = AnchorsStruct(self.count, *addresses[:5], (ctypes.c_float * 3)(*eye.tolist()))


class _Decode(torch.autograd.Function):
    """Inputs: features, offsets, log_scales, the twelve weights; then positions, eye, rows, heads, and whether
    gradients are needed."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, ...]:
        learned, (positions, eye, rows, heads, needs_gradients) = inputs[:15], inputs[15:]
        call = _Call(learned, positions, eye, rows, heads)
        n, k, library = call.count, call.children, KERNEL.library
        children = [_empty(n, k, 3), _empty(n, k, 3, 3), _empty(n, k), _empty(n, k, 3), _empty(n, k, 3)]
        activations = _empty(library.splash_anchors_kept(ctypes.byref(call.heads), n)) if needs_gradients else None
        status = library.splash_anchors(
            ctypes.byref(call.heads),
            ctypes.byref(call.anchors),
            ctypes.byref(ChildrenStruct(*map(_address, children))),
            _address(activations),
            kernel_threads(),
        )
        if status != DONE:
            raise MemoryError("the anchors' decoder is out of memory: fewer anchors need less")
        if needs_gradients:
            ctx.call, ctx.activations = call, activations
            # The kernel reads the inputs again; torch notices where they were changed in place since.
            ctx.save_for_backward(*learned)
        ctx.set_materialize_grads(False)
        return tuple(children)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *outer: Tensor | None) -> tuple[Tensor | None, ...]:
        call: _Call = ctx.call
        learned = ctx.saved_tensors
        grad_children = [None if g is None else g.contiguous() for g in outer]
        by_tables = [torch.empty(t.shape) if call.all_decoded else torch.zeros(t.shape) for t in learned[:3]]
        by_weights = [torch.empty(weight.shape) for weight in learned[3:]]
        status = KERNEL.library.splash_anchors_backward(
            ctypes.byref(call.heads),
            ctypes.byref(call.anchors),
            _address(ctx.activations),
            ctypes.byref(ChildrenStruct(*map(_address, grad_children))),
            kernel_threads(),
            ctypes.byref(
                AnchorGradientsStruct(*map(_address, by_tables), (ctypes.c_void_p * 12)(*map(_address, by_weights)))
            ),
        )
        if status != DONE:
            raise MemoryError("the anchors' decoder is out of memory: fewer anchors need less")
        return (*by_tables, *by_weights, None, None, None, None, None)

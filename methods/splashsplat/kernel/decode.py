"""Carriers to Gaussians, compiled, as a torch function (SplashSplat, "Decoding Carriers into Gaussians").

Heads shared by all carriers turn a carrier's feature into K children: Gaussians in the carrier's frame diag(s), bent by
its deformation F. The definition in plain torch is the decoder of the method SplashSplat. What both compute, with
r = 2 tanh(residual / 2) and a for the mean of a child:

    a = x + F diag(s) o,   o = beta tanh(offset)
    B = F diag(s exp(eta r)) / sqrt(K)
    alpha = sigmoid(opacity) sigmoid(kappa (tau - |phi|)) visibility
    c = sigmoid(color(relu(hidden(feature, viewing direction))))

Results and gradients do not depend on the number of threads.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from splashbench.native import memory
from splashbench.native.library import DONE
from splashbench.native.threads import kernel_threads

from .library import KERNEL, CarriersStruct, ChildrenStruct, DecoderGradientsStruct, HeadsStruct

MAX_CHILDREN = 64


@dataclass(frozen=True)
class Heads:
    """The heads' weights [outputs, inputs] and biases [outputs], float32, in the order of nn.Linear's parameters.

    offset, scale: 3K outputs of F inputs; opacity: K of F; hidden: H of F + 3; color: 3K of H. offset_bound is beta,
    scale_range eta, opacity_slope kappa, opacity_band tau. separation_margin: distance of children, in carrier units,
    below which the separation penalty sets in.
    """

    offset: tuple[Tensor, Tensor]
    scale: tuple[Tensor, Tensor]
    opacity: tuple[Tensor, Tensor]
    hidden: tuple[Tensor, Tensor]
    color: tuple[Tensor, Tensor]
    offset_bound: float
    scale_range: float
    opacity_slope: float
    opacity_band: float
    separation_margin: float

    @property
    def weights(self) -> tuple[Tensor, ...]:
        """The ten tensors, in the kernel's order."""
        return (*self.offset, *self.scale, *self.opacity, *self.hidden, *self.color)


@dataclass(frozen=True)
class Instant:
    """n carriers as one camera sees them.

    positions: [n, 3], x; deformation: [n, 3, 3], F; phi: [n]; eye: [3], the camera. visibility: [n], opacities are
    multiplied by it; ones by default. cells: int64 [n], the cell of each carrier for the colour penalty, out of
    cell_count; without them there are no penalties.
    """

    positions: Tensor
    deformation: Tensor
    phi: Tensor
    eye: Tensor
    visibility: Tensor | None = None
    cells: Tensor | None = None
    cell_count: int = 0


class Decoded(NamedTuple):
    """K children of each carrier: means [n, K, 3], factors [n, K, 3, 3] of their covariances B B^T, opacities [n, K],
    colors [n, K, 3], offsets [n, K, 3] in carrier units.

    penalties: [3], zero without carriers: mean trace of the covariances; mean over the pairs of one carrier's children
    of max(0, margin - distance)^2; mean squared difference of colours from the mean of their cell. None without cells.
    """

    means: Tensor
    factors: Tensor
    opacities: Tensor
    colors: Tensor
    offsets: Tensor
    penalties: Tensor | None


def decode(heads: Heads, features: Tensor, log_scales: Tensor, instant: Instant, rows: Tensor | None = None) -> Decoded:
    """Decode n carriers; differentiable by the heads' weights, `features` and `log_scales`.

    features: float32 [n, F]; log_scales: float32 [n, 3], log of s. With `rows` (int64 [n], ascending) these are tables
    of which the carriers have these rows, and their gradients are sparse (coalesced, over these rows).

    Raises TypeError or ValueError naming the argument.
    """
    _check(heads, features, log_scales, instant, rows)
    needs_gradients = torch.is_grad_enabled() and any(t.requires_grad for t in (features, log_scales, *heads.weights))
    return Decoded(*_Decode.apply(features, log_scales, *heads.weights, heads, instant, rows, needs_gradients))


def _check(heads: Heads, features: Tensor, log_scales: Tensor, instant: Instant, rows: Tensor | None) -> None:
    table = "n" if rows is None else "rows"
    sizes = {"F": features.shape[-1], "H": len(heads.hidden[1]), "K": len(heads.opacity[1])}
    sizes |= {"n": len(instant.phi), table: len(features), "3": 3, "F+3": sizes["F"] + 3, "3K": 3 * sizes["K"]}
    shapes: dict[str, tuple[Tensor | None, tuple[str, ...]]] = {
        "features": (features, (table, "F")),
        "log_scales": (log_scales, (table, "3")),
        "positions": (instant.positions, ("n", "3")),
        "deformation": (instant.deformation, ("n", "3", "3")),
        "phi": (instant.phi, ("n",)),
        "eye": (instant.eye, ("3",)),
        "visibility": (instant.visibility, ("n",)),
    }
    layers = {"offset": ("3K", "F"), "scale": ("3K", "F"), "opacity": ("K", "F"), "hidden": ("H", "F+3")}
    for name, shape in (layers | {"color": ("3K", "H")}).items():
        weight, bias = getattr(heads, name)
        shapes[f"{name} weight"], shapes[f"{name} bias"] = (weight, shape), (bias, shape[:1])
    for name, (value, letters) in shapes.items():
        if value is None:
            continue
        if value.dtype != torch.float32 or value.device.type != "cpu":
            raise TypeError(f"{name} is {value.dtype} on {value.device}, not float32 on the CPU")
        if list(value.shape) != [sizes[letter] for letter in letters]:
            expected = ", ".join(f"{letter} = {sizes[letter]}" for letter in letters)
            raise ValueError(f"{name} is {list(value.shape)}, not [{expected}]")
    if not 1 <= sizes["K"] <= MAX_CHILDREN:
        raise ValueError(f"the heads give {sizes['K']} children, not 1 to {MAX_CHILDREN}")
    for name, index, limit in (("rows", rows, len(features)), ("cells", instant.cells, instant.cell_count)):
        if index is None:
            continue
        if index.dtype != torch.int64 or index.device.type != "cpu":
            raise TypeError(f"{name} is {index.dtype} on {index.device}, not int64 on the CPU")
        if list(index.shape) != [sizes["n"]]:
            raise ValueError(f"{name} is {list(index.shape)}, not [n = {sizes['n']}]")
        if len(index) and not (int(index.min()) >= 0 and int(index.max()) < limit):
            raise ValueError(f"{name} holds numbers outside 0 to {limit - 1}")
    if rows is not None and not bool((rows[1:] > rows[:-1]).all()):
        raise ValueError("rows is not ascending")


def _address(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


def _empty(*shape: int) -> Tensor:
    return torch.from_numpy(memory.empty(shape))


class _Call:
    """What the kernel reads, in both directions: contiguous tensors, and the structures that point to them."""

    def __init__(
        self, heads: Heads, features: Tensor, log_scales: Tensor, weights: tuple, instant: Instant, rows: Tensor | None
    ) -> None:
        at = (rows, features, log_scales, instant.positions, instant.deformation, instant.phi, instant.visibility)
        self._alive = [None if t is None else t.detach().contiguous() for t in (*at, instant.cells, *weights)]
        addresses = [_address(t) for t in self._alive]
        self.count, self.children = len(instant.phi), len(heads.opacity[1])
        self.cell_count = instant.cell_count if instant.cells is not None else 0
        self.heads = HeadsStruct(
            features.shape[1],
            self.children,
            len(heads.hidden[1]),
            heads.offset_bound,
            heads.scale_range,
            heads.opacity_slope,
            heads.opacity_band,
            heads.separation_margin,
            (ctypes.c_void_p * 10)(*addresses[8:]),
        )
        eye = (ctypes.c_float * 3)(*instant.eye.tolist())
        self.carriers = CarriersStruct(self.count, *addresses[:7], eye, addresses[7], self.cell_count)


class _Decode(torch.autograd.Function):
    """Inputs: features, log_scales, the ten weights; then heads, instant, rows, and whether gradients are needed."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, log_scales: Tensor, *rest: Any) -> tuple[Tensor | None, ...]:
        *weights, heads, instant, rows, needs_gradients = rest
        call = _Call(heads, features, log_scales, tuple(weights), instant, rows)
        n, k, library = call.count, call.children, KERNEL.library
        children = [_empty(n, k, 3), _empty(n, k, 3, 3), _empty(n, k), _empty(n, k, 3), _empty(n, k, 3)]
        activations = _empty(library.splash_decode_kept(ctypes.byref(call.heads), n)) if needs_gradients else None
        cell_colors = None if instant.cells is None else _empty(call.cell_count, 3)
        penalties = (ctypes.c_double * 3)()
        status = library.splash_decode(
            ctypes.byref(call.heads),
            ctypes.byref(call.carriers),
            ctypes.byref(ChildrenStruct(*map(_address, children))),
            _address(activations),
            _address(cell_colors),
            penalties,
            kernel_threads(),
        )
        if status != DONE:
            raise MemoryError("the decoder is out of memory: fewer carriers need less")
        if needs_gradients:
            ctx.call, ctx.activations, ctx.cell_colors = call, activations, cell_colors
            # The kernel reads the inputs again; torch notices where they were changed in place since.
            ctx.save_for_backward(features, log_scales, *weights, *([] if rows is None else [rows]))
        ctx.set_materialize_grads(False)
        return (*children, None if instant.cells is None else torch.tensor(list(penalties), dtype=torch.float32))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *outer: Tensor | None) -> tuple[Tensor | None, ...]:
        features, log_scales, *weights = ctx.saved_tensors
        rows = weights.pop() if len(weights) > 10 else None
        call: _Call = ctx.call
        grad_children = [None if g is None else g.contiguous() for g in outer[:5]]
        penalties = (ctypes.c_double * 3)(*([0.0] * 3 if outer[5] is None else outer[5].tolist()))
        by_rows = [_empty(call.count, features.shape[1]), _empty(call.count, 3)]
        by_weights = [torch.empty(w.shape) for w in weights]
        gradients = DecoderGradientsStruct(*map(_address, by_rows), (ctypes.c_void_p * 10)(*map(_address, by_weights)))
        status = KERNEL.library.splash_decode_backward(
            ctypes.byref(call.heads),
            ctypes.byref(call.carriers),
            _address(ctx.activations),
            _address(ctx.cell_colors),
            ctypes.byref(ChildrenStruct(*map(_address, grad_children))),
            penalties,
            kernel_threads(),
            ctypes.byref(gradients),
        )
        if status != DONE:
            raise MemoryError("the decoder is out of memory: fewer carriers need less")
        if rows is not None:
            shapes = (features.shape, log_scales.shape)
            by_rows = [
                torch.sparse_coo_tensor(rows[None], values, shape, check_invariants=False, is_coalesced=True)
                for values, shape in zip(by_rows, shapes)
            ]
        return (*by_rows, *by_weights, None, None, None, None)

"""A device that is none: its tensors lie on the CPU, and take part in no operation with the CPU's.

What runs on it has moved everything that a GPU would have to be given; what forgot a tensor ends in an error here, on
any machine. It is called "meta", the one device that PyTorch's autograd runs without a driver. Data leave by
`.to("cpu")`, `.cpu()` and `float()` alone, and arrive by `.to(DEVICE)` or a function's `device`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

DEVICE = "meta"
# Operations that may read and write across devices.
_COPIES = {torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default}
# Operations that take indices from the CPU as well, as on CUDA.
_INDEXING = {"aten::index", "aten::index_put_", "aten::index_put", "aten::_index_put_impl_"}


class VirtualTensor(torch.Tensor):
    """A tensor on the virtual device; `inner` has its values."""

    inner: torch.Tensor
    is_meta = False  # it holds values
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> VirtualTensor:
        made: VirtualTensor = torch.Tensor._make_wrapper_subclass(
            cls,
            inner.shape,
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=torch.device(DEVICE),
        )
        made.inner = inner
        return made

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        return _run(func, args, kwargs or {})


def _tensors(values: Any) -> Iterable[torch.Tensor]:
    return (value for value in tree_flatten(values)[0] if isinstance(value, torch.Tensor))


def _run(func: Any, args: tuple, kwargs: dict) -> Any:
    """`func` on the values of virtual tensors; the results lie where the arguments do, or where `device` says."""
    given = list(_tensors((args, kwargs)))
    virtual = any(isinstance(tensor, VirtualTensor) for tensor in given)
    if virtual and func not in _COPIES and func._schema.name not in _INDEXING:
        beside = [tensor for tensor in given if not isinstance(tensor, VirtualTensor) and tensor.ndim > 0]
        if beside:
            raise RuntimeError(f"{func}: tensors of {[list(t.shape) for t in beside]} lie on the CPU, others do not")
    device = kwargs.get("device")
    there = virtual if device is None else torch.device(device).type == DEVICE
    if device is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    inner = tree_map(lambda value: value.inner if isinstance(value, VirtualTensor) else value, (args, kwargs))
    result = func(*inner[0], **inner[1])
    written = [
        args[i]
        for i, argument in enumerate(func._schema.arguments)
        if i < len(args) and argument.alias_info is not None and argument.alias_info.is_write
    ]
    if written and isinstance(written[0], torch.Tensor):
        return written[0]
    if not there:
        return result
    return tree_map(lambda value: VirtualTensor(value) if isinstance(value, torch.Tensor) else value, result)


class _Mode(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        return _run(func, args, kwargs or {})


@contextmanager
def virtual_device() -> Iterator[str]:
    """Within, there is a device of this name."""
    original = torch.tensor

    def tensor(data: Any, *, device: Any = None, **options: Any) -> torch.Tensor:
        made = original(data, **options)
        return made if device is None else made.to(device)

    torch.tensor = tensor  # it takes values to a device without any operation that a mode hears of
    try:
        with _Mode():
            yield DEVICE
    finally:
        torch.tensor = original

"""Sums of rows that carriers share, compiled: what a carrier adds up of tables, and gradients added up by group.

Rows lie all over tables of hundreds of megabytes; the kernel asks for each before it is needed. The sums are those of
torch's index_select and index_add_, added in the same order.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from splashbench.native import memory
from splashbench.native.threads import kernel_threads

from .library import KERNEL, MAX_LEVELS, SharedRowsStruct


class SharedRows:
    """Tables on the CPU, contiguous, which may change in place: own [count, width] and, at each level, a table [.,
    width], float32, and the row of it that each carrier has, int32 [count].

    Raises TypeError or ValueError naming the argument.
    """

    def __init__(self, own: Tensor, tables: Sequence[Tensor], cells: Sequence[Tensor]) -> None:
        if len(tables) != len(cells) or len(tables) > MAX_LEVELS:
            raise ValueError(
                f"{len(tables)} tables and {len(cells)} columns of cells are no levels, up to {MAX_LEVELS}"
            )
        for name, table in (("own", own), *((f"table {level}", table) for level, table in enumerate(tables))):
            _require(name, table, torch.float32)
            if table.ndim != 2 or table.shape[1] != own.shape[1]:
                raise ValueError(f"{name} is {list(table.shape)}, not [rows, {own.shape[-1]}]")
        for level, (table, rows) in enumerate(zip(tables, cells)):
            _require(f"cells {level}", rows, torch.int32)
            if rows.shape != (len(own),):
                raise ValueError(f"cells {level} is {list(rows.shape)}, not [{len(own)}]")
            _require_below(f"cells {level}", rows, len(table))
        self._alive = (own, *tables, *cells)
        self._count, self._width = own.shape
        self._struct = SharedRowsStruct(
            self._width,
            own.data_ptr(),
            len(tables),
            (ctypes.c_void_p * MAX_LEVELS)(*(table.data_ptr() for table in tables)),
            (ctypes.c_void_p * MAX_LEVELS)(*(rows.data_ptr() for rows in cells)),
        )

    def of(self, ids: Tensor) -> Tensor:
        """The sums of the carriers `ids` (int64 [n]): [n, width].

        Raises TypeError or ValueError naming the argument.
        """
        ids = ids.contiguous()
        _require("ids", ids, torch.int64)
        _require_below("ids", ids, self._count)
        sums = torch.from_numpy(memory.empty((len(ids), self._width)))
        KERNEL.library.splash_sum_rows(
            ctypes.byref(self._struct), len(ids), ids.data_ptr(), sums.data_ptr(), kernel_threads()
        )
        return sums


def added_by_member(rows: Tensor, members: Tensor, groups: int, places: Tensor | None = None) -> Tensor:
    """The sums [groups, width] of `rows` (float32 [n, width]) by group. Row i is of the group members[places[i]].

    members: int32. places: int64 [n]; 0 to n - 1 by default. Raises TypeError or ValueError naming the argument.
    """
    rows, members = rows.contiguous(), members.contiguous()
    places = None if places is None else places.contiguous()
    _require("rows", rows, torch.float32)
    _require("members", members, torch.int32)
    _require_below("members", members, groups)
    if places is not None:
        _require("places", places, torch.int64)
        _require_below("places", places, len(members))
    count = len(members if places is None else places)
    if rows.ndim != 2 or len(rows) != count:
        raise ValueError(f"rows is {list(rows.shape)}, not [{count}, width]")
    sums = torch.from_numpy(memory.empty((groups, rows.shape[1])))
    KERNEL.library.splash_add_by_member(
        count,
        rows.shape[1],
        None if places is None else places.data_ptr(),
        members.data_ptr(),
        rows.data_ptr(),
        groups,
        sums.data_ptr(),
    )
    return sums


def _require(name: str, value: Tensor, dtype: torch.dtype) -> None:
    if value.dtype != dtype or value.device.type != "cpu" or not value.is_contiguous():
        raise TypeError(f"{name} is {value.dtype} on {value.device}, not contiguous {dtype} on the CPU")


def _require_below(name: str, value: Tensor, limit: int) -> None:
    if len(value) and not (int(value.min()) >= 0 and int(value.max()) < limit):
        raise ValueError(f"{name} holds numbers outside 0 to {limit - 1}")

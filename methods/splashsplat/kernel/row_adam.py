"""A step of Adam (Kingma and Ba 2015) for some rows of a table, with a step count for each row, compiled."""

from __future__ import annotations

import ctypes

import numpy as np
import torch
from torch import Tensor

from splashbench.native.threads import kernel_threads

from .library import KERNEL, RowAdamStruct


class RowMoments:
    """Adam's state for one float32 table [rows, width] on the CPU, contiguous; `step` updates the table in place."""

    def __init__(self, table: Tensor, betas: tuple[float, float] = (0.9, 0.999), epsilon: float = 1e-8) -> None:
        if table.dtype != torch.float32 or table.device.type != "cpu" or not table.is_contiguous() or table.ndim != 2:
            raise TypeError("table is not a contiguous float32 [rows, width] on the CPU")
        self._table = table.detach()
        self._betas, self._epsilon = betas, epsilon
        self._first, self._second = torch.zeros_like(self._table), torch.zeros_like(self._table)
        self._steps = torch.zeros(len(table), dtype=torch.int32)
        self._corrections = np.zeros((0, 2), np.float32)
        self._calls = 0

    def step(self, rows: Tensor, gradient: Tensor, rate: float) -> None:
        """Move `rows` (int64 [n], each at most once) down their `gradient` [n, width]; the others stay as they are.

        Raises TypeError or ValueError naming the argument.
        """
        if rows.dtype != torch.int64 or rows.ndim != 1 or rows.device.type != "cpu":
            raise TypeError(f"rows is {rows.dtype} {list(rows.shape)} on {rows.device}, not int64 [n] on the CPU")
        if gradient.dtype != torch.float32 or gradient.device.type != "cpu":
            raise TypeError(f"gradient is {gradient.dtype} on {gradient.device}, not float32 on the CPU")
        if tuple(gradient.shape) != (len(rows), self._table.shape[1]):
            raise ValueError(f"gradient is {list(gradient.shape)}, not {[len(rows), self._table.shape[1]]}")
        if len(rows) and not (int(rows.min()) >= 0 and int(rows.max()) < len(self._table)):
            raise ValueError(f"rows holds numbers outside 0 to {len(self._table) - 1}")
        self._calls += 1
        if self._calls >= len(self._corrections):  # no row has taken more steps than there were calls
            taken = np.arange(max(256, 2 * self._calls))[:, None]
            with np.errstate(divide="ignore"):  # row 0 is never read
                self._corrections = (1 / (1 - np.power(np.array(self._betas), taken))).astype(np.float32)
        rows, gradient = rows.contiguous(), gradient.detach().contiguous()
        adam = RowAdamStruct(
            self._table.data_ptr(),
            self._first.data_ptr(),
            self._second.data_ptr(),
            self._steps.data_ptr(),
            self._table.shape[1],
            self._corrections.__array_interface__["data"][0],
            *self._betas,
            self._epsilon,
        )
        KERNEL.library.splash_adam_rows(
            ctypes.byref(adam), len(rows), rows.data_ptr(), gradient.data_ptr(), rate, kernel_threads()
        )
